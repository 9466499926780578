"""Data types shared by all parts of the package: frozen dataclasses, errors and argument checks.

Phase t in [0, 1] is always the normalised time of a full primitive. Positions are in metres, angles
in radians. Actions and effects are relative to the object's initial position, in the table's axes
(Section 3.1 of the paper, D_d = {a_t, e_t, o, t}).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Sequence
from contextlib import suppress
from dataclasses import MISSING, dataclass, field, fields
from functools import partial
from numbers import Integral, Real
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, Protocol, runtime_checkable

import numpy as np

from affordlib.geometry import is_convex, rectangle, rotated, wrap_angle

if TYPE_CHECKING:
    import torch

    import affordlib.primitives

ACTION_CHANNELS = ("x", "y", "z", "yaw", "gripper")
EFFECT_CHANNELS = ("x", "y", "z", "yaw", "tilt")
IMAGE_CHANNELS = ("depth", "mask")
IMAGE_PIXELS = 48
CROP_WIDTH_M = 0.16
LEVER_IMAGE_PIXELS = 128
LEVER_CROP_WIDTH_M = 0.56
"""Width [m] of a lever-up's image: centred on the contact, the lever's direction to the right."""

FAULT_LIMIT_M = 0.002
"""Tracking error or penetration of bodies [m] above which an interaction is invalid."""

TABLE_X_M = (-0.5, 0.7)
TABLE_Y_M = (-0.7, 0.7)
LARGEST = 1e300


class UnreachableError(ValueError):
    """Raised when the arm cannot move the tool to a pose."""

    outcome: Outcome | None = None  # of the actions before this one, when a plan is executed


class NothingSeenError(RuntimeError):
    """Raised when the camera sees no object on the table."""


def check_finite(name: str, value: Any) -> float:
    """Return `value` as a float; raises ValueError unless it is a finite number."""
    known = isinstance(value, Real) and not isinstance(value, bool)
    with suppress(OverflowError):
        if known and -LARGEST < float(value) < LARGEST:
            return float(value)
    raise ValueError(f"{name} must be a finite number, got {value!r:.200}")


def check_within(name: str, value: Any, low: float, high: float, unit: str = "") -> float:
    """Return `value` as a float; raises ValueError unless it lies in [low, high]."""
    checked = check_finite(name, value)
    if not low <= checked <= high:
        within = f"[{low:g}, {high:g}] {unit}".strip()
        raise ValueError(f"{name} must lie in {within}, got {checked:g}")
    return checked


def check_array(name: str, values: Any, *shape: int) -> np.ndarray:
    """Return finite numbers as an array with last axes `shape`; raises ValueError otherwise."""
    try:
        array = np.asarray(values)
    except (TypeError, ValueError, RuntimeError):  # rows of unequal length, tensors with gradients
        array = np.empty(0)
    known = array.dtype.kind in "iuf" and array.size and np.isfinite(array).all()
    if not known or array.shape[array.ndim - len(shape) :] != shape:
        wanted = f" of shape (…, {', '.join(map(str, shape))})" if shape else ""
        got = " ".join(f"{values!r:.200}".split())
        raise ValueError(f"{name} must be finite numbers{wanted}, got {got}")
    return array.astype(float)


def check_count(name: str, value: Any, least: int = 1, most: float = math.inf) -> int:
    """Return `value`; raises ValueError unless it is a whole number in [least, most]."""
    if isinstance(value, bool) or not isinstance(value, Integral) or not least <= value <= most:
        span = f"of at least {least}" if most == math.inf else f"in [{least}, {most:g}]"
        raise ValueError(f"{name} must be a whole number {span}, got {value!r:.200}")
    return int(value)


def check_choice(name: str, value: Any, known: Collection[Any]) -> Any:
    """Return `value`; raises ValueError unless it is one of `known`."""
    if value not in known:
        raise ValueError(f"{name} must be one of {sorted(known)}, got {value!r:.200}")
    return value


class Checked:
    """A frozen dataclass that checks its fields; None is valid where it is the default."""

    def __post_init__(self) -> None:
        for declared in fields(self):
            check, value = declared.metadata.get("check"), getattr(self, declared.name)
            if check and not (value is None and declared.default is None):
                checked = check(f"{type(self).__name__}.{declared.name}", value)
                object.__setattr__(self, declared.name, checked)


def parameter(check: Callable[[str, Any], Any], default: Any = MISSING) -> Any:
    """Declare a field of a `Checked`; check(name, value) returns its valid value or raises."""
    return field(default=default, metadata={"check": check})


def number(
    low: float = -math.inf, high: float = math.inf, unit: str = "", default: Any = MISSING
) -> Any:
    """Declare a field that is a number in [low, high]."""
    return parameter(partial(check_within, low=low, high=high, unit=unit), default)


def count(default: int, least: int = 1, most: float = math.inf) -> Any:
    """Declare a field that is a whole number in [least, most]."""
    return parameter(partial(check_count, least=least, most=most), default)


def point(size: int, most_m: float, default: Any = MISSING) -> Any:
    """Declare a field that is a tuple of numbers in [-most_m, most_m] m."""

    def check(name, value):
        values = check_array(name, value, size).tolist()
        return tuple(check_within(name, each, -most_m, most_m, "m") for each in values)

    return parameter(check, default)


def check_pair(name: str, pair: Any, what: str = "(x, y) [m]") -> tuple[float, float]:
    """Return two numbers as floats; raises ValueError unless `pair` is two finite numbers."""
    try:
        one, other = (check_finite(name, value) for value in pair)
    except (TypeError, ValueError):
        raise ValueError(f"{name} must be two finite numbers {what}, got {pair!r:.200}") from None
    return one, other


def check_range(name: str, pair: Any, low: float, high: float) -> tuple[float, float]:
    """Return a range (first, last); raises ValueError unless it lies inside [low, high]."""
    first, last = check_pair(name, pair, "(low, high)")
    if not low <= first <= last <= high:
        raise ValueError(f"{name} must be a range inside [{low:g}, {high:g}], got {pair!r}")
    return first, last


def span(low: float = -math.inf, high: float = math.inf, default: Any = MISSING) -> Any:
    """Declare a field that is a range inside [low, high]."""
    return parameter(partial(check_range, low=low, high=high), default)


def on_table(xy_m: np.ndarray, radius_m: float = 0.0) -> np.ndarray | np.bool_:
    """Return whether points (..., 2) lie on the table and farther than a radius from its rim."""
    low, high = np.transpose([TABLE_X_M, TABLE_Y_M])
    return ((xy_m >= low + radius_m) & (xy_m <= high - radius_m)).all(axis=-1)


def check_on_table(name: str, xy_m: Any) -> tuple[float, float]:
    """Return (x, y) [m] in the table's frame; raises ValueError unless it is on the table."""
    x, y = check_pair(name, xy_m)
    if not on_table(np.array([x, y])):
        raise ValueError(
            f"{name} = ({x:g}, {y:g}) m lies off the table; choose x in "
            f"[{TABLE_X_M[0]:g}, {TABLE_X_M[1]:g}] and y in [{TABLE_Y_M[0]:g}, {TABLE_Y_M[1]:g}]"
        )
    return x, y


