"""Tensors of a data set, their split into training, validation and test, scaling, and batches.

The split is 80/10/10 inside each of 10 folds (Section 4.3 of the paper). In its Section 3.2, k
observations, k uniform in 1 … obs_max, are taken at random phases of a random trajectory. A sampler
takes the interactions of a batch, n_targets, obs_max and a generator, and returns a `Batch`.
"""

import copy
import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Self

import numpy as np
import torch

from affordlib.geometry import rotate_channels
from affordlib.types import (
    CROP_WIDTH_M,
    HasChannels,
    Observations,
    check_array,
    check_count,
    check_finite,
    check_within,
)

if TYPE_CHECKING:
    import xarray


def valid_interactions(data: "xarray.Dataset", interactions: np.ndarray) -> np.ndarray:
    """Select the interactions that the arm could reach and that have no simulator faults."""
    return interactions[(data["reached"].values & ~data["fault"].values)[interactions]]


def check_numbers(name: str, interactions: np.ndarray) -> None:
    """Raise ValueError unless these are the numbers (n,) of interactions, n ≥ 1."""
    if interactions.ndim != 1 or interactions.dtype.kind not in "iu" or not len(interactions):
        raise ValueError(f"{name} must be numbers (n,) of interactions, got {interactions!r:.80}")


def check_fits(name: str, tensors: "InteractionTensors", model: HasChannels) -> None:
    """Raise ValueError unless tensors have a model's channels, in its order, and image width."""
    for kind in ("action_channels", "effect_channels"):
        own, wanted = getattr(tensors, kind), getattr(model, kind)
        if own != wanted:
            raise ValueError(f"{name} has the {kind} {own}, but the model needs {wanted}")
    if domain := getattr(model, "domain", None):
        domain.check_width(name, tensors.image_width_m)


@dataclass(frozen=True)
class Split:
    """Interaction numbers for training, validation and test."""

    train: np.ndarray
    validation: np.ndarray
    test: np.ndarray


def split_interactions(n: int, seed: int = 0, fold: int = 0, n_folds: int = 10) -> Split:
    """Shuffle interactions 0 … n-1 into `n_folds` blocks: one for test, the next for validation.

    Each interaction has its own object, so the split is by object.
    """
    n_folds = check_count("n_folds", n_folds, 3, check_count("n", n, 3, 10_000_000))
    fold = check_count("fold", fold, 0, n_folds - 1)
    rng = np.random.default_rng(check_count("seed", seed, least=0))
    blocks = np.array_split(rng.permutation(n), n_folds)
    test, validation = fold, (fold + 1) % n_folds
    train = np.concatenate([b for k, b in enumerate(blocks) if k not in (test, validation)])
    return Split(np.sort(train), np.sort(blocks[validation]), np.sort(blocks[test]))


@dataclass(frozen=True)
class Scaler:
    """Scales that normalise channels to unit RMS without an offset; x and y share one scale.

    An action channel that is always zero keeps its unit: a query may have another value there.
    """

    action_scale: tuple[float, ...]
    effect_scale: tuple[float, ...]
    image_mean: tuple[float, ...]
    image_std: tuple[float, ...]

    def __post_init__(self) -> None:
        for name in ("action_scale", "effect_scale", "image_std"):
            if not all(check_finite(name, value) > 0 for value in getattr(self, name)):
                raise ValueError(f"{name} must be positive, got {getattr(self, name)!r}")
        check_array("image_mean", self.image_mean)

    @classmethod
    def fit(cls, tensors: "InteractionTensors") -> Self:
        """Compute the scales of training data: RMS of the channels, mean and std of the image."""
        image, scales = tensors.image.double(), []
        for kind, if_zero in (("action", 1.0), ("effect", 1e-6)):
            rms = getattr(tensors, kind).double().square().mean(dim=(0, 1)).sqrt()
            names = getattr(tensors, f"{kind}_channels")
            plane = [k for k, name in enumerate(names) if name in ("x", "y")]
            rms[plane] = rms[plane].square().mean().sqrt()
            scales.append(torch.where(rms > 1e-6, rms, if_zero))
        scales += [image.mean(dim=(0, 2, 3)), image.std(dim=(0, 2, 3)).clamp_min(1e-6)]
        return cls(*(tuple(scale.tolist()) for scale in scales))


_BY_INTERACTION = ("image", "action", "effect", "stop_phase")


