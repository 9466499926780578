"""Models of the effects of actions: the interface that planners see, and networks' base class.

A network standardises, checks the training domain, rotates into its frame, and has the loss.

In the push-aligned frame, everything is rotated so that the push direction is always angle 0.
Pushing works the same in all directions on the table, so a model in this frame need not learn
rotations. Image, action and effect are rotated into the frame, predictions are rotated back. A
rotation is given by (cos α, sin α), one per query.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from itertools import pairwise
from typing import Any, Protocol, runtime_checkable

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor, nn

from affordlib import checked
from affordlib.geometry import rotate_channels, xy_columns
from affordlib.interactions.dataset import Batch, InteractionTensors, Scaler
from affordlib.models.domain import TrainingDomain
from affordlib.primitives import Primitive
from affordlib.types import (
    ACTION_CHANNELS,
    HasChannels,
    Observations,
    Prediction,
    check_choice,
    check_count,
    check_within,
)

_SHORTEST_M = 1e-3

Channels = tuple[str, ...]


@runtime_checkable
class EffectModel(HasChannels, Protocol):
    """A model of the effects of actions; inputs and outputs are in metres, radians and phase.

    Both methods are differentiable in their inputs.
    """

    def encode(self, image: Tensor) -> Tensor:
        """Features (B, F) of images (B, 2, 48, 48)."""
        ...

    def predict(self, features: Tensor, observations: Observations, t_target: Tensor) -> Prediction:
        """Mean and σ (B, T, C) at t_target (B, T) for B queries; features (B, F) or (1, F)."""
        ...


@checked
def condition_on_primitives(model: EffectModel, actions: Sequence[Primitive]) -> Observations:
    """Observe each commanded action at t = 0 and t = 1, and no effect: B = len(actions)."""
    if not actions:
        raise ValueError("actions must hold at least one action, got none")
    columns = [ACTION_CHANNELS.index(name) for name in model.action_channels]
    action = np.stack([one.path((0.0, 1.0)) for one in actions])[..., columns]
    t = torch.tensor([0.0, 1.0]).expand(len(actions), 2)
    return Observations.of(model, action=(t, torch.as_tensor(action, dtype=torch.float32)))


@checked
def condition_on_final_effect(model: EffectModel, effect: Tensor) -> Observations:
    """Observe the effect (B, C_e) at t = 1 and no action (w₁ = 0); differentiable in the effect."""
    return Observations.of(model, effect=(effect.new_ones(len(effect), 1), effect[:, None]))


@checked
@dataclass(frozen=True)
class NetworkConfig:
    """Channels and frame of a network."""

    action_channels: tuple[str, ...] = ("x", "y")
    effect_channels: tuple[str, ...] = ("x", "y")
    sigma_floor: float = 0.1  # initial lower bound of σ, in standardised units
    frame: str = "table"  # or "push", the push-aligned frame

    def __post_init__(self) -> None:
        check_choice("frame", self.frame, ("table", "push"))
        for name in ("action_channels", "effect_channels"):
            channels = tuple(getattr(self, name))
            if not channels:
                raise ValueError(f"{name} must name at least one channel, got none")
            if self.frame == "push" and not xy_columns(channels):
                raise ValueError(f'{name} must name x and y for frame="push", got {channels}')
            object.__setattr__(self, name, channels)
        for size in fields(self):
            if type(size.default) is int:
                check_count(size.name, getattr(self, size.name), 1, 4096)
        check_within("sigma_floor", self.sigma_floor, 1e-6, 10.0)


NETWORKS: dict[str, tuple[type["EffectNetwork"], type[NetworkConfig]]] = {}
"""Network and configuration by the name that checkpoints store."""


def network(name: str, config: type[NetworkConfig]) -> Callable[[type], type]:
    """Class decorator that registers a network and its configuration under a name."""

    def register(made: type) -> type:
        NETWORKS[name] = made, config
        return made

    return register


class EffectNetwork(nn.Module, ABC):
    """A network that satisfies `EffectModel`.

    Inputs and outputs are in metres and radians, in the table's frame. A subclass implements
    `features` and `outputs` in standardised units and its own frame, creates its layers in
    `make_layers`, and is registered by `network`. Buffers: sigma_floor, which decreases in
    training; sigma_scale (C_e,), factors on σ of the effect channels, see `fit_sigma_scale`.
    """

    @checked
    def __init__(
        self, config: NetworkConfig, scaler: Scaler, domain: TrainingDomain | None = None
    ) -> None:
        super().__init__()
        self.config, self.scaler, self.domain = config, scaler, domain or TrainingDomain()
        self.action_channels = config.action_channels
        self.effect_channels = config.effect_channels
        self._channels = config.action_channels, config.effect_channels
        for kind in ("action", "effect"):
            width = len(getattr(config, f"{kind}_channels"))
            if len(getattr(scaler, f"{kind}_scale")) != width:
                raise ValueError(
                    f"scaler {kind}_scale must have {width} values, one per channel of the config"
                )
        for name, values in vars(scaler).items():
            self.register_buffer(name, torch.tensor(values, dtype=torch.float32), persistent=False)
        # Double precision, so that a training continues from exactly the floor where it stopped.
        floor = torch.tensor(config.sigma_floor, dtype=torch.float64)
        self.register_buffer("sigma_floor", floor)
        self.register_buffer("sigma_scale", torch.ones(len(config.effect_channels)))
        self.make_layers(config)

    def make_layers(self, config: Any) -> None:
        """Create the layers that the configuration describes."""

    def prepare(self, training: InteractionTensors) -> None:
        """Set what training data determine without an optimiser; by default nothing."""

    def basis(self, image: Float[Tensor, "b 2 n n"]) -> Float[Tensor, "b f"]:
        """What is computed of images before the push direction is known: here, themselves."""
        return image.flatten(1)

    @abstractmethod
    def features(
        self, basis: Float[Tensor, "#b g"], rotation: Float[Tensor, "b 2"] | None = None
    ) -> Float[Tensor, "b f"]:
        """Image features f(γ_o) of images with a `basis`, rotated by (cos α, sin α) if given."""

    @abstractmethod
    def outputs(
        self,
        features: Float[Tensor, "#b f"],
        observations: Observations,
        t_target: Float[Tensor, "b t"],
    ) -> tuple[Float[Tensor, "b t _"], ...]:
        """(μ_a, σ_a, μ_e, σ_e), each (B, T, C), standardised, in the network's frame."""

    def represent(
        self, observations: Observations, effects: Tensor | None = None
    ) -> Float[Tensor, "b w"]:
        """Representation r (B, W), equations (2) and (3); the means run over the observed values.

        Requires an `action_encoder` and an `effect_encoder`. effects: input of the latter, by
        default the standardised effects with their phases.
        """
        o = observations
        actions = with_time(o.action / self.action_scale, o.action_t)
        if effects is None:
            effects = with_time(o.effect / self.effect_scale, o.effect_t)
        r_a = masked_mean(self.action_encoder(actions), o.action_mask)
        r_e = masked_mean(self.effect_encoder(effects), o.effect_mask)
        w_1 = o.weight[:, None]
        return w_1 * r_a + (1 - w_1) * r_e

    def _scaled(self, image: Tensor) -> Tensor:
        mean, std = (v[:, None, None] for v in (self.image_mean, self.image_std))
        return (image - mean) / std

    def encode(self, image: Float[Tensor, "b 2 n n"], check: bool = True) -> Float[Tensor, "b f"]:
        """Features (B, F) of depth and mask (B, 2, 48, 48); in the push frame, their basis.

        Raises ValueError, if `check`, for an object outside the training domain.
        """
        if check:
            self.domain.check_image(image)
        basis = self.basis(image)
        return basis if self.config.frame == "push" else self.features(basis)

    def predict(
        self, features: Tensor, observations: Observations, t_target: Tensor, frame: str = "table"
    ) -> Prediction:
        """Mean and σ (B, T, C) at t_target (B, T); features (B, F), or (1, F) for all.

        frame: axes of the prediction, those of the "table" or of each "push". In the axes of
        another frame than the network's, σ lacks the correlation of x and y. Raises ValueError or
        warns outside the training domain, as `TrainingDomain.check_query` does.
        """
        self.domain.check_query(observations, t_target, *self._channels)
        (mu_a, sigma_a, mu_e, sigma_e), direction = self._decode(features, observations, t_target)
        a, e = self.action_scale, self.effect_scale
        prediction = Prediction(mu_a * a, sigma_a * a, mu_e * e, sigma_e * e * self.sigma_scale)
        if frame == self.config.frame:
            return prediction
        if direction is None:
            direction = inverse(push_direction(observations, *self._channels))
        return rotate_prediction(prediction, direction, *self._channels)

    def forward(
        self, image: Tensor, observations: Observations, t_target: Tensor
    ) -> tuple[Tensor, ...]:
        """(μ_a, σ_a, μ_e, σ_e) in standardised units, in the network's frame."""
        return self._decode(self.encode(image, check=False), observations, t_target)[0]

    def _decode(
        self, encoded: Tensor, observations: Observations, t_target: Tensor
    ) -> tuple[tuple[Tensor, ...], Tensor | None]:
        """`outputs` for encoded images, and the direction (B, 2) of the push frame, if used."""
        if self.config.frame == "table":
            return self.outputs(encoded, observations, t_target), None
        o, direction = observations, push_direction(observations, *self._channels)
        back = inverse(direction)
        action, effect = rotate_both(o.action, o.effect, back, *self._channels)
        aligned = replace(o, action=action, effect=effect)
        return self.outputs(self.features(encoded, back), aligned, t_target), direction

    def loss(self, batch: Batch, beta: float = 0.0) -> Float[Tensor, ""]:
        """Negative log-likelihood (Section 3.2) of a batch's targets.

        The mean over the action's values and the mean over the effect's count half each, both
        standardised and in the network's frame. beta weights each value by σ^(2 beta), so that the
        network does not ignore values that are hard to predict by raising σ: 0 is the likelihood, 1
        trains the means as the squared error does (Seitzer et al., On the pitfalls of
        heteroscedastic uncertainty estimation, ICLR 2022).
        """
        encoded, action, effect = self.encode(batch.image, check=False), batch.action, batch.effect
        outputs, direction = self._decode(encoded, batch.observations, batch.t_target)
        mu_a, sigma_a, mu_e, sigma_e = outputs
        if direction is not None:
            action, effect = rotate_both(action, effect, inverse(direction), *self._channels)
        nll_a = gaussian_nll(action / self.action_scale, mu_a, sigma_a)
        nll_e = gaussian_nll(effect / self.effect_scale, mu_e, sigma_e)
        if beta:
            nll_a = nll_a * sigma_a.detach() ** (2 * beta)
            nll_e = nll_e * sigma_e.detach() ** (2 * beta)
        return (nll_a.mean() + nll_e.mean()) / 2


