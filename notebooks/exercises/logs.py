"""Exercises of notebook 09: frames, and mirrored pushes."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from affordlib.geometry import rotated, unit_vector
from exercises.checking import Exercise, asked


def _frame_error_mm(to_object: Callable[..., Any]) -> float:
    """How far [mm] points come to lie from where they are in the object's frame, at worst."""
    rng, worst = np.random.default_rng(0), 0.0
    for _ in range(20):
        point, (x, y, yaw) = rng.normal(size=2), rng.normal(size=3)
        world = np.add(rotated(point, yaw), (x, y))
        worst = max(worst, float(np.abs(asked(to_object, (x, y, yaw), world) - point).max()))
    return 1000 * worst


def _mirror_error(mirrored: Callable[..., Any]) -> float:
    """How far pushes and effects are from their mirror image at the x axis, at worst."""
    rng, worst = np.random.default_rng(0), 0.0
    for _ in range(20):
        contact, moved, angle, turn = *rng.normal(size=(2, 2)), *rng.normal(size=2)
        flip = np.array([1, -1])
        truth = *(flip * contact), *(flip * unit_vector(angle)), *(flip * moved), -turn
        got = asked(mirrored, contact, unit_vector(angle), moved, turn)
        worst = max(worst, float(np.abs(got - truth).max()))
    return worst


LOGS: dict[str, Exercise] = {
    "09.1": Exercise(
        "Write to_object(pose, point): a point of the world in the frame of an object.",
        _frame_error_mm,
        expected=0.0,
        within=0.1,
        unit="mm, largest error",
    ),
    "09.2": Exercise(
        "Write mirrored(contact, direction, displacement, turn): seven numbers, mirrored at x.",
        _mirror_error,
        expected=0.0,
        within=1e-6,
        unit="largest error",
    ),
}
