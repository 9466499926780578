"""Tensors of a data set, their split into training, validation and test, and their scaling.

The split is 80/10/10 inside each of 10 folds (Section 4.3 of the paper).
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
    LEVER_IMAGE_PIXELS,
    HasChannels,
    check_array,
    check_count,
    check_field,
    check_finite,
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


def image_width_m(data: "xarray.Dataset") -> float:
    """Return the width [m] of the images; sets that do not name it have 16, of lever-ups 56 cm."""
    image = data["image"]
    unnamed_m = 0.56 if image.shape[-1] == LEVER_IMAGE_PIXELS else 0.16
    return float(image.attrs.get("width_m", unnamed_m))


@dataclass(frozen=True)
class Split:
    """Interaction numbers for training, validation and test."""

    train: np.ndarray
    validation: np.ndarray
    test: np.ndarray

    def __post_init__(self) -> None:
        for name in ("train", "validation", "test"):
            check_numbers(name, getattr(self, name))


def split_interactions(n: int, seed: int = 0, fold: int = 0, n_folds: int = 10) -> Split:
    """Shuffle interactions 0 … n-1 into `n_folds` blocks: one for test, the next for validation.

    Each interaction has its own object, so the split is by object.
    """
    check_count("n", n, 3, 10_000_000)
    check_count("n_folds", n_folds, 3, n)
    check_count("fold", fold, 0, n_folds - 1)
    check_count("seed", seed, least=0)
    blocks = np.array_split(np.random.default_rng(seed).permutation(n), n_folds)
    test, validation = fold, (fold + 1) % n_folds
    train = np.concatenate([b for k, b in enumerate(blocks) if k not in (test, validation)])
    return Split(np.sort(train), np.sort(blocks[validation]), np.sort(blocks[test]))


@dataclass(frozen=True)
class Scaler:
    """Scales that normalise channels to unit RMS without an offset; x and y share one scale.

    An action channel that is always zero keeps its unit: a query may have another value there.

    image_mean, image_std: mean and standard deviation of depth and mask.
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
        image = tensors.image.double()
        return cls(
            _scales(tensors.action, tensors.action_channels, if_zero=1.0),
            _scales(tensors.effect, tensors.effect_channels, if_zero=1e-6),
            tuple(image.mean(dim=(0, 2, 3)).tolist()),
            tuple(image.std(dim=(0, 2, 3)).clamp_min(1e-6).tolist()),
        )


def _scales(values: torch.Tensor, channels: tuple[str, ...], if_zero: float) -> tuple[float, ...]:
    rms = values.double().square().mean(dim=(0, 1)).sqrt()
    plane = [k for k, name in enumerate(channels) if name in ("x", "y")]
    rms[plane] = rms[plane].square().mean().sqrt()
    return tuple(torch.where(rms > 1e-6, rms, if_zero).tolist())


_BY_INTERACTION = ("image", "action", "effect", "stop_phase")


@dataclass(frozen=True)
class InteractionTensors:
    """Interactions as tensors.

    Raises ValueError for numbers that are not in metres and radians, relative to the object's pose
    at the start.
    """

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
        check_field(self, "image_width_m", 0.01, 10.0, "m")
        n, steps = len(self.image), len(self.phase)
        for name in ("action_channels", "effect_channels"):
            if not getattr(self, name):
                raise ValueError(f"{name} must name at least one channel")
        shapes = {"image": (2, *self.image.shape[-1:] * 2), "stop_phase": ()}
        shapes |= {"action": (steps, len(self.action_channels))}
        shapes |= {"effect": (steps, len(self.effect_channels))}
        for name, shape in shapes.items():
            if (got := tuple(getattr(self, name).shape)) != (n, *shape):
                raise ValueError(f"{name} must be {(n, *shape)}, got {got}")
        if steps < 2 or self.phase[0] != 0 or self.phase[-1] != 1 or (self.phase.diff() <= 0).any():
            raise ValueError(f"phase must increase from 0 to 1, got {self.phase.tolist()!r:.80}")
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
                largest = 4 * math.pi if channel in ("yaw", "tilt", "pitch") else 2.0
                if not value <= largest:
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
        """Build tensors of the valid ones of the given interactions (default: all)."""
        chosen = np.arange(data.sizes["interaction"]) if interactions is None else interactions
        check_numbers("interactions", chosen)
        part = data.isel(interaction=valid_interactions(data, chosen))

        def channels(kind, names):
            known = data.attrs[f"{kind}_channels"].split()
            unknown = [name for name in names if name not in known]
            if unknown:
                raise ValueError(f"{kind}_channels {unknown} are not stored; choose from {known}")
            values = part[kind].values[..., [known.index(name) for name in names]]
            return torch.from_numpy(np.ascontiguousarray(values))

        return cls(
            torch.from_numpy(part["image"].values),
            torch.from_numpy(part["phase"].values).float(),
            channels("action", action_channels),
            channels("effect", effect_channels),
            tuple(action_channels),
            tuple(effect_channels),
            torch.from_numpy(part["stop_phase"].values).float(),
            image_width_m(data),
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
        image, action, effect = self.image, self.action, self.effect
        if mirror:
            image = torch.flip(image, (-2,))
            action = _mirror(action, self.action_channels)
            effect = _mirror(effect, self.effect_channels)
        return replace(
            self,
            image=torch.rot90(image, quarters, (-2, -1)),
            action=rotate_channels(action, self.action_channels, heading, absolute_yaw=True),
            effect=rotate_channels(effect, self.effect_channels, heading, absolute_yaw=False),
        )


Symmetry = tuple[int, bool]
"""The number of rotations by π/2, and whether y is mirrored first."""


def augment_by_symmetry(
    arrays: InteractionTensors, symmetries: tuple[Symmetry, ...]
) -> InteractionTensors:
    """Augment interactions of a primitive without direction parameters by rotation and reflection.

    Image and effect are rotated and mirrored; the commanded action is unchanged.
    """
    parts = [replace(arrays.rotated_and_mirrored(*s), action=arrays.action) for s in symmetries]
    return parts[0].joined(*parts[1:])


def _mirror(values: torch.Tensor, channels: tuple[str, ...]) -> torch.Tensor:
    return values * torch.tensor([-1.0 if name in ("y", "yaw") else 1.0 for name in channels])