def with_time(values: Tensor, t: Tensor) -> Tensor:
    """Append phases (...) to values (..., C): (..., C + 1)."""
    return torch.cat([values, t[..., None]], dim=-1)


def masked_mean(h: Float[Tensor, "b n c"], mask: Bool[Tensor, "b n"]) -> Float[Tensor, "b c"]:
    """Mean (B, H) of the observed values of (B, n, H); zero where none is observed."""
    seen = mask[..., None].to(h.dtype)
    return (h * seen).sum(dim=1) / seen.sum(dim=1).clamp_min(1)


def gaussian_nll(y: Tensor, mean: Tensor, std: Tensor) -> Tensor:
    """-log N(y; mean, std²), elementwise."""
    return 0.5 * ((y - mean) / std) ** 2 + std.log() + 0.5 * math.log(2 * math.pi)


def dense(*widths: int, activation: type[nn.Module] = nn.SiLU) -> list[nn.Module]:
    """Linear layers of the given widths, with activations between them."""
    layers: list[nn.Module] = []
    for n_in, n_out in pairwise(widths):
        layers += [nn.Linear(n_in, n_out), activation()]
    return layers[:-1]


def he_initialise(module: nn.Module) -> None:
    """He initialisation for LeakyReLU; PyTorch's default does not learn the direction of a push."""
    if isinstance(module, nn.Linear | nn.Conv2d):
        nn.init.kaiming_normal_(module.weight, a=0.01, nonlinearity="leaky_relu")
        nn.init.zeros_(module.bias)


