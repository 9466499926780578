"""A conditional neural process with cross-attention, which the paper names as future work.

Each observation is a token, and so is each ring of the image's circular harmonics. A target's query
is its phase and a summary of the image, and attends to the tokens in several blocks. This replaces
the mean of equation (3) by weights for each target. The weights w₁, w₂ of equation (2) enter as
log w₁ and log w₂, added to the attention's logits. Source: Kim et al., Attentive neural processes,
ICLR 2019.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from affordlib import checked
from affordlib.models.base import NetworkConfig, he_initialise, network, with_time
from affordlib.models.film import CircularHarmonics, HarmonicsNetwork, dense, waves
from affordlib.types import Observations


@checked
@dataclass(frozen=True)
class AttentionConfig(NetworkConfig):
    """Sizes of the network; width must be a multiple of heads (see `FiLMConfig`)."""

    frame: str = "push"
    width: int = 128
    blocks: int = 3
    heads: int = 4
    rings: int = 7
    orders: int = 8
    waves: int = 4

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.width % self.heads:
            raise ValueError(f"width must be a multiple of heads, got {self.width}, {self.heads}")


class CrossAttention(nn.Module):
    """Pre-norm transformer block: x + cross-attention of x to the tokens, then x + MLP(x)."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.norm, self.token_norm = nn.LayerNorm(width), nn.LayerNorm(width)
        self.query, self.key_value = nn.Linear(width, width), nn.Linear(width, 2 * width)
        self.project = nn.Linear(width, width)
        self.mlp = nn.Sequential(nn.LayerNorm(width), *dense(width, 2 * width, width))

    def forward(
        self,
        x: Float[Tensor, "b t w"],
        tokens: Float[Tensor, "b k w"],
        bias: Float[Tensor, "b k"],
    ) -> Float[Tensor, "b t w"]:
        def by_head(values: Tensor) -> Tensor:
            return values.unflatten(-1, (self.heads, -1)).transpose(1, 2)

        key, value = self.key_value(self.token_norm(tokens)).chunk(2, dim=-1)
        query = by_head(self.query(self.norm(x)))
        logits = bias[:, None, None].expand(-1, -1, x.shape[1], -1)
        seen = F.scaled_dot_product_attention(query, by_head(key), by_head(value), logits)
        x = x + self.project(seen.transpose(1, 2).flatten(2))
        return x + self.mlp(x)


@network("attention", AttentionConfig)
class AttentiveCNP(HarmonicsNetwork):
    """An `EffectModel` that relates object image, action and effect by cross-attention."""

    def make_layers(self, config: AttentionConfig) -> None:
        """Make token encoders, attention blocks and decoder; image features are its harmonics."""
        c, w = config, config.width
        n_a, n_e = len(c.action_channels), len(c.effect_channels)
        self.harmonics, self.image_encoder = CircularHarmonics(c.rings, c.orders), nn.Identity()
        n = self.harmonics.n_features
        self.place = nn.Parameter(0.02 * torch.randn(c.rings, w))
        self.image_token = nn.Linear(n // c.rings, w)
        self.image_summary = nn.Sequential(*dense(n, 2 * w, w, w)).apply(he_initialise)
        self.action_token = nn.Sequential(*dense(n_a + 1, w, w, w))
        self.effect_token = nn.Sequential(*dense(n_e + 1, w, w, w))
        self.ask = nn.Linear(2 * c.waves + 1, w)
        self.blocks = nn.ModuleList(CrossAttention(w, c.heads) for _ in range(c.blocks))
        self.last = nn.Sequential(nn.LayerNorm(w), *dense(w, w, 2 * (n_a + n_e)))

    def outputs(
        self, features: Tensor, observations: Observations, t_target: Tensor
    ) -> tuple[Tensor, ...]:
        """Return (μ_a, σ_a, μ_e, σ_e), each (B, T, C) and standardised."""
        o = observations
        b = len(o.weight)
        rings = features.reshape(-1, *self.harmonics.layout).movedim(3, 1).flatten(2)
        image = (self.image_token(rings) + self.place).expand(b, -1, -1)
        tokens = torch.cat(
            [
                image,
                self.action_token(with_time(o.action / self.action_scale, o.action_t)),
                self.effect_token(with_time(o.effect / self.effect_scale, o.effect_t)),
            ],
            dim=1,
        )
        w_1 = o.weight[:, None]
        share = torch.cat([w_1 * o.action_mask, (1 - w_1) * o.effect_mask], dim=1)
        bias = F.pad(share.log(), (image.shape[1], 0))
        x = self.ask(waves(t_target, self.config.waves)) + self.image_summary(features)[:, None]
        for block in self.blocks:
            x = block(x, tokens, bias)
        return self.split_outputs(self.last(x))
