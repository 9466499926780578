"""How an attempt is judged: by a figure, beside the expected one; an error of it is shown.

A wrong answer gives a hint, the next one another; then, or once solved, the explanation is folded
below. Where the answer itself is the figure, the expected one is not shown.
"""

import ast
import html
import inspect
import math
import re
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from affordlib import checked

SOLUTIONS = Path(__file__).parents[1] / "solutions"
WRONG: Counter[str] = Counter()
"""Wrong answers so far, by the exercise's name."""


@dataclass(frozen=True)
class Exercise:
    """The question, two hints without the answer, and how an answer is measured.

    figure: the answer's figure, in `unit`; it passes if it lies within `within` of `expected`.
    """

    asks: str
    hints: list[str]
    figure: Callable[[Any], float]
    expected: float
    within: float
    unit: str


EXERCISES: dict[str, Exercise] = {}


def exercise(name: str, expected: float, within: float, unit: str) -> Callable:
    """Make an exercise of a function that measures answers.

    Its docstring is the question, a blank line, and the hints, each on one line.
    """

    def add(figure: Callable[[Any], float]) -> Callable[[Any], float]:
        asks, hints = inspect.getdoc(figure).split("\n\n")
        asks = asks.replace("\n", " ")
        EXERCISES[name] = Exercise(asks, hints.splitlines(), figure, expected, within, unit)
        return figure

    return add


@dataclass(frozen=True)
class Verdict:
    """What became of an attempt at an exercise; printed as one line."""

    name: str
    status: str
    says: str

    @property
    def passed(self) -> bool:
        """Whether the exercise is solved."""
        return self.status == "passed"

    def __repr__(self) -> str:
        return f"Exercise {self.name}: {self.status}{self.says}"

    def _repr_html_(self) -> str | None:
        """The line, with the explanation folded below, once it is solved or both hints are used."""
        if not (self.passed or WRONG[self.name] >= len(EXERCISES[self.name].hints)):
            return None
        line, more = html.escape(str(self)), html.escape(explanation(self.name))
        return f"{line}<details><summary>Explanation</summary><p>{more}</p></details>"


@checked
def check(name: str, attempt: Any) -> Verdict:
    """Judge an attempt at an exercise; whatever it does, the notebook goes on.

    None, `...` or a function that gives one of them counts as not attempted.
    """
    if name not in EXERCISES:
        raise ValueError(f"exercise {name!r} is unknown; there are {', '.join(EXERCISES)}")
    exercise, value = EXERCISES[name], attempt
    try:
        value = exercise.figure(given(attempt))
        figure, says = float(value), f", {float(value):.4g} {exercise.unit}"
    except _NotAttempted:
        return Verdict(name, "not attempted", f". {exercise.asks}")
    except Exception as error:
        figure, says = math.nan, f" ({type(error).__name__}: {error})"
    expected = f"; expected {exercise.expected:g} ± {exercise.within:g} {exercise.unit}"
    if abs(figure - exercise.expected) <= exercise.within:
        return Verdict(name, "passed", says + expected)
    if value is attempt and not callable(attempt):  # the answer itself is expected
        expected = ""
    WRONG[name] += 1
    hint = exercise.hints[min(WRONG[name], len(exercise.hints)) - 1]
    return Verdict(name, "failed", f"{says}{expected}. Hint: {hint}")


class _NotAttempted(Exception):
    """A function that is still to be written."""


def given(answer: Any) -> Any:
    """An answer, whatever it is, if there is one."""
    if answer is None or answer is Ellipsis:
        raise _NotAttempted
    return answer


def answer_of(function: Callable, *arguments: Any) -> np.ndarray:
    """What the reader's function gives, as numbers."""
    return np.asarray(given(function(*arguments)), dtype=float)


def explanation(name: str) -> str:
    """What the solution of an exercise says about itself."""
    (path,) = SOLUTIONS.glob(f"{name.partition('.')[0]}*.py")
    text = path.read_text("utf-8")
    solution = re.search(rf'check\("{name}", (\w+)', text)[1]
    (function,) = (node for node in ast.parse(text).body if getattr(node, "name", "") == solution)
    return ast.get_docstring(function)
