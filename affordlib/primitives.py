"""Action primitives as gripper paths over phase, without physics (Section 3.3, Figure 2).

A primitive is a chain of segments with minimum-jerk timing. It defines the commanded gripper path
over the phase t in [0, 1], relative to the object's initial position.
"""

import math
from collections.abc import Sequence
from dataclasses import MISSING, dataclass, replace
from functools import cached_property
from typing import Any, ClassVar, Self

import numpy as np

from affordlib.geometry import edge_normals, unit_vector, wrap_angle
from affordlib.types import (
    Checked,
    check_array,
    check_choice,
    check_finite,
    check_within,
    number,
    parameter,
    point,
)

DURATION_S = 3.75  # of every primitive: 25 samples, one every 3 steps of 50 ms (Section 4.2)
PUSH_GAP_M = 0.03  # between the fingers during a push, where both touch the object's near face
EMPTY_M = 0.005  # gap between closed fingers below which the hand is empty
TIP_HEIGHT_M = 0.01  # of the fingers during an action
HOVER_M = 0.16  # height of the finger tips before they are lowered over an object
ROD_GAP_M = 0.006  # distance before the contact at which a push with the rod starts
BLADE_HEIGHT_M = 0.0015


def min_jerk(t: np.ndarray | Sequence[float] | float) -> np.ndarray:
    """Return the share of the path covered at phase t, minimum-jerk timing: 10t³ - 15t⁴ + 6t⁵."""
    t = np.clip(t, 0.0, 1.0)
    return np.asarray(t**3 * (10.0 - 15.0 * t + 6.0 * t**2))


X, Y, Z, YAW, GRIPPER, PITCH = range(6)
"""Columns of a pose of the tool: position [m], yaw [rad], gripper (1 open, 0 closed) and pitch
[rad, nose down]. An action (5,) has all but the pitch."""


@dataclass(frozen=True)
class Segment:
    """A straight part of a primitive."""

    seconds: float
    start: np.ndarray  # pose (6,)
    end: np.ndarray
    guarded: bool = False  # it stops when the robot feels contact with the object

    def at(self, share: np.ndarray) -> np.ndarray:
        """Return the poses (n, 6) at the shares (n,) of the segment's length, in [0, 1]."""
        return self.start + np.asarray(share)[:, None] * (self.end - self.start)


def radians(default: Any = MISSING, first: float = -math.pi) -> Any:
    """Declare a parameter that is an angle [rad], kept in the turn that begins with `first`."""
    turn = 2 * math.pi
    return parameter(lambda name, v: (check_finite(name, v) - first) % turn + first, default)


@dataclass(frozen=True)
class Primitive(Checked):
    """An action with its parameters; `segments` define how the gripper moves."""

    name: ClassVar[str]
    opening_m: ClassVar[float]  # gap between the fingers where the gripper channel is 1
    force_N: ClassVar[float]  # maximum force of each finger
    holds: ClassVar[bool] = False  # whether the object remains in the hand at the end
    rollable: ClassVar[bool | None] = None  # whether it is for objects that roll; None: for both
    tool: ClassVar[str] = "gripper"
    acts_from: ClassVar[float] = 0.0  # phase before which, by default, it touches nothing

    @classmethod
    def sample(cls, outline_m: np.ndarray, rng: np.random.Generator) -> Self:
        """Sample parameters for an object with an outline (n, 2) [m] about its centre."""
        return cls()

    @cached_property
    def segments(self) -> tuple[Segment, ...]:
        raise NotImplementedError

    @cached_property
    def segment_phases(self) -> np.ndarray:
        """Phases (m + 1,) at which the m segments start, and 1."""
        seconds = np.cumsum([0.0, *(segment.seconds for segment in self.segments)])
        return seconds / seconds[-1]

    def path(self, phase: np.ndarray | Sequence[float] | float) -> np.ndarray:
        """Return the commanded action a_t (n, 5) at phases (n,), channels `ACTION_CHANNELS`."""
        phase = np.clip(np.atleast_1d(check_array("phase", phase)), 0.0, 1.0)
        if phase.ndim > 1:
            raise ValueError(f"phase must be numbers (n,), got an array {phase.shape}")
        action = np.empty((len(phase), 5))
        for segment, start, end in zip(
            self.segments, self.segment_phases[:-1], self.segment_phases[1:], strict=True
        ):
            inside = (phase >= start) & (phase <= end)
            share = min_jerk((phase[inside] - start) / (end - start))
            action[inside] = segment.at(share)[:, :PITCH]
        return action

    def succeeded(self, effect: np.ndarray) -> bool:
        """Return whether a final effect (5,) is a success: here, a displacement above 1 cm."""
        return bool(np.hypot(effect[0], effect[1]) > 0.01)


