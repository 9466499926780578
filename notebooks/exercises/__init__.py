"""Exercises with a check: it says *not attempted*, *passed* or *failed*, and never raises.

An exercise asks for a number or a function. `check("01.1", mine)` measures what it is worth and
shows that figure beside the expected one. The exercises stand by the parts of the book: the world
(01, 02), the models (03 to 05), planning and beyond (00, 06 to 08), a log of one's own (09, 10),
storage (A5).
"""

from __future__ import annotations

from typing import Any

from affordlib import checked
from exercises.checking import Exercise, Verdict, judge
from exercises.logs import LOGS
from exercises.models import MODELS
from exercises.plans import PLANS, START
from exercises.storage import STORAGE
from exercises.world import WORLD

__all__ = ["EXERCISES", "Exercise", "Verdict", "check"]

EXERCISES: dict[str, Exercise] = START | WORLD | MODELS | PLANS | LOGS | STORAGE


@checked
def check(name: str, attempt: Any) -> Verdict:
    """Judge an attempt at an exercise; whatever it does, the notebook goes on.

    None, `...` or a function that gives one of them counts as not attempted.
    """
    return judge(EXERCISES, name, attempt)
