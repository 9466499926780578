"""What an action is, as a path in phase; no physics here (Section 3.3 and Figure 2 of the paper).

A primitive gives the commanded end-effector path over the phase t in [0, 1], relative to where
the object stood at the start. The world makes the arm follow it; models are conditioned on it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from affordlib.types import check_finite, check_within

PUSH_DURATION_S = 3.75
"""25 recorded samples, one every 3 steps of 50 ms (Section 4.2)."""

PUSH_GAP_M = 0.03
"""Distance between the fingers while pushing: they cradle the object's near face."""

PUSH_TIP_HEIGHT_M = 0.01


def min_jerk(t: np.ndarray | float) -> np.ndarray:
    """Share of the path covered at phase t under minimum-jerk timing: 10t³ - 15t⁴ + 6t⁵."""
    t = np.clip(t, 0.0, 1.0)
    return np.asarray(t**3 * (10.0 - 15.0 * t + 6.0 * t**2))


def wrap_angle(angle_rad: float) -> float:
    """The same angle in [-π, π)."""
    return (angle_rad + math.pi) % (2 * math.pi) - math.pi


@dataclass(frozen=True)
class Push:
    """A straight push through the object's centre (Section 3.3).

    The gripper starts on a circle around the object at the angle theta [rad], travels through
    the centre and stops `length` [m] beyond it; so the object moves towards theta + π.
    `radius` [m] is the circle's.
    """

    theta: float
    length: float = 0.05
    radius: float = 0.2

    name = "push"
    duration_s = PUSH_DURATION_S

    def __post_init__(self) -> None:
        object.__setattr__(self, "theta", check_finite("theta", self.theta) % (2 * math.pi))
        check_within("length", self.length, 0.0, 0.15, "m")
        check_within("radius", self.radius, 0.1, 0.3, "m")

    @classmethod
    def towards(cls, direction_rad: float, **kwargs: float) -> Push:
        """The push that moves an object towards the given direction [rad]."""
        return cls(check_finite("direction_rad", direction_rad) + math.pi, **kwargs)

    @property
    def direction_rad(self) -> float:
        """The direction in which the gripper travels, in [-π, π)."""
        return wrap_angle(self.theta + math.pi)

    def path(self, phase: np.ndarray | float) -> np.ndarray:
        """The commanded action a_t: (n, 5) at the phases (n,), channels `ACTION_CHANNELS`."""
        phase = np.atleast_1d(np.asarray(phase, dtype=float))
        along = (self.radius + self.length) * min_jerk(phase) - self.radius
        action = np.empty((len(phase), 5))
        action[:, 0] = along * math.cos(self.direction_rad)
        action[:, 1] = along * math.sin(self.direction_rad)
        action[:, 2] = PUSH_TIP_HEIGHT_M
        action[:, 3] = self.direction_rad
        action[:, 4] = 1.0
        return action


PRIMITIVES: dict[str, type[Push]] = {Push.name: Push}


def primitive_named(name: str) -> type[Push]:
    """The class of the primitive called `name`; raises naming the known ones."""
    if name not in PRIMITIVES:
        raise ValueError(f"primitive {name!r} is unknown; choose one of {sorted(PRIMITIVES)}")
    return PRIMITIVES[name]