def _caged(grip_yaw: float, end: tuple[float, float, float]) -> tuple[Segment, ...]:
    """Lower the open gripper over the object, close it, move it to `end` (x, y, yaw), open it."""
    x, y, yaw = end
    return _segments(
        (0.0, (0.0, 0.0, HOVER_M, grip_yaw, 1.0)),
        (1.0, (0.0, 0.0, TIP_HEIGHT_M, grip_yaw, 1.0)),
        (0.75, (0.0, 0.0, TIP_HEIGHT_M, grip_yaw, 0.0)),
        (1.25, (x, y, TIP_HEIGHT_M, yaw, 0.0)),
        (0.75, (x, y, TIP_HEIGHT_M, yaw, 1.0)),
    )


def _segments(*stops: tuple[float, tuple[float, ...]], guarded: int = -1) -> tuple[Segment, ...]:
    """Connect poses (x, y, z, yaw, gripper), each with the seconds to reach it, with segments."""
    poses = [np.array([*pose, 0.0]) for _, pose in stops]
    return tuple(
        Segment(seconds, poses[k], poses[k + 1], guarded == k)
        for k, (seconds, _) in enumerate(stops[1:])
    )


@dataclass(frozen=True)
class Move(Primitive):
    """A primitive that moves an object in a straight line, in a direction given by theta [rad]."""

    theta: float = radians(first=0.0)
    length: float = number(0.0, 0.15, "m", 0.05)

    ahead_rad: ClassVar[float] = 0.0  # from theta to the direction in which the object moves

    @classmethod
    def sample(cls, outline_m: np.ndarray, rng: np.random.Generator) -> Self:
        """Sample theta uniformly."""
        return cls(float(rng.uniform(0, 2 * math.pi)))

    @classmethod
    def towards(cls, direction_rad: float, **kwargs: float) -> Self:
        """Return the action that moves an object in the given direction [rad]."""
        return cls(check_finite("direction_rad", direction_rad) + cls.ahead_rad, **kwargs)

    @property
    def direction_rad(self) -> float:
        """Direction [rad] in which the object is moved, in [-π, π)."""
        return wrap_angle(self.theta + self.ahead_rad)


@dataclass(frozen=True)
class Push(Move):
    """A straight push through the object's centre (Section 3.3).

    The gripper starts on a circle of `radius` [m] around the object at the angle theta [rad],
    moves through the centre and stops `length` [m] beyond it. The object moves towards theta + π.
    """

    radius: float = number(0.1, 0.3, "m", 0.2)

    name = "push"
    opening_m = PUSH_GAP_M
    force_N = 200.0
    rollable = False
    acts_from = 0.4
    ahead_rad = math.pi

    @cached_property
    def segments(self) -> tuple[Segment, ...]:
        yaw = self.direction_rad
        start, end = (s * unit_vector(yaw) for s in (-self.radius, self.length))
        facing = TIP_HEIGHT_M, yaw, 1.0
        return _segments((0.0, (*start, *facing)), (DURATION_S, (*end, *facing)))


@dataclass(frozen=True)
class PushAt(Primitive):
    """A straight push with a thin rod at any contact point and in any direction.

    The rod moves in `direction` [rad], meets the object at `contact` (x, y) [m], relative to its
    centre in the table's axes, and continues by `length` [m].
    """

    contact: tuple[float, float] = point(2, 0.3)
    direction: float = radians()
    length: float = number(0.0, 0.15, "m", 0.016)

    name = "push_at"
    opening_m = 0.0
    force_N = 200.0
    tool = "rod"

    @cached_property
    def segments(self) -> tuple[Segment, ...]:
        ahead, facing = unit_vector(self.direction), (TIP_HEIGHT_M, self.direction, 0.0)
        start, end = (self.contact + s * ahead for s in (-ROD_GAP_M, self.length))
        return _segments((0.0, (*start, *facing)), (DURATION_S, (*end, *facing)))