@dataclass(frozen=True)
class InteractionTensors:
    """Interactions as tensors [m, rad], relative to the start; ValueError for other units."""

    image: torch.Tensor  # (N, 2, 48, 48), depth [m] and mask
    phase: torch.Tensor  # (S,)
    action: torch.Tensor  # (N, S, C_a)
    effect: torch.Tensor  # (N, S, C_e)
    action_channels: tuple[str, ...]
    effect_channels: tuple[str, ...]
    stop_phase: torch.Tensor | None = None  # (N,), factor on `phase`; default 1
    image_width_m: float = CROP_WIDTH_M  # of the square that the images show

    def __post_init__(self) -> None:
        if self.stop_phase is None:
            object.__setattr__(self, "stop_phase", torch.ones(len(self)))
        check_within("image_width_m", self.image_width_m, 0.01, 10.0, "m")
        t = self.phase
        n, steps = len(self.image), len(t)
        if t.ndim != 1 or steps < 2 or t[0] != 0 or t[-1] != 1 or (t.diff() <= 0).any():
            raise ValueError(f"phase must increase from 0 to 1, got {t.tolist()!r:.80}")
        shapes = {"image": (2, *self.image.shape[-1:] * 2), "stop_phase": ()}
        for kind in ("action", "effect"):
            shapes[kind] = steps, len(getattr(self, f"{kind}_channels"))
            if not shapes[kind][1]:
                raise ValueError(f"{kind}_channels must name at least one channel")
        for name, shape in shapes.items():
            if (got := tuple(getattr(self, name).shape)) != (n, *shape):
                raise ValueError(f"{name} must be {(n, *shape)}, got {got}")
        if n:
            self._check_values()

    def _check_values(self) -> None:
        """Raise ValueError for numbers that are not in metres, radians or relative to the start."""
        depth, mask = self.image.amax(dim=(0, 2, 3)).tolist()
        # Depth is measured from a plane 1 m above the table; an image of zeros hides the object.
        if not (depth == 0 or 0.5 < depth < 1.5) or not 0 <= mask <= 1:
            raise ValueError(
                "image must be depth in metres from a plane 1 m above the table, and the mask in "
                f"[0, 1], but their maxima are {depth:.3g} and {mask:.3g}"
            )
        for kind in ("action", "effect"):
            most = getattr(self, kind).abs().amax(dim=(0, 1)).tolist()
            for channel, value in zip(getattr(self, f"{kind}_channels"), most, strict=True):
                if not value <= (4 * math.pi if channel in ("yaw", "tilt", "pitch") else 2.0):
                    raise ValueError(
                        f"{kind} must be in metres and radians, relative to the object's pose at "
                        f"the start, but {channel!r} is up to {value:.3g}"
                    )
        if (start := float(self.effect[:, 0].abs().max())) > 1e-3:
            raise ValueError(f"effect must be 0 at phase 0, got {start:.3g}; subtract the start")

    @classmethod
    def from_dataset(
        cls,
        data: "xarray.Dataset",
        interactions: np.ndarray | None = None,
        action_channels: tuple[str, ...] = ("x", "y"),
        effect_channels: tuple[str, ...] = ("x", "y"),
    ) -> Self:
        """Build tensors of the valid ones of the given interactions (default: all).

        Sets that do not name the width of their images have 16 cm, of lever-ups 56 cm.
        """
        chosen = np.arange(data.sizes["interaction"]) if interactions is None else interactions
        check_numbers("interactions", chosen)
        part, values = data.isel(interaction=valid_interactions(data, chosen)), []
        for kind, names in (("action", action_channels), ("effect", effect_channels)):
            known = data.attrs[f"{kind}_channels"].split()
            if unknown := [name for name in names if name not in known]:
                raise ValueError(f"{kind}_channels {unknown} are not stored, only {known!r:.300}")
            columns = part[kind].values[..., [known.index(name) for name in names]]
            values.append(torch.from_numpy(np.ascontiguousarray(columns)))
        return cls(
            torch.from_numpy(part["image"].values),
            torch.from_numpy(part["phase"].values).float(),
            *values,
            tuple(action_channels),
            tuple(effect_channels),
            torch.from_numpy(part["stop_phase"].values).float(),
            float(part["image"].attrs.get("width_m", 0.16 if part.sizes["row"] < 128 else 0.56)),
        )

    def phases(self, at: torch.Tensor) -> torch.Tensor:
        """Return phases (N, k) of the samples with numbers (N, k), or (k,) for all interactions."""
        return self.phase[at] * self.stop_phase[:, None]

    def action_at(self, at: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return phases (N, k) and actions (N, k, C) of samples, numbered as in `phases`."""
        return self.phases(at), self.action[torch.arange(len(self))[:, None], at]

    def effect_at(self, at: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return phases (N, k) and effects (N, k, C) of samples, numbered as in `phases`."""
        return self.phases(at), self.effect[torch.arange(len(self))[:, None], at]

    def __len__(self) -> int:
        return len(self.image)

    def select(self, rows: torch.Tensor | slice) -> Self:
        """Return the interactions with the given row numbers."""
        part = copy.copy(self)  # a batch of what is checked already
        for name in _BY_INTERACTION:
            object.__setattr__(part, name, getattr(self, name)[rows])
        return part

    def joined(self, *others: "InteractionTensors") -> Self:
        """Concatenate these interactions with others that have the same phases and channels."""
        parts = (self, *others)
        if len({(p.action_channels, p.effect_channels, p.image_width_m) for p in parts}) > 1:
            raise ValueError("others must have the same channels and image_width_m")
        if not all(torch.equal(p.phase, self.phase) for p in others):
            raise ValueError("others must have the same phases")
        return replace(
            self, **{n: torch.cat([getattr(p, n) for p in parts]) for n in _BY_INTERACTION}
        )

    def rotated_and_mirrored(self, quarters: int, mirror: bool = False) -> Self:
        """Return the interactions mirrored in y, if `mirror`, then rotated by quarters · π/2."""
        heading = torch.tensor([(1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0)][quarters % 4])
        image, turned = torch.flip(self.image, (-2,)) if mirror else self.image, {}
        for kind in ("action", "effect"):
            values, names = getattr(self, kind), getattr(self, f"{kind}_channels")
            if mirror:
                values = values * torch.tensor([-1.0 if c in ("y", "yaw") else 1.0 for c in names])
            turned[kind] = rotate_channels(values, names, heading, absolute_yaw=kind == "action")
        return replace(self, image=torch.rot90(image, quarters, (-2, -1)), **turned)


@dataclass(frozen=True)
class Batch:
    """Images, context, and targets of action and effect."""

    image: torch.Tensor  # (B, 2, 48, 48)
    observations: Observations
    t_target: torch.Tensor  # (B, T)
    action: torch.Tensor  # (B, T, C_a)
    effect: torch.Tensor  # (B, T, C_e)

    @classmethod
    def of(
        cls, tensors: InteractionTensors, observations: Observations, target_at: torch.Tensor
    ) -> Self:
        """Build a batch whose targets are the samples with numbers (B, T), or (T,) for all."""
        t_target, action = tensors.action_at(target_at)
        effect = tensors.effect_at(target_at)[1]
        return cls(tensors.image, observations, t_target, action, effect)


def condition_on_recorded_action(tensors: InteractionTensors) -> Observations:
    """Return a context of only the commanded action, at t = 0 and t = 1 (w₁ = 1)."""
    return Observations.of(tensors, action=tensors.action_at(torch.tensor([0, -1])))


def condition_on_poses(
    tensors: InteractionTensors, start: torch.Tensor, n_poses: int
) -> Observations:
    """Return a context of the action at t = 0 and 1, and n_poses effects from samples (N,) on."""
    at = start[:, None] + torch.arange(n_poses)
    effect = tensors.effect_at(at) if n_poses else None
    return Observations.of(tensors, tensors.action_at(torch.tensor([0, -1])), effect)


def sample_mixed(
    tensors: InteractionTensors, n_targets: int, obs_max: int, generator: torch.Generator
) -> Batch:
    """Sample contexts of action (50 %), effect (25 %) or both, half at the phases used to plan."""
    b, last = len(tensors), len(tensors.phase) - 1

    def uniform(*shape):
        return torch.rand(*shape, generator=generator)

    def integers(low, high, *shape):
        return torch.randint(low, high + 1, shape, generator=generator)

    def counts():
        few, many = integers(1, min(2, obs_max), b, 1), integers(1, obs_max, b, 1)
        return torch.where(uniform(b, 1) < 0.5, few, many)

    action_at, effect_at = integers(0, last, b, obs_max), integers(0, last, b, obs_max)
    as_queried = uniform(b) < 0.5
    action_at[as_queried, 0] = 0
    action_at[as_queried, min(1, obs_max - 1)] = last if obs_max > 1 else 0
    effect_at[uniform(b) < 0.5, 0] = last

    slot = torch.arange(obs_max)
    kind = uniform(b, 1)
    action_mask = (slot < counts()) & ((kind < 0.5) | (kind > 0.75))
    effect_mask = (slot < counts()) & (kind >= 0.5)
    weight = torch.where(kind > 0.75, uniform(b, 1), (kind < 0.5).float()).squeeze(1)

    target_at = integers(0, last, b, n_targets)
    target_at[:, 0] = last
    observed = Observations.of(
        tensors, tensors.action_at(action_at), tensors.effect_at(effect_at), weight
    )
    observed = replace(observed, action_mask=action_mask, effect_mask=effect_mask)
    return Batch.of(tensors, observed, target_at)
