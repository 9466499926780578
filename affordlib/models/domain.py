"""The domain of a trained model: its images, and the ranges of its training actions and effects."""

import warnings
from dataclasses import dataclass
from typing import Self

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from affordlib.geometry import xy_columns
from affordlib.interactions.dataset import InteractionTensors
from affordlib.types import Checked, Observations, number, span

Range = tuple[float, float]
PHASE_TOLERANCE, END_PHASE = 1e-5, 1e-3
RADIUS_TOLERANCE_M = 0.02


class OutOfRangeWarning(UserWarning):
    """A network is queried outside its training domain, and extrapolates."""


@dataclass(frozen=True)
class TrainingDomain(Checked):
    """What a model was trained on, None where unknown."""

    # Distance of the action from the object's centre at t = 0, and at t = 1
    start_radius_m: tuple[float, float] | None = span(default=None)
    end_radius_m: tuple[float, float] | None = span(default=None)
    mask_share: tuple[float, float] | None = span(default=None)  # that the object covers
    touches_border: bool = True  # whether objects reach the image's edge
    effect_radius_m: tuple[float, float] | None = span(default=None)  # moved at t = 1
    image_pixels: int | None = None  # along an edge of the square image
    image_width_m: float | None = number(0.01, 10.0, "m", None)

    @classmethod
    def fit(cls, tensors: InteractionTensors) -> Self:
        """Determine images and ranges of training data."""
        start = end = moved = None
        if plane := xy_columns(tensors.action_channels):
            start, end = (_range(tensors.action[:, k][:, plane].norm(dim=-1)) for k in (0, -1))
        if plane := xy_columns(tensors.effect_channels):
            moved = _range(tensors.effect[:, -1][:, plane].norm(dim=-1))
        mask = tensors.image[:, 1]
        share, border = _range(mask.mean(dim=(1, 2))), bool(touches_border(mask).any())
        return cls(start, end, share, border, moved, mask.shape[-1], tensors.image_width_m)

    def check_width(self, name: str, width_m: float) -> None:
        """Raise ValueError for images of another width [m] than those of the training."""
        if self.image_width_m not in (None, width_m):
            raise ValueError(
                f"{name} has images {width_m} m wide, but the model was trained on images "
                f"{self.image_width_m} m wide; crop them alike, or train on the new width"
            )

    def check_image(self, image: Float[Tensor, "b 2 h w"]) -> None:
        """Raise ValueError for another number of pixels, or an object of another size or place."""
        pixels, mask = image.shape[-1], image[:, 1]
        if self.image_pixels not in (None, pixels):
            raise ValueError(
                f"image has {pixels}×{pixels} pixels, trained on {self.image_pixels}×"
                f"{self.image_pixels}; scale it, or train on such images"
            )
        low, high = self.mask_share or (0.0, 1.0)
        for k, share in enumerate(mask.mean(dim=(1, 2)).tolist()):
            if self.mask_share and not low / 2 < share < 1.5 * high:
                raise ValueError(
                    f"image {k}: the object covers {share:.1%} of it, trained on {low:.1%} to "
                    f"{high:.1%}; train on such objects first"
                )
        if not self.touches_border and (at_border := touches_border(mask)).any():
            raise ValueError(
                f"image {int(at_border.nonzero()[0])}: the object reaches its edge, unlike the "
                "training objects; centre the crop on the object, or train on such objects first"
            )

    def check_query(
        self,
        observations: Observations,
        t_target: Float[Tensor, "b t"],
        action_channels: tuple[str, ...],
        effect_channels: tuple[str, ...],
    ) -> None:
        """Raise ValueError where a phase, or an observed action's start or end, is out of range.

        Only warn (`OutOfRangeWarning`) of a final effect: a planner's search may pass through it.
        """
        low, high = t_target.detach().aminmax()
        if not (low > -PHASE_TOLERANCE and high < 1 + PHASE_TOLERANCE):
            raise ValueError(
                f"t_target must lie in [0, 1], the phase of the whole action, got {float(low):.3f} "
                f"to {float(high):.3f}"
            )
        o = observations
        for name, known, t in (
            ("starts", self.start_radius_m, o.action_t),
            ("ends", self.end_radius_m, 1 - o.action_t),
        ):
            seen = (t < END_PHASE) & o.action_mask
            if off := _outside(o.action, action_channels, seen, known):
                raise ValueError(f"an observed action {name} {off}; train on such actions first")
        seen = (1 - o.effect_t < END_PHASE) & o.effect_mask
        if off := _outside(o.effect, effect_channels, seen, self.effect_radius_m):
            words = f"an observed effect ends {off}; predictions from it are extrapolations"
            warnings.warn(words, OutOfRangeWarning, stacklevel=3)


def touches_border(mask: Float[Tensor, "b n n"]) -> Bool[Tensor, " b"]:
    """Whether each mask meets its image's edge by more than a corner."""
    rim = torch.cat([mask[:, (0, -1)].flatten(1), mask[:, :, (0, -1)].flatten(1)], dim=1)
    return (rim > 0.5).sum(dim=1) > 2


def _range(values: Tensor) -> Range:
    return float(values.min()), float(values.max())


def _outside(values: Tensor, channels: tuple[str, ...], seen: Tensor, known: Range | None) -> str:
    """Describe the distance of the first observed value out of range; empty if there is none."""
    plane = xy_columns(channels)
    if known is None or not plane or not seen.any():
        return ""
    radius, (low, high) = values.detach()[..., plane].norm(dim=-1)[seen], known
    near = (radius - radius.clamp(low, high)).abs() < RADIUS_TOLERANCE_M  # False for nan
    far = radius[~near].tolist()
    return f"{far[0]:.3f} m away, trained on {low:.3f} to {high:.3f} m" if far else ""