@dataclass(frozen=True)
class Drag(Move):
    """The paper's push for rollable objects: cage the object, move it, release it.

    The open gripper is lowered over the object's centre, closed, moved by `length` [m] in the
    direction theta [rad], and opened. grip_yaw [rad] is the gripper's yaw, and the fingers close
    perpendicular to it; None means the object's axis, estimated from the image.
    """

    grip_yaw: float | None = radians(None)

    name = "drag"
    opening_m = 0.14
    force_N = 10.0
    rollable = True
    acts_from = 0.25

    @cached_property
    def segments(self) -> tuple[Segment, ...]:
        yaw = self.grip_yaw or 0.0
        return _caged(yaw, (*(self.length * unit_vector(self.theta)), yaw))


@dataclass(frozen=True)
class Grasp(Primitive):
    """Lower the open gripper until it feels the object, close it, lift; no parameters in the paper.

    seen_height [m] is the object's height; the finger tips aim 30 mm below its top. None means
    the height in the image. grip_yaw [rad] is the gripper's yaw; closing aligns the object with it.
    """

    seen_height: float | None = number(0.0, 0.3, "m", None)
    grip_yaw: float = radians(0.0)

    name = "grasp"
    opening_m = 0.105
    force_N = 10.0
    holds = True
    lift_m: ClassVar[float] = 0.25
    success_m: ClassVar[float] = 0.1

    @cached_property
    def segments(self) -> tuple[Segment, ...]:
        seen = 0.06 if self.seen_height is None else self.seen_height
        low, yaw = max(seen - 0.03, TIP_HEIGHT_M), self.grip_yaw
        return _segments(
            (0.0, (0.0, 0.0, HOVER_M, yaw, 1.0)),
            (1.0, (0.0, 0.0, low, yaw, 1.0)),
            (0.75, (0.0, 0.0, low, yaw, 0.0)),
            (2.0, (0.0, 0.0, low + self.lift_m, yaw, 0.0)),
            guarded=0,
        )

    def succeeded(self, effect: np.ndarray) -> bool:
        """Return whether the object was lifted by more than 0.1 m (Section 4.3)."""
        return bool(effect[2] > self.success_m)


@dataclass(frozen=True)
class Rotate(Primitive):
    """Lower the open gripper over the object, close it, turn, open; no parameters in the paper.

    The sweep is fixed; a smaller angle is a rotation stopped at an earlier phase. grip_yaw [rad]
    is the yaw at which the gripper closes, which aligns the object with it.
    """

    grip_yaw: float = radians(0.0)

    name = "rotate"
    opening_m = 0.14
    force_N = 10.0
    sweep_rad: ClassVar[float] = math.radians(60)

    @cached_property
    def segments(self) -> tuple[Segment, ...]:
        return _caged(self.grip_yaw, (0.0, 0.0, self.grip_yaw + self.sweep_rad))

    def succeeded(self, effect: np.ndarray) -> bool:
        """Return whether the object turned by more than half the sweep."""
        return bool(effect[3] > self.sweep_rad / 2)


@dataclass(frozen=True)
class _Arc(Segment):
    """The lifting segment: the blade turns by `angle_rad` about an edge `radius_m` ahead of it."""

    radius_m: float = 0.16
    angle_rad: float = 0.0

    def at(self, share: np.ndarray) -> np.ndarray:
        poses = np.repeat(self.start[None], len(share), axis=0)
        angle = np.asarray(share) * self.angle_rad
        ahead = self.radius_m * (1 - np.cos(angle))
        poses[:, X] += ahead * math.cos(self.start[YAW])
        poses[:, Y] += ahead * math.sin(self.start[YAW])
        poses[:, Z] += self.radius_m * np.sin(angle)
        poses[:, PITCH] = 0.8 * angle
        return poses


