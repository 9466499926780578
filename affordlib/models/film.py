"""Our networks: image features modulate residual blocks by feature-wise linear modulation (FiLM).

    r      = w₁ mean h_a(a_i) + w₂ mean h_e(e_i)             as in the paper, equations (2) and (3)
    x_0    = W {r, f(γ_o), φ(t_target)}
    x_k+1  = x_k + W₂ ς(γ_k ∘ W₁ n(x_k) + β_k),  (γ_k - 1, β_k) = V_k f(γ_o)
    g(x_K) = (μ_a, σ_a, μ_e, σ_e)

f: a small network on the image's circular harmonics, which rotate exactly into the push frame; ς:
SiLU; n: layer normalisation; φ: t with its first sines and cosines. Source: Perez et al., FiLM:
visual reasoning with a general conditioning layer, AAAI 2018.

`LastPoseCNP`, for lever-ups, works in the frame of the last observed pose:

    d(t)  = e(t) - m(t)                              m: mean of the training trajectories
    r     = w₁ mean h_a(a_i, t_i) + w₂ mean h_e(d_i - d_l, t_i - t_l, t_i),  l the last observed
    μ(t)  = m(t) + d_l + ḋ_l s(t) + n(t) g(r, ḋ_l, d_l, f(γ_o), t - t_l, t),    σ(t) from g

A mean of codes, as in equations (2) and (3) of the paper, loses the exact pose of the last
observation. Here that pose is an input, with the velocity ḋ_l between the last two observations,
whose influence s(t) = (t - t_l) exp(-|t - t_l| / 0.2) decays. The network predicts the remaining
change; n rises from 0 at t_l towards 1. Any t is predicted directly, without a rollout. With no
observation d_l is the one at t = 0, where a displacement is zero.
"""

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from affordlib import checked
from affordlib.models.base import with_time
from affordlib.models.harmonics import HarmonicsConfig, HarmonicsNetwork, dense, waves
from affordlib.types import Observations

BASIS_FROM_ROTATIONS = 32
"""Number of rotations of one image from which on using its basis is faster."""

_NEAR_PHASE = 0.1
_VELOCITY_PHASE = 0.2


@checked
@dataclass(frozen=True)
class FiLMConfig(HarmonicsConfig):
    """Width and number of the residual blocks; the default frame is the push frame."""

    frame: str = "push"
    width: int = 128
    blocks: int = 3


class FiLMBlock(nn.Module):
    """Residual block x + W₂ ς(γ ∘ W₁ n(x) + β), with γ and β linear in the condition."""

    def __init__(self, width: int, condition: int) -> None:
        super().__init__()
        self.norm = nn.LayerNorm(width)
        self.first, self.second = nn.Linear(width, width), nn.Linear(width, width)
        self.modulation = nn.Linear(condition, 2 * width)
        nn.init.zeros_(self.second.weight)
        nn.init.zeros_(self.second.bias)

    def forward(
        self, x: Float[Tensor, "b t w"], condition: Float[Tensor, "#b c"]
    ) -> Float[Tensor, "b t w"]:
        gain, shift = self.modulation(condition)[:, None].chunk(2, dim=-1)
        return x + self.second(F.silu((1 + gain) * self.first(self.norm(x)) + shift))


class FiLMNetwork(HarmonicsNetwork):
    """FiLM network relating object image, action and effect; satisfies `EffectModel`."""

    def make_layers(self, config: FiLMConfig) -> None:
        """Create the encoders and decoders described above."""
        super().make_layers(config)
        c, w = config, config.width
        n_a, n_e = len(c.action_channels), len(c.effect_channels)
        self.action_encoder = nn.Sequential(*dense(n_a + 1, w, w, w))
        self.effect_encoder = nn.Sequential(*dense(n_e + 1, w, w, w))
        self.merge = nn.Linear(w + c.image_features + 2 * c.waves + 1, w)
        self.blocks = nn.ModuleList(FiLMBlock(w, c.image_features) for _ in range(c.blocks))
        self.head = nn.Sequential(nn.LayerNorm(w), nn.Linear(w, w), nn.SiLU())
        self.last = nn.Linear(w, 2 * (n_a + n_e))

    def oriented_features(
        self, unoriented: Float[Tensor, "#b f"], rotation: Float[Tensor, "b 2"]
    ) -> Float[Tensor, "b f"]:
        """f(γ_o) of the rotated images, computed from the harmonics of the images.

        For many rotations of one image, the linear first layer is applied only to its `basis`.
        """
        if len(unoriented) > 1 or len(rotation) < BASIS_FROM_ROTATIONS:
            return super().oriented_features(unoriented, rotation)
        first = self.image_encoder[0]
        angle = torch.atan2(rotation[:, 1], rotation[:, 0])[:, None]
        angle = angle * torch.arange(self.config.orders + 1, device=angle.device)
        weights = torch.cat([angle.cos(), angle.sin()], dim=1)
        x = weights @ F.linear(self.harmonics.basis(unoriented), first.weight) + first.bias
        return self.image_encoder[1:](x)

    def outputs(
        self, features: Tensor, observations: Observations, t_target: Tensor
    ) -> tuple[Tensor, ...]:
        """(μ_a, σ_a, μ_e, σ_e), each (B, T, C) and standardised."""
        r = self.represent(observations)
        known = torch.cat([r, features.expand(len(r), -1)], dim=1)
        # Only the phase differs between the targets of a query; the rest is merged once.
        split = known.shape[1]
        base = F.linear(known, self.merge.weight[:, :split], self.merge.bias)
        phase = waves(t_target, self.config.waves)
        x = base[:, None] + F.linear(phase, self.merge.weight[:, split:])
        return self.decode(x, features)

    def decode(self, x: Float[Tensor, "b t w"], features: Tensor) -> tuple[Tensor, ...]:
        """(μ_a, σ_a, μ_e, σ_e) decoded from x_0."""
        for block in self.blocks:
            x = block(x, features)
        return self.split_outputs(self.last(self.head(x)))