@dataclass(frozen=True)
class Obstacle(Checked):
    """A fixed body on the table: a convex polygon or a disc, with a height [m].

    corners_m: corners (x, y) [m] in the table's frame, counter-clockwise, at least three; for a
    disc one point, its centre, and radius_m [m].
    """

    corners_m: tuple[tuple[float, float], ...]
    radius_m: float = number(default=0.0)
    height_m: float = number(0.005, 0.3, "m", 0.06)

    def __post_init__(self) -> None:
        super().__post_init__()
        corners = tuple(check_on_table("corners_m", corner) for corner in self.corners_m)
        object.__setattr__(self, "corners_m", corners)
        is_disc = len(corners) == 1
        check_within("Obstacle.radius_m", self.radius_m, 0.005 * is_disc, 0.3 * is_disc, "m")
        if not (is_disc or is_convex(np.array(corners))):
            raise ValueError(
                "corners_m must be one point (a disc) or go counter-clockwise around a convex "
                f"polygon, got {corners}"
            )

    @classmethod
    def disc(cls, xy_m: tuple[float, float], radius_m: float, height_m: float = 0.06) -> Obstacle:
        """Return the disc with its centre at (x, y) [m]."""
        return cls((xy_m,), radius_m, height_m)

    @classmethod
    def box(
        cls,
        xy_m: tuple[float, float],
        size_m: tuple[float, float],
        yaw_rad: float = 0.0,
        height_m: float = 0.06,
    ) -> Obstacle:
        """Return the rectangle of length and width [m] with its centre at (x, y) [m]."""
        corners = rotated(rectangle(size_m), check_finite("yaw_rad", yaw_rad)) + np.array(xy_m)
        return cls(tuple((float(x), float(y)) for x, y in corners), 0.0, height_m)


