"""The three settings of Table 3, and what all planners share."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from affordlib.models.protocol import EffectModel
from affordlib.types import (
    IMAGE_CHANNELS,
    IMAGE_PIXELS,
    TABLE_X_M,
    TABLE_Y_M,
    Goal,
    check_array,
    check_count,
)

PATH_SAMPLES = 25
"""Points of the predicted path that a step carries, as in Section 4.3."""


@dataclass(frozen=True)
class PlanMode:
    """How many actions a plan may have, and whether they may stop before the end."""

    max_steps: int
    partial: bool

    def __post_init__(self) -> None:
        check_count("max_steps", self.max_steps, 1, 10)


MODES: dict[str, PlanMode] = {
    "single_full": PlanMode(1, partial=False),
    "single_partial": PlanMode(1, partial=True),
    "multi_partial": PlanMode(3, partial=True),
}


def mode_named(mode: str | PlanMode) -> PlanMode:
    """The mode of a name in `MODES`, or the mode itself; raises naming the known ones."""
    if isinstance(mode, PlanMode):
        return mode
    if mode not in MODES:
        raise ValueError(f"mode {mode!r} is unknown; choose one of {sorted(MODES)}")
    return MODES[mode]


def checked_image(image: np.ndarray) -> torch.Tensor:
    """One depth image (2, 48, 48) as (1, 2, 48, 48); raises ValueError where it is none."""
    image = check_array("image", image).astype(np.float32)
    if image.shape != (len(IMAGE_CHANNELS), IMAGE_PIXELS, IMAGE_PIXELS):
        raise ValueError(
            f"image must have the shape (2, {IMAGE_PIXELS}, {IMAGE_PIXELS}) that "
            f"Tabletop.look() gives, got {image.shape}"
        )
    return torch.from_numpy(image)[None]


@torch.no_grad()
def encode_image(model: EffectModel, image: np.ndarray) -> torch.Tensor:
    """Features (1, F) of one depth image (2, 48, 48), checked."""
    return model.encode(checked_image(image))


def plane(model: EffectModel) -> list[int]:
    """Where x and y are among the model's effect channels; raises where it knows no plane."""
    for channels in (model.action_channels, model.effect_channels):
        if not {"x", "y"} <= {*channels}:
            raise ValueError(
                f"model: a planner of positions needs one of actions and effects in x and y; this "
                f"one has {model.action_channels} and {model.effect_channels}"
            )
    return [model.effect_channels.index(name) for name in ("x", "y")]


def is_on_table(xy_m: np.ndarray, radius_m: float = 0.0) -> np.ndarray:
    """Which of the points (n, 2) lie on the table, farther than a radius [m] from its rim."""
    (x0, x1), (y0, y1) = TABLE_X_M, TABLE_Y_M
    inside = np.array(xy_m) - (x0 + radius_m, y0 + radius_m)
    return ((inside >= 0) & (inside <= (x1 - x0 - 2 * radius_m, y1 - y0 - 2 * radius_m))).all(-1)


def check_has_room(goal: Goal, radius_m: float) -> None:
    """Raise ValueError where an object of a radius [m] would not stand on the table as a whole."""
    if not is_on_table(np.array([goal.xy_m]), radius_m)[0]:
        x, y = goal.xy_m
        raise ValueError(
            f"goal xy_m = ({x:g}, {y:g}) m is too near the rim of the table for an object that "
            f"reaches {100 * radius_m:.1f} cm from its middle"
        )