@checked
@dataclass(frozen=True)
class LastPoseConfig(FiLMConfig):
    """Sizes as in `FiLMConfig`; steps: number of linear segments of m(t)."""

    frame: str = "table"
    steps: int = 25


def between(values: Float[Tensor, "b n c"], at: Float[Tensor, "b t"]) -> Float[Tensor, "b t c"]:
    """Interpolate values (B, n, C) linearly at fractional indices (B, T)."""
    below = at.detach().floor().long().clamp(0, values.shape[1] - 2)
    share = (at - below)[..., None]

    def pick(index: Tensor) -> Tensor:
        return values.gather(1, index[..., None].expand(-1, -1, values.shape[-1]))

    return (1 - share) * pick(below) + share * pick(below + 1)


class MeanTrajectory(nn.Module):
    """Mean effect m(t) over the phase, linear between steps, in standardised units."""

    def __init__(self, steps: int, channels: int) -> None:
        super().__init__()
        self.register_buffer("values", torch.zeros(steps + 1, channels))

    def fit(self, effect: Float[Tensor, "n s c"], scale: Float[Tensor, " c"]) -> None:
        """Set m from effects of training trajectories [m, rad], whose steps must be m's."""
        if effect.shape[1:] != self.values.shape:
            raise ValueError(
                f"effect must have (steps, channels) = {tuple(self.values.shape)}, "
                f"got {tuple(effect.shape[1:])}"
            )
        self.values = effect.mean(dim=0) / scale

    def forward(self, t: Float[Tensor, "b t"]) -> Float[Tensor, "b t c"]:
        at = t.clamp(0, 1) * (len(self.values) - 1)
        return between(self.values.expand(len(t), -1, -1), at)


class LastPoseCNP(FiLMNetwork):
    """Predicts a trajectory from any observed part of it; satisfies `EffectModel`."""

    def make_layers(self, config: LastPoseConfig) -> None:
        """Create the encoders and decoders described above."""
        super().make_layers(config)
        c, w = config, config.width
        n_e = len(c.effect_channels)
        self.mean_trajectory = MeanTrajectory(c.steps, n_e)
        self.effect_encoder = nn.Sequential(*dense(n_e + 2, w, w, w))
        known = w + c.image_features + 2 * n_e + 2
        self.merge = nn.Linear(known + 2 * (2 * c.waves + 1), w)

    def outputs(
        self, features: Tensor, observations: Observations, t_target: Tensor
    ) -> tuple[Tensor, ...]:
        """(μ_a, σ_a, μ_e, σ_e), each (B, T, C) and standardised."""
        o = observations
        d = o.effect / self.effect_scale - self.mean_trajectory(o.effect_t)
        d_last, t_last, velocity = _last(d, o.effect_t, o.effect_mask)
        since = with_time(d - d_last[:, None], o.effect_t - t_last)
        r = self.represent(o, with_time(since, o.effect_t))
        seen = o.effect_mask.any(dim=1, keepdim=True).to(r.dtype)
        image = features.expand(len(r), -1)
        known = torch.cat([r, image, d_last, velocity, t_last, seen], dim=1)
        ahead = t_target - t_last
        n = self.config.waves
        times = torch.cat([waves(t_target, n), waves(ahead, n)], dim=-1)
        x = self.merge(torch.cat([known[:, None].expand(-1, times.shape[1], -1), times], dim=-1))
        mu_a, sigma_a, change, sigma_e = self.decode(x, features)
        # The change is zero at the last pose; the influence of the velocity decays.
        near = ahead.abs()[..., None] / (ahead.abs()[..., None] + _NEAR_PHASE)
        lasting = (10 * ahead * (-ahead.abs() / _VELOCITY_PHASE).exp())[..., None]
        moving = velocity[:, None] * lasting
        mu_e = self.mean_trajectory(t_target) + d_last[:, None] + moving + near * change
        return mu_a, sigma_a, mu_e, sigma_e


def _last(
    d: Float[Tensor, "b m c"], t: Float[Tensor, "b m"], seen: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Value (B, C) and phase (B, 1) of the last observation, and its velocity per tenth of phase.

    All are zero where nothing is observed; the velocity also where there is one observation.
    """
    order = t.masked_fill(~seen, -1.0).argsort(dim=1)[:, -2:]
    rows = torch.arange(len(d), device=d.device)
    late, early = order[:, -1], order[:, 0]
    any_seen, two = seen.any(dim=1), seen.sum(dim=1) >= 2
    gap = (t[rows, late] - t[rows, early]).clamp_min(1e-3)[:, None]
    velocity = (d[rows, late] - d[rows, early]) * (0.1 / gap) * two[:, None]
    return d[rows, late] * any_seen[:, None], (t[rows, late] * any_seen)[:, None], velocity
