"""How an attempt is judged: by a figure, beside the expected one; an error of it is shown."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np


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
    """What became of an attempt at an exercise; printed as one line."""

    name: str
    exercise: Exercise
    status: str
    figure: float | None = None
    why: str = ""

    @property
    def passed(self) -> bool:
        """Whether the exercise is solved."""
        return self.status == "passed"

    def __str__(self) -> str:
        exercise = self.exercise
        line = f"Exercise {self.name}: {self.status}"
        if self.status == "not attempted":
            return f"{line}. {exercise.asks}"
        got = f" ({self.why})" if self.why else f", {self.figure:.4g} {exercise.unit}"
        return f"{line}{got}; expected {exercise.expected:g} ± {exercise.within:g} {exercise.unit}"

    def _repr_pretty_(self, printer: Any, cycle: bool) -> None:
        printer.text(str(self))


def judge(exercises: Mapping[str, Exercise], name: str, attempt: Any) -> Verdict:
    """Judge an attempt at one of some exercises."""
    if name not in exercises:
        raise ValueError(f"exercise {name!r} is unknown; there are {', '.join(exercises)}")
    exercise = exercises[name]
    if _is_empty(attempt):
        return Verdict(name, exercise, "not attempted")
    try:
        figure = float(exercise.figure(attempt))
    except _NotAttempted:
        return Verdict(name, exercise, "not attempted")
    except Exception as error:
        return Verdict(name, exercise, "failed", why=f"{type(error).__name__}: {error}")
    passed = abs(figure - exercise.expected) <= exercise.within
    return Verdict(name, exercise, "passed" if passed else "failed", figure)


class _NotAttempted(Exception):
    """A function that is still to be written."""


def _is_empty(answer: Any) -> bool:
    return answer is None or answer is Ellipsis


def asked(function: Callable[..., Any], *arguments: Any) -> np.ndarray:
    """What the reader's function gives, as numbers."""
    return np.asarray(answered(function, *arguments), dtype=float)


def answered(function: Callable[..., Any], *arguments: Any) -> Any:
    """What the reader's function gives, whatever it is."""
    answer = function(*arguments)
    if _is_empty(answer):
        raise _NotAttempted
    return answer
