"""Exercises with a check: it says *not attempted*, *passed* or *failed*, and never raises.

An exercise asks for a number or a function. `check("01.1", mine)` measures what it is worth and
shows that figure beside the expected one. The exercises stand by the parts of the book: the world
(01, 02) and storage (A5), the models (03 to 05), planning and beyond (00, 06 to 08), a log of
one's own (09, 10).
"""

from exercises import logs, models, plans, world  # noqa: F401 (each adds its exercises)
from exercises.checking import EXERCISES, Exercise, Verdict, check

__all__ = ["EXERCISES", "Exercise", "Verdict", "check"]