def push_direction(
    observations: Observations, action_channels: Channels, effect_channels: Channels
) -> Float[Tensor, "b 2"]:
    """Directions (B, 2), as unit vectors, of the observed pushes; differentiable.

    An action's direction is from its first to its last observation, or else from its first
    observation through the object's centre. Without an observed action (the inverse query) it is
    the direction of the last observed effect. Vectors below 1 mm have no direction; if all are
    shorter, the frame is the table's.
    """
    o = observations
    action = o.action[..., xy_columns(action_channels)]
    effect = o.effect[..., xy_columns(effect_channels)]
    acts = o.action_mask & (o.weight > 0)[:, None]
    moves = o.effect_mask & (o.weight < 1)[:, None]
    first, last = _extreme(action, -o.action_t, acts), _extreme(action, o.action_t, acts)
    direction = torch.zeros_like(first)
    direction[:, 0] = 1
    for vector in (_extreme(effect, o.effect_t, moves), -first, last - first):
        long = vector.detach().norm(dim=-1, keepdim=True) > _SHORTEST_M
        direction = torch.where(long, vector, direction)
    return direction / direction.norm(dim=-1, keepdim=True)


def _extreme(
    values: Float[Tensor, "b n 2"], order: Float[Tensor, "b n"], seen: Bool[Tensor, "b n"]
) -> Float[Tensor, "b 2"]:
    """The observed value of greatest order; zero where nothing is observed."""
    at = order.masked_fill(~seen, -torch.inf).argmax(dim=1)
    value = values[torch.arange(len(values), device=values.device), at]
    return torch.where(seen.any(dim=1, keepdim=True), value, 0.0)


