"""Our improved network: the features of the image modulate residual blocks (FiLM).

    r      = w₁ mean h_a(a_i) + w₂ mean h_e(e_i)             as in the paper, equations (2) and (3)
    x_0    = W {r, f(γ_o), φ(t_target)}
    x_k+1  = x_k + W₂ ς(γ_k ∘ W₁ n(x_k) + β_k),  (γ_k - 1, β_k) = V_k f(γ_o)
    g(x_K) = (μ_a, σ_a, μ_e, σ_e)

f: a small network on the image's circular harmonics, which rotate exactly into the push frame;
ς: SiLU; n: layer normalisation; φ: t with its first sines and cosines. Source: Perez et al., FiLM:
visual reasoning with a general conditioning layer, AAAI 2018.
"""

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from affordlib import checked
from affordlib.models.harmonics import HarmonicsConfig, HarmonicsNetwork, dense, waves
from affordlib.types import Observations

FEW_ROTATIONS = 32
"""From this many rotations of one image on, its basis is faster."""


@checked
@dataclass(frozen=True)
class FiLMConfig(HarmonicsConfig):
    """Width and number of the residual blocks; by default in the push frame."""

    frame: str = "push"
    width: int = 128
    blocks: int = 3


class FiLMBlock(nn.Module):
    """x + W₂ ς(γ ∘ W₁ n(x) + β), γ and β linear in the condition."""

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
    """Relates object image, action and effect; satisfies `EffectModel`."""

    def make_layers(self, config: FiLMConfig) -> None:
        """Encoders and decoders as described above."""
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
        """f(γ_o) of the rotated images, of the harmonics of the images.

        Of one image in many rotations the first layer, linear, is computed of its basis alone.
        """
        if len(unoriented) > 1 or len(rotation) < FEW_ROTATIONS:
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
        # Only the phase differs between the targets of a query, so the rest is merged once.
        split = known.shape[1]
        base = F.linear(known, self.merge.weight[:, :split], self.merge.bias)
        phase = waves(t_target, self.config.waves)
        x = base[:, None] + F.linear(phase, self.merge.weight[:, split:])
        return self.decode(x, features)

    def decode(self, x: Float[Tensor, "b t w"], features: Tensor) -> tuple[Tensor, ...]:
        """(μ_a, σ_a, μ_e, σ_e) of x_0."""
        for block in self.blocks:
            x = block(x, features)
        return self.split_outputs(self.last(self.head(x)))
