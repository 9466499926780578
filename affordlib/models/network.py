"""What all networks share: scales, ranges, frame and loss; subclasses are the architectures."""

from __future__ import annotations

import math
import warnings
from abc import ABC, abstractmethod
from dataclasses import dataclass, fields

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from affordlib import checked
from affordlib.geometry import rotate_channels, xy_columns
from affordlib.interactions.dataset import Scaler, touches_border
from affordlib.models.frame import (
    FRAMES,
    heading,
    inverse,
    turn_image,
    turn_observations,
    turn_prediction,
)
from affordlib.types import Observations, Prediction, check_count, check_within

PHASE_TOLERANCE = 1e-5
RADIUS_TOLERANCE_M = 0.02
_END_PHASE = 1e-3


class OutOfRangeWarning(UserWarning):
    """A network is asked about what it was not trained on, and its answer is a guess."""


@checked
@dataclass(frozen=True)
class NetworkConfig:
    """Channels and frame of a network.

    frame: "table", or "push" to turn everything into the direction of the push, see `frame.py`.
    sigma_floor is in standardised units. temperature multiplies σ of each effect channel
    (none given: by 1), see `calibration.py`.
    """

    action_channels: tuple[str, ...] = ("x", "y")
    effect_channels: tuple[str, ...] = ("x", "y")
    sigma_floor: float = 0.1
    frame: str = "table"
    temperature: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        if self.frame not in FRAMES:
            raise ValueError(f"frame must be one of {FRAMES}, got {self.frame!r}")
        for name in ("action_channels", "effect_channels"):
            channels = tuple(getattr(self, name))
            if not channels:
                raise ValueError(f"{name} must name at least one channel, got none")
            if self.frame == "push" and not xy_columns(channels):
                raise ValueError(f'{name} must name x and y for frame="push", got {channels}')
            object.__setattr__(self, name, channels)
        for size in fields(self):
            if size.type == "int":
                check_within(size.name, check_count(size.name, getattr(self, size.name)), 1, 4096)
        if not 0 < self.sigma_floor < 10:
            raise ValueError(f"sigma_floor must lie in (0, 10), got {self.sigma_floor!r}")
        temperature = tuple(self.temperature) or (1.0,) * len(self.effect_channels)
        if len(temperature) != len(self.effect_channels) or not min(temperature) > 0:
            raise ValueError(
                f"temperature must hold {len(self.effect_channels)} positive numbers, one per "
                f"effect channel, got {self.temperature!r}"
            )
        object.__setattr__(self, "temperature", temperature)