def inverse(rotation: Tensor) -> Tensor:
    """Inverse rotations (B, 2)."""
    return torch.stack([rotation[..., 0], -rotation[..., 1]], dim=-1)


def rotate_image(image: Float[Tensor, "#b 2 n n"], rotation: Tensor) -> Float[Tensor, "b 2 n n"]:
    """Rotate images (B or 1, 2, n, n) by (B, 2), bilinearly; border pixels are repeated outside."""
    cos, sin = rotation.unbind(-1)
    # This maps coordinates of the rotated image to those of the image; rows run along -y.
    rows = [torch.stack([cos, -sin], -1), torch.stack([sin, cos], -1)]
    matrix = F.pad(torch.stack(rows, dim=1), (0, 1))
    image = image.expand(len(rotation), -1, -1, -1)
    grid = F.affine_grid(matrix, list(image.shape), align_corners=False)
    return F.grid_sample(image, grid, padding_mode="border", align_corners=False)


def rotate_both(
    action: Tensor, effect: Tensor, rotation: Tensor, *channels: Channels
) -> tuple[Tensor, Tensor]:
    """Rotate actions and effects (B, n, C) by (B, 2)."""
    r, (of_action, of_effect) = rotation[:, None], channels
    action = rotate_channels(action, of_action, r, absolute_yaw=True)
    return action, rotate_channels(effect, of_effect, r, absolute_yaw=False)


def rotate_prediction(p: Prediction, rotation: Tensor, *channels: Channels) -> Prediction:
    """Rotate a prediction by (B, 2); the correlation of x and y that this introduces is dropped."""
    action, effect = rotate_both(p.action_mean, p.effect_mean, rotation, *channels)
    pairs = zip((p.action_std, p.effect_std), channels, strict=True)
    action_std, effect_std = (_rotate_std(std, each, rotation[:, None]) for std, each in pairs)
    return Prediction(action, action_std, effect, effect_std)


def _rotate_std(std: Tensor, channels: Channels, rotation: Tensor) -> Tensor:
    cos2, sin2 = rotation.square().unbind(-1)
    columns = list(std.unbind(-1))
    i, j = xy_columns(channels)
    u, v = columns[i].square(), columns[j].square()
    columns[i], columns[j] = (cos2 * u + sin2 * v).sqrt(), (sin2 * u + cos2 * v).sqrt()
    return torch.stack(columns, dim=-1)
