"""The interface of a robot for planning; planners get no ground truth of a simulator.

`affordlib.world.Tabletop` implements it; so can a real arm or another simulator.
"""

from collections.abc import Sequence
from typing import Protocol, runtime_checkable

import numpy as np

from affordlib.primitives import Primitive
from affordlib.types import Observation, Step


@runtime_checkable
class Execution(Protocol):
    """What the robot measured while it executed an action.

    tool: (n, 5) x, y, z [m] and yaw [rad] of the tool, gap of the fingers [m], evenly over the
    phases from 0 to where the action stopped.
    """

    tool: np.ndarray

    @property
    def object_path(self) -> np.ndarray:
        """Path (m, 4) of the object, from before the action until it is at rest or held.

        x, y [m] in the frame of the table, height [m] above the start, yaw [rad]: (x, y, height,
        yaw). It is recorded for figures and tables; the closed loop never reads it.
        """


@runtime_checkable
class Robot(Protocol):
    """A robot that observes one object on a table and acts on it."""

    def observe(self) -> Observation:
        """Observe the object; raises NothingSeenError if no object is visible."""

    def execute(self, step: Step, seen: Observation | None = None) -> Execution:
        """Execute an action of a plan; raises UnreachableError before any motion.

        seen: the observation that the action is relative to (default: a new one).
        """

    def can_reach(self, primitive: Primitive, stop_phase: float, at_xy_m: Sequence[float]) -> bool:
        """Whether the arm's kinematics allows an action on an object at (x, y) [m]."""

    def park(self) -> None:
        """Put down a held object, and move the arm out of the camera's view."""

    def settle(self, seconds: float = 0.5) -> None:
        """Wait without moving the arm."""