class EffectNetwork(nn.Module, ABC):
    """A network that satisfies `EffectModel`.

    Inputs and outputs are in metres and radians, in the frame of the table; scaling by the
    scaler and turning into the network's frame happen inside. In the frame of the push an
    encoded image is what can be read of it before the direction is known.
    """

    @checked
    def __init__(self, config: NetworkConfig, scaler: Scaler) -> None:
        super().__init__()
        self.config, self.scaler = config, scaler
        self.action_channels = config.action_channels
        self.effect_channels = config.effect_channels
        self.sigma_floor, self.temperature = config.sigma_floor, config.temperature
        for kind in ("action", "effect"):
            width = len(getattr(config, f"{kind}_channels"))
            if len(getattr(scaler, f"{kind}_scale")) != width:
                raise ValueError(
                    f"scaler {kind}_scale must have {width} channels as the config does"
                )
        for name in ("action_scale", "effect_scale", "image_mean", "image_std"):
            values = torch.tensor(getattr(scaler, name), dtype=torch.float32)
            self.register_buffer(name, values, persistent=False)

    @abstractmethod
    def features(self, scaled_image: Float[Tensor, "b 2 n n"]) -> Float[Tensor, "b f"]:
        """What the network reads from a standardised image."""

    @abstractmethod
    def outputs(
        self,
        features: Float[Tensor, "#b f"],
        observations: Observations,
        t_target: Float[Tensor, "b t"],
    ) -> tuple[Float[Tensor, "b t _"], ...]:
        """(μ_a, σ_a, μ_e, σ_e), each (B, T, C), standardised, in the network's frame."""

    @property
    def _channels(self) -> tuple[tuple[str, ...], tuple[str, ...]]:
        return self.action_channels, self.effect_channels

    def _scaled(self, image: Tensor) -> Tensor:
        mean, std = (v[:, None, None] for v in (self.image_mean, self.image_std))
        return (image - mean) / std

    def look(self, image: Float[Tensor, "b 2 n n"]) -> Float[Tensor, "b f"]:
        """What is read of an image before the direction is known: here, the image itself."""
        return image.flatten(1)

    def turned_features(
        self, seen: Float[Tensor, "#b f"], heading: Float[Tensor, "b 2"]
    ) -> Float[Tensor, "b f"]:
        """The features of what `look` has seen, turned by the headings: here, the image turned."""
        pixels = math.isqrt(seen.shape[1] // 2)
        image = turn_image(seen.reshape(-1, 2, pixels, pixels), heading)
        return self.features(self._scaled(image))

    def _see(self, image: Tensor) -> Tensor:
        push = self.config.frame == "push"
        return self.look(image) if push else self.features(self._scaled(image))

    def _enter(self, seen: Tensor, o: Observations) -> tuple[Tensor, Observations, Tensor]:
        """Features and observations in the frame of the push, and its headings (B, 2)."""
        towards = heading(o, *self._channels)
        back = inverse(towards)
        turned = turn_observations(o, back, *self._channels)
        return self.turned_features(seen, back), turned, towards

    def encode(self, image: Float[Tensor, "b 2 n n"]) -> Float[Tensor, "b f"]:
        """Features (B, F) of depth and mask (B, 2, 48, 48).

        Raises ValueError where the object is unlike those the network was trained on.
        """
        self._check_image(image)
        return self._see(image)

    def predict(self, features: Tensor, observations: Observations, t_target: Tensor) -> Prediction:
        """Mean and σ (B, T, C) at t_target (B, T); features (B, F), or (1, F) for all.

        Raises ValueError for phases outside [0, 1], and for actions that start or end elsewhere
        than those trained on. Warns (`OutOfRangeWarning`) of effects at t = 1 that are farther or
        less far than those trained on: a planner may pass there on its way.
        """
        self._check_phase(t_target)
        self._check_action(observations)
        self._check_effect(observations)
        push = self.config.frame == "push"
        if push:
            features, observations, towards = self._enter(features, observations)
        mu_a, sigma_a, mu_e, sigma_e = self.outputs(features, observations, t_target)
        a, e = self.action_scale, self.effect_scale
        prediction = Prediction(
            mu_a * a, sigma_a * a, mu_e * e, sigma_e * e * e.new_tensor(self.temperature)
        )
        return turn_prediction(prediction, towards, *self._channels) if push else prediction

    def forward(
        self,
        image: Tensor,
        observations: Observations,
        t_target: Tensor,
    ) -> tuple[Tensor, ...]:
        """(μ_a, σ_a, μ_e, σ_e) in standardised units, in the network's frame."""
        features = self._see(image)
        if self.config.frame == "push":
            features, observations, _ = self._enter(features, observations)
        return self.outputs(features, observations, t_target)

    def loss(
        self,
        image: Tensor,
        observations: Observations,
        t_target: Tensor,
        action: Tensor,
        effect: Tensor,
        beta: float = 0.0,
    ) -> Tensor:
        """Negative log-likelihood (Section 3.2) of the targets (B, T, C), per value.

        The likelihood is of the standardised values, in the network's frame. beta weighs each value
        by σ^(2 beta), so that what is hard to predict is not given up for a large σ: with 0 it is
        the likelihood, with 1 means learn as from the squared error (Seitzer et al., On the
        pitfalls of heteroscedastic uncertainty estimation, ICLR 2022).
        """
        mu_a, sigma_a, mu_e, sigma_e = self(image, observations, t_target)
        if self.config.frame == "push":
            back = inverse(heading(observations, *self._channels))[:, None]
            action = rotate_channels(action, self.action_channels, back, absolute_yaw=True)
            effect = rotate_channels(effect, self.effect_channels, back, absolute_yaw=False)
        nll_a = gaussian_nll(action / self.action_scale, mu_a, sigma_a)
        nll_e = gaussian_nll(effect / self.effect_scale, mu_e, sigma_e)
        if beta:
            nll_a = nll_a * sigma_a.detach() ** (2 * beta)
            nll_e = nll_e * sigma_e.detach() ** (2 * beta)
        return (nll_a.mean() + nll_e.mean()) / 2

    def _check_image(self, image: Tensor) -> None:
        n, mask = self.scaler, image[:, 1]
        if n.mask_share is None:
            return
        low, high = n.mask_share
        share, at_edge = mask.mean(dim=(1, 2)), touches_border(mask)
        strange = ~((share > low / 2) & (share < 1.5 * high))
        if strange.any():
            raise ValueError(
                f"image {int(strange.nonzero()[0])}: the object covers "
                f"{float(share[strange][0]):.1%} of it, those trained on {low:.1%} to {high:.1%}; "
                "train on such objects first"
            )
        if not n.at_edge and at_edge.any():
            raise ValueError(
                f"image {int(at_edge.nonzero()[0])}: the object reaches its edge, none trained on "
                "does; centre the crop on the object, or train on such objects first"
            )

    @staticmethod
    def _check_phase(t_target: Tensor) -> None:
        low, high = t_target.detach().aminmax()
        if not (low > -PHASE_TOLERANCE and high < 1 + PHASE_TOLERANCE):
            raise ValueError(
                f"t_target must lie in [0, 1], the phase of the whole action, got {float(low):.3f} "
                f"to {float(high):.3f}"
            )

    def _check_action(self, o: Observations) -> None:
        n, plane = self.scaler, xy_columns(self.action_channels)
        if n.start_radius_m is None or not plane:
            return
        radius = o.action.detach()[..., plane].norm(dim=-1)
        for name, (low, high), at_end in (
            ("starts", n.start_radius_m, o.action_t < _END_PHASE),
            ("ends", n.end_radius_m, o.action_t > 1 - _END_PHASE),
        ):
            near = (radius > low - RADIUS_TOLERANCE_M) & (radius < high + RADIUS_TOLERANCE_M)
            strange = ~near & at_end & o.action_mask
            if strange.any():
                raise ValueError(
                    f"an observed action {name} {float(radius[strange][0]):.3f} m from the "
                    f"object's centre, those trained on {low:.3f} to {high:.3f} m; train on such "
                    "actions first"
                )

    def _check_effect(self, o: Observations) -> None:
        n, plane = self.scaler, xy_columns(self.effect_channels)
        if n.effect_radius_m is None or not plane or not o.effect_mask.any():
            return
        low, high = n.effect_radius_m
        radius = o.effect.detach()[..., plane].norm(dim=-1)
        near = (radius > low - RADIUS_TOLERANCE_M) & (radius < high + RADIUS_TOLERANCE_M)
        strange = ~near & (o.effect_t > 1 - _END_PHASE) & o.effect_mask
        if strange.any():
            warnings.warn(
                f"an observed effect ends {float(radius[strange][0]):.3f} m away, those trained "
                f"on {low:.3f} to {high:.3f} m; what is foreseen from it is a guess",
                OutOfRangeWarning,
                stacklevel=3,
            )


def with_time(values: Tensor, t: Tensor) -> Tensor:
    """Values (..., C) and their phases (...): (..., C + 1)."""
    return torch.cat([values, t[..., None]], dim=-1)


def masked_mean(h: Float[Tensor, "b n c"], mask: Bool[Tensor, "b n"]) -> Float[Tensor, "b c"]:
    """Mean (B, H) over the observed of (B, n, H); zero where nothing is observed."""
    seen = mask[..., None].to(h.dtype)
    return (h * seen).sum(dim=1) / seen.sum(dim=1).clamp_min(1)


def mean_code(
    encoder: nn.Module, seen: Float[Tensor, "b n c"], mask: Bool[Tensor, "b n"]
) -> Float[Tensor, "b h"]:
    """Mean (B, H) of the codes of the observed of (B, n, C), each with its phase; zero of none.

    Asked without gradients, what no query observes is not encoded: a plan is told no effects.
    """
    if not torch.is_grad_enabled() and not mask.any():
        seen, mask = seen[:, :0], mask[:, :0]
    return masked_mean(encoder(seen), mask)


def gaussian_nll(y: Tensor, mean: Tensor, std: Tensor) -> Tensor:
    """-log N(y; mean, std²), elementwise."""
    return 0.5 * ((y - mean) / std) ** 2 + std.log() + 0.5 * math.log(2 * math.pi)


def he_initialise(module: nn.Module) -> None:
    """He's initialisation for leaky layers; PyTorch's default never learns a push's direction."""
    if isinstance(module, nn.Linear | nn.Conv2d):
        nn.init.kaiming_normal_(module.weight, a=0.01, nonlinearity="leaky_relu")
        nn.init.zeros_(module.bias)
