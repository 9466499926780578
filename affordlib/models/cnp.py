"""The paper's network (Section 3.1, layer tables of the appendix).

    r_i   = w₁ h_a(a_i) + w₂ h_e(e_i),  w₁ + w₂ = 1        equation (2)
    r     = mean of the r_i                                 equation (3)
    r_mrg = {r, f(γ_o), t_target}
    g_a(r_mrg) = (μ_a, σ_a),   g_e(r_mrg) = (μ_e, σ_e)      equations (4), (5)

h_a, h_e: encoders of an action or effect with its time; f: image encoder; g_a, g_e: decoders.
Since both sums are linear, r = w₁ mean(h_a) + w₂ mean(h_e): actions and effects may be observed at
different times and in different numbers.
"""

from dataclasses import dataclass
from functools import partial

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from affordlib import checked
from affordlib.models.base import (
    EffectNetwork,
    NetworkConfig,
    dense,
    he_initialise,
    network,
    rotate_image,
)
from affordlib.types import Observations

ENCODER_WIDTHS = (32, 64, 64, 128, 128, 256, 128)
DECODER_WIDTHS = (512, 256, 128, 32)
CONVOLUTION_WIDTHS = (32, 64, 64, 128, 128)
MERGE_WIDTH = 1024
IMAGE_FEATURES = 16
FOLD_FROM_TARGETS = 100


@checked
@dataclass(frozen=True)
class CNPConfig(NetworkConfig):
    """Channels and frame; the sizes are the paper's."""

    # End the decoders with a LeakyReLU, as the paper's appendix prints: negative means are then
    # hard to reach.
    leaky_output: bool = False


def image_encoder() -> nn.Sequential:
    """Image encoder f: (B, 2, 48, 48) → (B, 16); five convolutions, each halving the image."""
    layers: list[nn.Module] = []
    for n_in, n_out in zip((2, *CONVOLUTION_WIDTHS[:-1]), CONVOLUTION_WIDTHS, strict=True):
        # The paper activates before pooling: the same result at four times the computation.
        layers += [nn.Conv2d(n_in, n_out, 3, padding="same"), nn.MaxPool2d(2), nn.LeakyReLU()]
    return nn.Sequential(*layers, nn.Flatten(), nn.Linear(CONVOLUTION_WIDTHS[-1], IMAGE_FEATURES))


@network("cnp", CNPConfig)
class AffordanceCNP(EffectNetwork):
    """The paper's network, relating object image, action and effect; satisfies `EffectModel`."""

    def make_layers(self, config: CNPConfig) -> None:
        """Create the encoders and decoders described above."""
        n_a, n_e = len(config.action_channels), len(config.effect_channels)
        self.image_encoder = image_encoder()
        layers = partial(dense, activation=nn.LeakyReLU)
        self.action_encoder = nn.Sequential(*layers(n_a + 1, *ENCODER_WIDTHS), nn.LeakyReLU())
        self.effect_encoder = nn.Sequential(*layers(n_e + 1, *ENCODER_WIDTHS))
        self.merge = nn.Linear(ENCODER_WIDTHS[-1] + IMAGE_FEATURES + 1, MERGE_WIDTH)
        last = [nn.LeakyReLU()] * config.leaky_output
        self.action_decoder = nn.Sequential(*layers(MERGE_WIDTH, *DECODER_WIDTHS, 2 * n_a), *last)
        self.effect_decoder = nn.Sequential(*layers(MERGE_WIDTH, *DECODER_WIDTHS, 2 * n_e), *last)
        self.apply(he_initialise)

    def features(
        self, basis: Float[Tensor, "#b 4608"], rotation: Float[Tensor, "b 2"] | None = None
    ) -> Float[Tensor, "b 16"]:
        """f(γ_o): features (B, 16) of depth and mask (B, 2, 48, 48)."""
        image = basis.reshape(-1, 2, 48, 48)
        image = image if rotation is None else rotate_image(image, rotation)
        channels_last = torch.channels_last  # twice as fast
        return self.image_encoder(self._scaled(image).contiguous(memory_format=channels_last))

    def decode(
        self,
        r: Float[Tensor, "b 128"],
        features: Float[Tensor, "#b 16"],
        t_target: Float[Tensor, "b t"],
    ) -> tuple[Float[Tensor, "b t _"], ...]:
        """Decode r (B, 128) at t_target (B, T) into (μ_a, σ_a, μ_e, σ_e), (B, T, C), standardised.

        The merge layer has no activation, so it folds exactly into each decoder's first layer, and
        only the column of t differs between the targets of one query, which is faster for many.
        """
        known, outputs = torch.cat([r, features.expand(len(r), -1)], dim=1), []
        for decoder in (self.action_decoder, self.effect_decoder):
            first = decoder[0]
            if t_target.numel() >= FOLD_FROM_TARGETS:
                weight = first.weight @ self.merge.weight
                base = F.linear(known, weight[:, :-1], first.weight @ self.merge.bias + first.bias)
                hidden = base[:, None] + t_target[..., None] * weight[:, -1]
            else:
                known_at_t = known[:, None].expand(-1, t_target.shape[1], -1)
                hidden = first(self.merge(torch.cat([known_at_t, t_target[..., None]], dim=-1)))
            mean, raw = decoder[1:](hidden).chunk(2, dim=-1)
            outputs += [mean, self.sigma_floor + F.softplus(raw)]
        return tuple(outputs)

    def outputs(
        self, features: Tensor, observations: Observations, t_target: Tensor
    ) -> tuple[Tensor, ...]:
        """(μ_a, σ_a, μ_e, σ_e), each (B, T, C) and standardised."""
        return self.decode(self.represent(observations), features, t_target)