@dataclass(frozen=True)
class Observation:
    """An observation of the object at rest, with the arm parked."""

    xy_m: tuple[float, float]  # its estimated position in the table's frame
    # (2, 48, 48): depth [m] from a plane 1 m above the table, and the object's mask, centred at
    # xy_m to within a few millimetres
    image: np.ndarray
    yaw_rad: float | None = None  # if the robot can estimate it
    yaw_std_rad: float | None = None  # its σ; None if it was not seen but dead-reckoned
    std_m: float = 0.0  # σ of the position
    obstacles: tuple[Obstacle, ...] = ()  # where they are


@dataclass(frozen=True)
class Interaction:
    """The record of one primitive executed on one object.

    Channels of an action are `ACTION_CHANNELS` (gripper is 1 open, 0 closed), those of an effect
    `EFFECT_CHANNELS`, in metres and radians.
    """

    primitive: affordlib.primitives.Primitive
    stop_phase: float
    phase: np.ndarray  # (n,)
    action: np.ndarray  # (n, 5), commanded
    effect: np.ndarray  # (n, 5)
    rest_effect: np.ndarray  # (5,), once the gripper has retreated and the object is at rest
    # (2, 48, 48), as of an `Observation`; of a lever-up (2, 128, 128) around the contact point in
    # the lever's direction
    image: np.ndarray
    start_pose: tuple[float, float, float]  # of the object: x, y, yaw in the table's frame
    estimated_xy_m: tuple[float, float]  # measured position, to which the action is relative
    # (26, 5), every 3 steps of 50 ms: measured x, y, z, yaw of the tool and gap of the fingers
    tool: np.ndarray
    rolls: bool  # whether the object can roll in its final pose
    tracking_error_m: float = 0.0  # largest one of the tool
    penetration_m: float = 0.0  # largest one of two bodies
    left_table: bool = False
    fell: bool = False
    reached: bool = True  # False if the arm could not move there

    @property
    def faults(self) -> tuple[str, ...]:
        """Reasons why the interaction is invalid; empty if there are none."""
        found = {"off_path": self.tracking_error_m, "penetration": self.penetration_m}
        return tuple(name for name, by_m in found.items() if by_m > FAULT_LIMIT_M)

    @property
    def object_path(self) -> np.ndarray:
        """Path (n + 2, 4) of the object until it rests: x, y, height above the start [m], yaw."""
        moved = np.vstack([np.zeros(5), self.effect, self.rest_effect])[:, :4]
        x, y, yaw = self.start_pose
        return moved + np.array([x, y, 0.0, yaw])

    @property
    def success(self) -> bool:
        """Whether the final effect meets the primitive's success criterion."""
        return self.primitive.succeeded(self.effect[-1])


@runtime_checkable
class HasChannels(Protocol):
    """A model or data set that names its channels of actions and effects."""

    action_channels: tuple[str, ...]
    effect_channels: tuple[str, ...]


@dataclass(frozen=True)
class Observations:
    """The context of a model: actions and effects at any phases, in metres and radians.

    What is False in a mask is ignored.
    """

    action: torch.Tensor  # (B, n, C_a)
    action_t: torch.Tensor  # (B, n)
    action_mask: torch.Tensor  # (B, n)
    effect: torch.Tensor  # (B, m, C_e)
    effect_t: torch.Tensor  # (B, m)
    effect_mask: torch.Tensor  # (B, m)
    # (B,), w₁ of the action in equation (2), w₂ = 1 - w₁: 1 with only actions, 0 with only effects
    weight: torch.Tensor

    @classmethod
    def of(
        cls,
        model: HasChannels,
        action: tuple[torch.Tensor, torch.Tensor] | None = None,
        effect: tuple[torch.Tensor, torch.Tensor] | None = None,
        weight: torch.Tensor | None = None,
    ) -> Observations:
        """Build a model's context from action and effect, each as phases (B, n), values (B, n, C).

        At least one of them must be given. weight: (B,), by default 1 without an effect, 0 without
        an action, 0.5 with both.
        """
        if action is None and effect is None:
            raise ValueError("action or effect must be given, got None for both")
        t, columns = (action or effect)[0], []
        for what, channels in ((action, model.action_channels), (effect, model.effect_channels)):
            none = t.new_zeros(len(t), 1), t.new_zeros(len(t), 1, len(channels))
            at, values = what or none
            columns += [values, at, at.new_full(at.shape, what is not None).bool()]
        if weight is None:
            weight = t.new_full((len(t),), (1 + (action is not None) - (effect is not None)) / 2)
        return cls(*columns, weight)


