"""What planning needs of a robot, and nothing more: no simulator's truth reaches a planner.

`affordlib.world.Tabletop` is one; a real arm, or another simulator, is one behind these methods.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol, runtime_checkable

import numpy as np

from affordlib.primitives import Primitive
from affordlib.types import Observation, Step


@runtime_checkable
class Execution(Protocol):
    """What the robot itself measured while it carried out an action.

    tool: (n, 5) x, y, z [m] and yaw [rad] of the tool, gap of the fingers [m], evenly over the
    phases from 0 to where the action stopped.
    """

    tool: np.ndarray

    @property
    def object_path(self) -> np.ndarray:
        """(m, 4) of the object, from before the action until it rests or is held after it.

        x, y [m] and yaw [rad] in the frame of the table, height [m] above where it stood before:
        (x, y, height, yaw). It is recorded for figures and tables; the closed loop never reads it.
        """


@runtime_checkable
class Robot(Protocol):
    """Looks at one object on a table, and acts on it."""

    def observe(self) -> Observation:
        """Look at the object; raises NothingSeenError where there is none to be seen."""

    def execute(self, step: Step) -> Execution:
        """Carry out an action of a plan; raises UnreachableError before any motion."""

    def can_reach(
        self, primitive: Primitive, stop_phase: float = 1.0, at_xy_m: Sequence[float] | None = None
    ) -> bool:
        """Whether the arm's kinematics allows an action on an object at (x, y) [m].

        at_xy_m: default: where the object is seen.
        """

    def park(self) -> None:
        """Put down what the hand holds, and move the arm out of the camera's sight."""

    def settle(self, seconds: float = 0.5) -> None:
        """Wait, the arm standing still."""
