"""Two networks for lever-ups: ours, in the frame of the last observed pose, and the paper's around
the mean trajectory, as the recurrent network predicts too.

    d(t)  = e(t) - m(t)                              m: mean of the training trajectories
    r     = w₁ mean h_a(a_i, t_i) + w₂ mean h_e(d_i - d_l, t_i - t_l, t_i),  l the last observed
    μ(t)  = m(t) + d_l + ḋ_l s(t) + n(t) g(r, ḋ_l, d_l, f(γ_o), t - t_l, t),    σ(t) from g

A mean of codes, as in equations (2) and (3) of the paper, loses the exact pose of the last
observation. Here that pose is an input, with the velocity ḋ_l between the last two observations,
whose influence s(t) = (t - t_l) exp(-|t - t_l| / 0.2) decays. The network predicts the remaining
change; n rises from 0 at t_l towards 1. Any t is predicted directly, without a rollout. With no
observation d_l is the one at t = 0, where a displacement is zero.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor, nn

from affordlib import checked
from affordlib.geometry import rotate_channels, xy_columns
from affordlib.interactions.dataset import InteractionTensors, condition_on_recorded_action
from affordlib.models.base import NetworkConfig, inverse, network, push_direction, with_time
from affordlib.models.cnp import AffordanceCNP, CNPConfig
from affordlib.models.film import FiLMConfig, FiLMNetwork, dense, waves
from affordlib.types import Observations

_NEAR_PHASE = 0.1
_VELOCITY_PHASE = 0.2


@checked
@dataclass(frozen=True)
class LastPoseConfig(FiLMConfig):
    """Sizes as in `FiLMConfig`."""

    frame: str = "table"
    steps: int = 25  # linear segments of m(t)


def between(values: Float[Tensor, "b n c"], at: Float[Tensor, "b t"]) -> Float[Tensor, "b t c"]:
    """Interpolate values (B, n, C) linearly at fractional indices (B, T)."""
    below = at.detach().floor().long().clamp(0, values.shape[1] - 2)
    share = (at - below)[..., None]

    def pick(index):
        return values.gather(1, index[..., None].expand(-1, -1, values.shape[-1]))

    return (1 - share) * pick(below) + share * pick(below + 1)


def action_direction(arrays: InteractionTensors) -> Tensor | None:
    """Directions of the recorded actions; None for primitives that have none."""
    channels = arrays.action_channels, arrays.effect_channels
    if not all(map(xy_columns, channels)):
        return None
    return push_direction(condition_on_recorded_action(arrays), *channels)


def in_action_frame(arrays: InteractionTensors, at: Tensor) -> Tensor:
    """True effects (N, T, C) at sample numbers (T,) in the frame of the action, if it has one."""
    effect, direction = arrays.effect[:, at], action_direction(arrays)
    if direction is None:
        return effect
    back = inverse(direction)[:, None]
    return rotate_channels(effect, arrays.effect_channels, back, absolute_yaw=False)


class MeanTrajectory(nn.Module):
    """Mean effect m(t) over the phase, linear between steps, in standardised units."""

    def __init__(self, steps: int, channels: int) -> None:
        super().__init__()
        self.register_buffer("values", torch.zeros(steps + 1, channels))

    def forward(self, t: Float[Tensor, "b t"]) -> Float[Tensor, "b t c"]:
        at = t.clamp(0, 1) * (len(self.values) - 1)
        return between(self.values.expand(len(t), -1, -1), at)


class AroundMean:
    """A part of networks that predict differences from a `mean_trajectory` of their training."""

    def make_layers(self, config: NetworkConfig) -> None:
        """Create the network's layers, and the mean trajectory."""
        super().make_layers(config)
        self.mean_trajectory = MeanTrajectory(config.steps, len(config.effect_channels))

    def prepare(self, training: InteractionTensors) -> None:
        """Set m to the mean effect of training trajectories and their mirror images."""
        both = training.joined(training.rotated_and_mirrored(0, mirror=True))
        at = torch.linspace(0, len(both.phase) - 1, self.config.steps + 1).round().long()
        effect = in_action_frame(both, at) if self.config.frame == "push" else both.effect[:, at]
        self.mean_trajectory.values = effect.mean(dim=0) / self.effect_scale


@checked
@dataclass(frozen=True)
class CNPAroundMeanConfig(CNPConfig):
    """Channels as in `CNPConfig`."""

    steps: int = 25  # linear segments of m(t)


@network("cnp_around_mean", CNPAroundMeanConfig)
class CNPAroundMean(AroundMean, AffordanceCNP):
    """The paper's network, whose effects are differences d(t) from the mean trajectory."""

    def outputs(
        self, features: Tensor, observations: Observations, t_target: Tensor
    ) -> tuple[Tensor, ...]:
        """(μ_a, σ_a, μ_e, σ_e), each (B, T, C) and standardised."""
        o, mean = observations, self.mean_trajectory
        d = o.effect - mean(o.effect_t) * self.effect_scale
        mu_a, sigma_a, d, sigma_e = super().outputs(features, replace(o, effect=d), t_target)
        return mu_a, sigma_a, mean(t_target) + d, sigma_e


@network("cnp_last_pose", LastPoseConfig)
class LastPoseCNP(AroundMean, FiLMNetwork):
    """Predicts a trajectory from any observed part of it; satisfies `EffectModel`."""

    def make_layers(self, config: LastPoseConfig) -> None:
        """Create the encoders and decoders described above."""
        super().make_layers(config)
        c, w = config, config.width
        n_e = len(c.effect_channels)
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


def _last(d: Float[Tensor, "b m c"], t: Float[Tensor, "b m"], seen: Tensor) -> tuple[Tensor, ...]:
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
