"""Exercises with a check: it says *not attempted*, *passed* or *failed*, and never raises.

An exercise asks for a number or a function. `check("01.1", mine)` measures what it is worth and
shows that figure beside the expected one.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np

from affordlib.interactions import open_interactions
from affordlib.primitives import DURATION_S, Push
from affordlib.world import FAMILIES, Cuboid, Tabletop

if TYPE_CHECKING:
    from collections.abc import Callable


@dataclass(frozen=True)
class Exercise:
    """What is asked, and how an answer is measured.

    figure: the answer's figure, in `unit`; it passes if it lies within `within` of `expected`.
    """

    asks: str
    figure: Callable[[Any], float]
    expected: float
    within: float
    unit: str


@dataclass(frozen=True)
class Verdict:
    """What became of an attempt; printed as one line."""

    name: str
    status: str
    figure: float | None = None
    why: str = ""

    @property
    def passed(self) -> bool:
        """Whether the exercise is solved."""
        return self.status == "passed"

    def __str__(self) -> str:
        exercise = EXERCISES[self.name]
        line = f"Exercise {self.name}: {self.status}"
        if self.status == "not attempted":
            return f"{line}. {exercise.asks}"
        got = f" ({self.why})" if self.why else f", {self.figure:.4g} {exercise.unit}"
        return f"{line}{got}; expected {exercise.expected:g} ± {exercise.within:g} {exercise.unit}"

    def _repr_pretty_(self, printer: Any, cycle: bool) -> None:
        printer.text(str(self))


def check(name: str, attempt: Any) -> Verdict:
    """Judge an attempt at an exercise; whatever it does, the notebook goes on.

    None, `...` or a function that gives one of them counts as not attempted.
    """
    if name not in EXERCISES:
        raise ValueError(f"exercise {name!r} is unknown; there are {', '.join(EXERCISES)}")
    exercise = EXERCISES[name]
    if _is_empty(attempt):
        return Verdict(name, "not attempted")
    try:
        figure = float(exercise.figure(attempt))
    except _NotAttempted:
        return Verdict(name, "not attempted")
    except Exception as error:
        return Verdict(name, "failed", why=f"{type(error).__name__}: {error}")
    passed = abs(figure - exercise.expected) <= exercise.within
    return Verdict(name, "passed" if passed else "failed", figure)


class _NotAttempted(Exception):
    """A function that is still to be written."""


def _is_empty(answer: Any) -> bool:
    return answer is None or answer is Ellipsis


def _asked(function: Callable[..., Any], *arguments: Any) -> np.ndarray:
    """What the reader's function gives, as numbers."""
    answer = function(*arguments)
    if _is_empty(answer):
        raise _NotAttempted
    return np.asarray(answer, dtype=float)


# 01 The tabletop


def _worst_speed_error(speed_m_s: Callable[[float], float]) -> float:
    """Largest difference [mm/s] from the speed of a push, by finite differences of its path."""
    t, dt = np.linspace(0.05, 0.95, 19), 1e-4
    ahead, behind = (Push.towards(0.0).path(t + side * dt)[:, 0] for side in (1, -1))
    true = (ahead - behind) / (2 * dt * DURATION_S)
    return 1000 * max(abs(_asked(speed_m_s, float(k)) - v) for k, v in zip(t, true, strict=True))


def _rest_cm(phase: float) -> float:
    """How far [cm] the box of notebook 01 has moved, pushed towards 0.6 rad up to a phase."""
    with Tabletop() as world:
        world.place(Cuboid(length=0.07, width=0.05, height=0.05), yaw_rad=0.4)
        return 100 * float(np.hypot(*world.interact(Push.towards(0.6), phase).rest_effect[:2]))


# 02 Interactions


@cache
def _cylinders() -> tuple[np.ndarray, np.ndarray]:
    """Diameters [m] of the upright cylinders in `push`, and how far along they went [m]."""
    pushes = open_interactions("push")
    standing = pushes["family"].values == list(FAMILIES).index("upright_cylinder")
    angle = pushes["theta"].values[standing] + np.pi
    x, y = pushes["effect"].values[standing, -1, :2].T
    return pushes["size"].values[standing, 0], np.cos(angle) * x + np.sin(angle) * y


def _cylinder_error_mm(end_m: Callable[[float], float]) -> float:
    diameters, true = _cylinders()
    given = np.array([_asked(end_m, float(d)) for d in diameters])
    return 1000 * float(np.abs(given - true).mean())


EXERCISES: dict[str, Exercise] = {
    "01.1": Exercise(
        "Write speed_m_s(t), the speed of the gripper at phase t of a push.",
        _worst_speed_error,
        expected=0.0,
        within=0.1,
        unit="mm/s off at worst",
    ),
    "01.2": Exercise(
        "Find the phase at which the push must stop for the box to rest 5 cm from its start.",
        _rest_cm,
        expected=5.0,
        within=0.05,
        unit="cm",
    ),
    "02.1": Exercise(
        "Compute the mean distance [mm] of the drags' ends from where the mean drag ends.",
        lambda mine: mine,
        expected=0.076,
        within=0.005,
        unit="mm",
    ),
    "02.2": Exercise(
        "Write end_m(diameter_m): how far a push moves a cylinder, from geometry alone.",
        _cylinder_error_mm,
        expected=0.0,
        within=0.6,
        unit="mm off in the mean",
    ),
}
