"""Exercises of notebooks 09 and 10: the effect of a push, mirrored pushes, and where to begin."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from affordlib.geometry import rotated, unit_vector
from exercises.checking import Exercise, answer_of


def _effect_error(effect: Callable[..., Any]) -> float:
    """How far [mm or mrad] effects are from those that were moved into the world, at worst."""
    rng, worst = np.random.default_rng(0), 0.0
    for _ in range(20):
        heading, yaw, turn = rng.uniform(-np.pi, np.pi, 3)
        xy, centroid, moved = rng.normal(scale=0.1, size=(3, 2))
        middle = xy + rotated(centroid, yaw) + rotated(moved, heading)
        end_yaw = (yaw + turn + np.pi) % (2 * np.pi) - np.pi
        end = middle - rotated(centroid, end_yaw)
        got = answer_of(effect, (*xy, yaw), (*end, end_yaw), centroid, heading)
        worst = max(worst, float(np.abs(got - (*moved, turn)).max()))
    return 1000 * worst


def _mirror_error(mirrored: Callable[..., Any]) -> float:
    """How far pushes and effects are from their mirror image at the x axis, at worst."""
    rng, worst = np.random.default_rng(0), 0.0
    for _ in range(20):
        contact, moved, angle, turn = *rng.normal(size=(2, 2)), *rng.normal(size=2)
        flip = np.array([1, -1])
        truth = *(flip * contact), *(flip * unit_vector(angle)), *(flip * moved), -turn
        got = answer_of(mirrored, contact, unit_vector(angle), moved, turn)
        worst = max(worst, float(np.abs(got - truth).max()))
    return worst


def _standoff_error(standoff: Callable[..., Any]) -> float:
    """How far [mm] from the right point, at worst: at the distance, and on the line of the push."""
    rng, worst = np.random.default_rng(0), 0.0
    for _ in range(20):
        contact, facing, aside = rng.normal(scale=0.1, size=2), *rng.uniform(-1, 1, 2)
        radius, clear = rng.uniform(0.001, 0.02, 2)
        normal, direction = unit_vector(np.pi * facing), unit_vector(np.pi * facing + 0.8 * aside)
        truth = contact - radius * normal - clear / (normal @ direction) * direction
        got = answer_of(standoff, contact, normal, direction, radius, clear)
        worst = max(worst, float(np.abs(got - truth).max()))
    return 1000 * worst


def _choice_error(chosen: Callable[..., Any]) -> float:
    """How often [%] another chain is chosen than the one of least cost and price."""
    rng, wrong = np.random.default_rng(0), 0
    for _ in range(50):
        off_m, pushes, now_m = (
            rng.exponential(0.02, 12),
            rng.integers(1, 4, 12),
            rng.uniform(0, 0.2),
        )
        price = rng.uniform(0, 0.5)
        best = int((off_m + price * now_m * pushes).argmin())
        wrong += int(answer_of(chosen, off_m, pushes, price, now_m).item() != best)
    return 2.0 * wrong


LOGS: dict[str, Exercise] = {
    "09.1": Exercise(
        "Write effect(before, after, centroid, heading): ahead, left and turn of a push.",
        _effect_error,
        expected=0.0,
        within=0.1,
        unit="mm or mrad, largest error",
    ),
    "09.2": Exercise(
        "Write mirrored(contact, direction, displacement, turn): seven numbers, mirrored at x.",
        _mirror_error,
        expected=0.0,
        within=1e-6,
        unit="largest error",
    ),
    "10.1": Exercise(
        "Write standoff(contact, normal, direction, radius, clear): the tool's centre, (x, y).",
        _standoff_error,
        expected=0.0,
        within=0.001,
        unit="mm, largest error",
    ),
    "10.2": Exercise(
        "Write chosen(off_m, pushes, price, now_m): the number of the chain, from 0.",
        _choice_error,
        expected=0.0,
        within=0.1,
        unit="% wrong choices",
    ),
}