@dataclass(frozen=True)
class Prediction:
    """Predicted mean and σ of action and effect at targets, in metres and radians."""

    action_mean: torch.Tensor  # (B, T, C_a)
    action_std: torch.Tensor  # (B, T, C_a)
    effect_mean: torch.Tensor  # (B, T, C_e)
    effect_std: torch.Tensor  # (B, T, C_e)


class GoalError(NamedTuple):
    """What is left to one part of a goal, and its tolerance, both in metres or in radians."""

    left: float
    tolerance: float
    text: str

    def is_met(self, std: float = 0.0) -> bool:
        """Return whether it is within the tolerance, by twice the σ of its observation."""
        return abs(self.left) + 2 * std <= self.tolerance


@dataclass(frozen=True)
class Goal(Checked):
    """The desired position of the object, and if wanted its rotation and lift."""

    TURN_TOLERANCE_RAD: ClassVar[float] = math.radians(2)
    HEIGHT_TOLERANCE_M: ClassVar[float] = 0.003

    xy_m: tuple[float, float] = parameter(check_pair)
    tolerance_m: float = number(0.0, 0.5, "m", 0.02)  # of the position
    # From its current orientation; None for any
    turn_rad: float | None = number(-math.pi, math.pi, "rad", None)
    # Above its current height; None leaves it on the table
    height_m: float | None = number(0.0, 0.5, "m", None)

    def distance_m(self, xy_m: Sequence[float]) -> float:
        """Return the distance [m] between the goal and a point (x, y) [m]."""
        return float(np.hypot(xy_m[0] - self.xy_m[0], xy_m[1] - self.xy_m[1]))

    def errors(
        self, xy_m: Sequence[float], turned_rad: float = 0.0, lifted_m: float = 0.0
    ) -> dict[str, GoalError]:
        """Return what is left to each part of the goal, in the order in which they are corrected.

        xy_m: the object's position; turned_rad, lifted_m: how far it was rotated and lifted.
        """
        away_m = self.distance_m(xy_m)
        found = {"position": GoalError(away_m, self.tolerance_m, f"{1000 * away_m:.1f} mm")}
        if self.turn_rad is not None:
            left, tolerance = wrap_angle(self.turn_rad - turned_rad), self.TURN_TOLERANCE_RAD
            found["orientation"] = GoalError(left, tolerance, f"{math.degrees(abs(left)):.1f}°")
        if self.height_m is not None:
            left = self.height_m - lifted_m
            text = f"{1000 * abs(left):.1f} mm in height"
            found["height"] = GoalError(left, self.HEIGHT_TOLERANCE_M, text)
        return found


_POINTS = {"check": lambda name, values: check_array(name, values, 2)}


@dataclass(frozen=True)
class Step(Checked):
    """One (partial) action of a plan and its predicted effect, in the table's frame."""

    primitive: affordlib.primitives.Primitive
    stop_phase: float = number(0.0, 1.0)
    predicted_end_xy_m: tuple[float, float] = parameter(check_pair)
    predicted_path_xy_m: np.ndarray = field(metadata=_POINTS)  # (n, 2), the object's path to it
    # (m, 2), relative to the object: a decoded path of the end effector, executed instead of the
    # primitive's own
    path_xy_m: np.ndarray | None = field(default=None, metadata=_POINTS)
    std_m: float = math.nan  # the model's σ of the final position
    predicted_turn_rad: float = number(default=0.0)  # since the start of the plan
    predicted_height_m: float = number(default=0.0)


@dataclass(frozen=True)
class Plan(Checked):
    """Steps from (x, y) [m] to a goal, computed in plan_s seconds."""

    goal: Goal
    start_xy_m: tuple[float, float] = parameter(check_pair)
    steps: tuple[Step, ...]
    planner: str
    reaches_goal: bool
    plan_s: float = number(0.0)

    @property
    def predicted_end_xy_m(self) -> tuple[float, float]:
        """Predicted final position (x, y) [m] of the object after the last step."""
        return self.steps[-1].predicted_end_xy_m if self.steps else self.start_xy_m

    @property
    def predicted_distance_m(self) -> float:
        """Predicted final distance [m] to the goal."""
        return self.goal.distance_m(self.predicted_end_xy_m)


@dataclass(frozen=True)
class Outcome(Checked):
    """The result of executing a plan, as the robot measured it (a `Tabletop`: the ground truth)."""

    plan: Plan
    distance_m: float = number(0.0, unit="m")  # of the final position to the goal
    end_pose: tuple[float, float, float]  # x, y, yaw
    object_paths_xy_m: tuple[np.ndarray, ...] = ()  # (n, 2) each, one per executed step
    turned_rad: float = 0.0
    lifted_m: float = 0.0
    words: str = ""  # a text on the result
