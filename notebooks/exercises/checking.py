"""How an attempt is judged: by a figure, beside the expected one; an error of it is shown.

A wrong answer gives a hint, the next one another; then, or once solved, the explanation is folded
below. Where the answer itself is the figure, the expected one is not shown.
"""

from __future__ import annotations

import html
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from exercises.hints import HINTS, explanation

WRONG: Counter[str] = Counter()
"""Wrong answers so far, by the exercise's name."""


@dataclass(frozen=True)
class Exercise:
    """The question, and how an answer is measured.

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
    hint: str = ""
    shown: bool = False

    @property
    def passed(self) -> bool:
        """Whether the exercise is solved."""
        return self.status == "passed"

    def __str__(self) -> str:
        exercise = self.exercise
        line = f"Exercise {self.name}: {self.status}"
        if self.status == "not attempted":
            return f"{line}. {exercise.asks}"
        line += f" ({self.why})" if self.why else f", {self.figure:.4g} {exercise.unit}"
        if self.shown or self.passed:
            line += f"; expected {exercise.expected:g} ± {exercise.within:g} {exercise.unit}"
        return f"{line}. Hint: {self.hint}" if self.hint else line

    def _repr_html_(self) -> str | None:
        """The line, with the explanation folded below, once it is solved or both hints are used."""
        if not (self.passed or WRONG[self.name] >= len(HINTS[self.name])):
            return None
        line, more = html.escape(str(self)), html.escape(explanation(self.name))
        return f"{line}<details><summary>Explanation</summary><p>{more}</p></details>"

    def _repr_pretty_(self, printer: Any, cycle: bool) -> None:
        printer.text(str(self))


def judge(exercises: Mapping[str, Exercise], name: str, attempt: Any) -> Verdict:
    """Judge an attempt at one of some exercises."""
    if name not in exercises:
        raise ValueError(f"exercise {name!r} is unknown; there are {', '.join(exercises)}")
    exercise = exercises[name]
    if _is_empty(attempt):
        return Verdict(name, exercise, "not attempted")
    why, figure = "", None
    try:
        figure = float(exercise.figure(attempt))
    except _NotAttempted:
        return Verdict(name, exercise, "not attempted")
    except Exception as error:
        why = f"{type(error).__name__}: {error}"
    if figure is not None and abs(figure - exercise.expected) <= exercise.within:
        return Verdict(name, exercise, "passed", figure)
    WRONG[name] += 1
    hints = HINTS[name]
    hint = hints[min(WRONG[name], len(hints)) - 1]
    shown = callable(attempt) or figure != attempt
    return Verdict(name, exercise, "failed", figure, why, hint, shown)


class _NotAttempted(Exception):
    """A function that is still to be written."""


def _is_empty(answer: Any) -> bool:
    return answer is None or answer is Ellipsis


def answer_of(function: Callable[..., Any], *arguments: Any) -> np.ndarray:
    """What the reader's function gives, as numbers."""
    return np.asarray(answered(function, *arguments), dtype=float)


def answered(function: Callable[..., Any], *arguments: Any) -> Any:
    """What the reader's function gives, whatever it is."""
    answer = function(*arguments)
    if _is_empty(answer):
        raise _NotAttempted
    return answer