@dataclass(frozen=True)
class LeverUp(Primitive):
    """Slide a blade under an object's edge and lever it up (Section 4.1).

    contact_x, contact_y [m]: a point on the edge, relative to the object's centre; theta [rad]:
    the direction in which the blade moves under it; reach r [m]: distance from the contact to the
    far edge about which the object turns. The tip follows r(1 - cos φ), r sin φ up to φ = 65°.
    """

    contact_x: float = number(-0.2, 0.2, "m")
    contact_y: float = number(-0.2, 0.2, "m")
    theta: float = radians(first=0.0)
    reach: float = number(0.05, 0.4, "m")

    name = "lever_up"
    opening_m = 0.012
    force_N = 200.0
    holds = True
    tool = "screwdriver"
    angle_rad: ClassVar[float] = math.radians(65)
    insertion_m: ClassVar[float] = 0.012
    run_up_m: ClassVar[float] = 0.03

    @classmethod
    def sample(cls, outline_m: np.ndarray, rng: np.random.Generator) -> Self:
        """Sample an edge and a point on it; a blade that enters obliquely slips."""
        levers = []
        for _ in range(20):
            edge = int(rng.integers(len(outline_m)))
            lever = cls.at_edge(outline_m, edge, rng.uniform(0.2, 0.8))
            x, y = outline_m[(edge + 1) % len(outline_m)] - outline_m[edge]
            levers.append((abs(wrap_angle(lever.theta - math.atan2(x, -y))), lever))
            if levers[-1][0] < 0.18:  # rad, from the inward normal of the edge
                break
        _, lever = min(levers, key=lambda drawn: drawn[0])
        return replace(lever, theta=lever.theta + rng.uniform(-0.1, 0.1))

    @classmethod
    def at_edge(cls, outline_m: np.ndarray, edge: int, share: float = 0.5) -> Self:
        """Return the lever-up at a point on an edge of an outline (n, 2) [m], counter-clockwise.

        share: position of the point along the edge, in [0, 1]. The object turns about the edge of
        least force (weight · distance to the centroid / distance to the contact). The blade's
        direction bisects the outward normal of that edge and the inward normal of its own edge.
        """
        along, outward = np.roll(outline_m, -1, axis=0) - outline_m, edge_normals(outline_m)
        contact = outline_m[edge] + check_within("share", share, 0.0, 1.0) * along[edge]
        to_centre = (outline_m * outward).sum(axis=1)
        to_contact = to_centre - outward @ contact
        far = to_contact > to_contact.max() / 3
        pivot = int(np.argmin(np.where(far, to_centre / np.where(far, to_contact, 1.0), np.inf)))
        middle = outward[pivot] - outward[edge]
        theta = math.atan2(middle[1], middle[0])
        return cls(float(contact[0]), float(contact[1]), theta, max(0.05, float(to_contact[pivot])))

    @cached_property
    def segments(self) -> tuple[Segment, ...]:
        direction = unit_vector(self.theta)
        contact = np.array([self.contact_x, self.contact_y])
        outside = contact - self.run_up_m * direction
        under = contact + self.insertion_m * direction
        poses = [np.array([*xy, BLADE_HEIGHT_M, self.theta, 0.0, 0.0]) for xy in (outside, under)]
        arc = _Arc(2.75, poses[1], poses[1], radius_m=self.reach, angle_rad=self.angle_rad)
        return Segment(1.0, *poses), arc

    def succeeded(self, effect: np.ndarray) -> bool:
        """Return whether the object was tilted by more than half the lever's angle."""
        return bool(effect[4] > self.angle_rad / 2)


PRIMITIVES: dict[str, type[Primitive]] = {
    primitive.name: primitive for primitive in (Push, Drag, Grasp, Rotate, LeverUp)
}
"""The primitives of which data sets are collected; a set stores their positions here.

`PushAt` is not among them: a data set holds only parameters that are single numbers."""


def primitive_named(name: str) -> type[Primitive]:
    """Return the class of the primitive `name`; raises ValueError with the known names."""
    known = PRIMITIVES | {PushAt.name: PushAt}
    return known[check_choice("primitive", name, known)]


def move_for(rollable: bool) -> type[Move]:
    """Return the action that moves an object: a drag if the object can roll, otherwise a push."""
    return Drag if rollable else Push
