"""The paper's network (Section 3.1, layer tables of the appendix), in the frame of the table.

    r_i   = w₁ h_a(a_i) + w₂ h_e(e_i),  w₁ + w₂ = 1        equation (2)
    r     = mean of the r_i                                 equation (3)
    r_mrg = {r, f(γ_o), t_target}
    g_a(r_mrg) = (μ_a, σ_a),   g_e(r_mrg) = (μ_e, σ_e)      equations (4), (5)

h_a, h_e: encoders of an action or effect with its time; f: image encoder; g_a, g_e: decoders.
Since both sums are linear, r = w₁ mean(h_a) + w₂ mean(h_e): actions and effects may be observed at
different times and in different numbers.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from affordlib.interactions.batches import Normaliser
from affordlib.types import Observations, Prediction

ENCODER_WIDTHS = (32, 64, 64, 128, 128, 256, 128)
DECODER_WIDTHS = (512, 256, 128, 32)
CONVOLUTION_WIDTHS = (32, 64, 64, 128, 128)
MERGE_WIDTH = 1024
IMAGE_FEATURES = 16
FOLD_FROM_TARGETS = 100


@dataclass(frozen=True)
class CNPConfig:
    """Channels of the network, and how it reads the two places where the paper is unclear.

    sigma_floor is in standardised units. leaky_output puts a LeakyReLU on the decoders' last
    layer, as the appendix literally has it; it keeps means from becoming negative easily.
    """

    action_channels: tuple[str, ...] = ("x", "y")
    effect_channels: tuple[str, ...] = ("x", "y")
    sigma_floor: float = 0.1
    leaky_output: bool = False

    def __post_init__(self) -> None:
        for name in ("action_channels", "effect_channels"):
            channels = tuple(getattr(self, name))
            if not channels:
                raise ValueError(f"{name} must name at least one channel, got none")
            object.__setattr__(self, name, channels)
        if not 0 < self.sigma_floor < 10:
            raise ValueError(f"sigma_floor must lie in (0, 10), got {self.sigma_floor!r}")


def _dense(widths: tuple[int, ...], activate_last: bool) -> nn.Sequential:
    layers: list[nn.Module] = []
    for k, (n_in, n_out) in enumerate(pairwise(widths)):
        layers.append(nn.Linear(n_in, n_out))
        if activate_last or k < len(widths) - 2:
            layers.append(nn.LeakyReLU())
    return nn.Sequential(*layers)


def image_encoder() -> nn.Sequential:
    """f: (B, 2, 48, 48) → (B, 16), five convolutions, each halving the image."""
    layers: list[nn.Module] = []
    for n_in, n_out in zip((2, *CONVOLUTION_WIDTHS[:-1]), CONVOLUTION_WIDTHS, strict=True):
        layers += [nn.Conv2d(n_in, n_out, 3, padding="same"), nn.LeakyReLU(), nn.MaxPool2d(2)]
    return nn.Sequential(*layers, nn.Flatten(), nn.Linear(CONVOLUTION_WIDTHS[-1], IMAGE_FEATURES))


class AffordanceCNP(nn.Module):
    """Relates object image, action and effect; satisfies `EffectModel`.

    Inputs and outputs are in metres and radians; scaling by the normaliser happens inside.
    """

    def __init__(self, config: CNPConfig, normaliser: Normaliser) -> None:
        super().__init__()
        self.config, self.normaliser = config, normaliser
        self.action_channels = config.action_channels
        self.effect_channels = config.effect_channels
        n_a, n_e = len(config.action_channels), len(config.effect_channels)
        for name, width in (("action_scale", n_a), ("effect_scale", n_e)):
            if len(getattr(normaliser, name)) != width:
                raise ValueError(f"normaliser {name} must have {width} channels as the config does")
        self.image_encoder = image_encoder()
        self.action_encoder = _dense((n_a + 1, *ENCODER_WIDTHS), activate_last=True)
        self.effect_encoder = _dense((n_e + 1, *ENCODER_WIDTHS), activate_last=False)
        self.merge = nn.Linear(ENCODER_WIDTHS[-1] + IMAGE_FEATURES + 1, MERGE_WIDTH)
        last = config.leaky_output
        self.action_decoder = _dense((MERGE_WIDTH, *DECODER_WIDTHS, 2 * n_a), last)
        self.effect_decoder = _dense((MERGE_WIDTH, *DECODER_WIDTHS, 2 * n_e), last)
        self.sigma_floor = config.sigma_floor
        for name in ("action_scale", "effect_scale", "image_mean", "image_std"):
            values = torch.tensor(getattr(normaliser, name), dtype=torch.float32)
            self.register_buffer(name, values, persistent=False)
        self.apply(_initialise)

    def encode(self, image: Float[Tensor, "b 2 48 48"]) -> Float[Tensor, "b 16"]:
        """f(γ_o): features (B, 16) of depth and mask (B, 2, 48, 48)."""
        mean, std = (v[:, None, None] for v in (self.image_mean, self.image_std))
        scaled = (image - mean) / std
        return self.image_encoder(scaled.contiguous(memory_format=torch.channels_last))

    def represent(self, observations: Observations) -> Float[Tensor, "b 128"]:
        """r: (B, 128), equations (2) and (3), the means taken over what is observed."""
        o = observations
        h_a = self.action_encoder(_with_time(o.action / self.action_scale, o.action_t))
        h_e = self.effect_encoder(_with_time(o.effect / self.effect_scale, o.effect_t))
        w_1 = o.weight[:, None]
        return w_1 * _mean(h_a, o.action_mask) + (1 - w_1) * _mean(h_e, o.effect_mask)

    def decode(
        self,
        r: Float[Tensor, "b 128"],
        features: Float[Tensor, "#b 16"],
        t_target: Float[Tensor, "b t"],
    ) -> tuple[Float[Tensor, "b t _"], ...]:
        """(μ_a, σ_a, μ_e, σ_e), each (B, T, C) and standardised, of r (B, 128) at t_target (B, T).

        The merge layer has no activation, so it folds exactly into each decoder's first layer, and
        of the sum only the column of t differs between the targets of one query. Folding pays from
        some tens of targets on.
        """
        known = torch.cat([r, features.expand(len(r), -1)], dim=1)
        folds = t_target.numel() >= FOLD_FROM_TARGETS
        outputs = []
        for decoder in (self.action_decoder, self.effect_decoder):
            first = decoder[0]
            if folds:
                weight = first.weight @ self.merge.weight
                bias = first.weight @ self.merge.bias + first.bias
                base = F.linear(known, weight[:, :-1], bias)
                hidden = base[:, None] + t_target[..., None] * weight[:, -1]
            else:
                known_at_t = known[:, None].expand(-1, t_target.shape[1], -1)
                hidden = first(self.merge(_with_time(known_at_t, t_target)))
            mean, raw = decoder[1:](hidden).chunk(2, dim=-1)
            outputs += [mean, self.sigma_floor + F.softplus(raw)]
        return tuple(outputs)

    def forward(
        self, image: Tensor, observations: Observations, t_target: Tensor
    ) -> tuple[Tensor, ...]:
        """(μ_a, σ_a, μ_e, σ_e) in standardised units; what the loss is computed on."""
        return self.decode(self.represent(observations), self.encode(image), t_target)

    def predict(self, features: Tensor, observations: Observations, t_target: Tensor) -> Prediction:
        """Mean and σ (B, T, C) at t_target (B, T); features (B, 16), or (1, 16) for all."""
        mu_a, sigma_a, mu_e, sigma_e = self.decode(self.represent(observations), features, t_target)
        a, e = self.action_scale, self.effect_scale
        return Prediction(mu_a * a, sigma_a * a, mu_e * e, sigma_e * e)

    def loss(
        self,
        image: Tensor,
        observations: Observations,
        t_target: Tensor,
        action: Tensor,
        effect: Tensor,
    ) -> Tensor:
        """Negative log-likelihood (Section 3.2) of the targets (B, T, C), per value."""
        mu_a, sigma_a, mu_e, sigma_e = self(image, observations, t_target)
        nll_a = _nll(action / self.action_scale, mu_a, sigma_a)
        nll_e = _nll(effect / self.effect_scale, mu_e, sigma_e)
        return (nll_a.mean() + nll_e.mean()) / 2


def _with_time(values: Tensor, t: Tensor) -> Tensor:
    return torch.cat([values, t[..., None]], dim=-1)


def _mean(h: Tensor, mask: Tensor) -> Tensor:
    """Mean over the observed: (B, n, H), (B, n) → (B, H); zero where nothing is observed."""
    seen = mask[..., None].to(h.dtype)
    return (h * seen).sum(dim=1) / seen.sum(dim=1).clamp_min(1)


def _nll(y: Tensor, mean: Tensor, std: Tensor) -> Tensor:
    return 0.5 * ((y - mean) / std) ** 2 + std.log() + 0.5 * math.log(2 * math.pi)


def _initialise(module: nn.Module) -> None:
    # He for the leaky layers; PyTorch's default never learns the direction of a push.
    if isinstance(module, nn.Linear | nn.Conv2d):
        nn.init.kaiming_normal_(module.weight, a=0.01, nonlinearity="leaky_relu")
        nn.init.zeros_(module.bias)
