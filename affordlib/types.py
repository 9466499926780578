"""The narrow waist: the few frozen dataclasses, and errors, that pass between the package's parts.

Phase t in [0, 1] is the normalised time of a full primitive, everywhere. Positions are metres,
angles radians. Actions and effects are relative to where the object stood at the start
(Section 3.1 of the paper, D_d = {a_t, e_t, o, t}); their axes are the table's.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field, replace
from numbers import Integral, Real
from typing import Any, Protocol, runtime_checkable

import numpy as np

ACTION_CHANNELS = ("x", "y", "z", "yaw", "gripper")
EFFECT_CHANNELS = ("x", "y", "z", "yaw", "tilt")
IMAGE_CHANNELS = ("depth", "mask")
IMAGE_PIXELS = 48
CROP_WIDTH_M = 0.16
LEVER_IMAGE_PIXELS = 128
LEVER_CROP_WIDTH_M = 0.56
"""Of a lever-up: around the contact point, turned so that the lever's direction is to the right."""

FAULT_LIMIT_M = 0.002
"""An episode off its path, or with bodies inside each other, by more than this is not believed."""

TABLE_X_M = (-0.5, 0.7)
TABLE_Y_M = (-0.7, 0.7)


class UnreachableError(ValueError):
    """The arm cannot take the tool to a pose.

    outcome: where a plan was being carried out, what its actions up to that one gave.
    """

    outcome: Outcome | None = None


class NothingSeenError(RuntimeError):
    """The camera sees no object on the table."""


def check_finite(name: str, value: Any) -> float:
    """Return `value` as a float, or raise naming the argument that is not a finite number."""
    try:
        known = isinstance(value, Real) and not isinstance(value, bool)
        number = float(value) if known else math.nan
    except OverflowError:
        number = math.nan
    if not math.isfinite(number):
        raise ValueError(f"{name} must be a finite number, got {value!r}")
    return number


def check_within(name: str, value: Any, low: float, high: float, unit: str = "") -> float:
    """Return `value` as a float, or raise naming the argument outside [low, high]."""
    number = check_finite(name, value)
    if not low <= number <= high:
        within = f"[{low:g}, {high:g}] {unit}".strip()
        raise ValueError(f"{name} must lie in {within}, got {number:g}")
    return number


def check_array(name: str, values: Any, *shape: int) -> np.ndarray:
    """Return finite numbers as an array, or raise naming the argument; shape: how its ends."""
    try:
        array = np.asarray(values)
    except (TypeError, ValueError, RuntimeError):  # rows of different lengths, a tensor's gradients
        array = np.empty(0)
    known = array.dtype.kind in "iuf" and array.size and np.isfinite(array).all()
    if not known or array.shape[array.ndim - len(shape) :] != shape:
        wanted = f" of shape (…, {', '.join(map(str, shape))})" if shape else ""
        got = " ".join(f"{values!r:.200}".split())
        raise ValueError(f"{name} must be finite numbers{wanted}, got {got}")
    return array.astype(float)


def check_count(name: str, value: Any, least: int = 1, most: float = math.inf) -> int:
    """Return `value`, or raise naming the argument that is no whole number in [least, most]."""
    if isinstance(value, bool) or not isinstance(value, Integral) or not least <= value <= most:
        span = f"of at least {least}" if most == math.inf else f"in [{least}, {most:g}]"
        raise ValueError(f"{name} must be a whole number {span}, got {value!r}")
    return int(value)


def check_choice(name: str, value: Any, known: Collection[Any]) -> Any:
    """Return `value`, or raise naming the argument that is none of what is known."""
    if value not in known:
        raise ValueError(f"{name} must be one of {sorted(known)}, got {value!r}")
    return value


def check_field(
    owner: Any, name: str, low: float = -math.inf, high: float = math.inf, unit: str = ""
) -> None:
    """Check a number of a frozen dataclass, and keep it as a float; raises naming the field."""
    checked = check_within(f"{type(owner).__name__}.{name}", getattr(owner, name), low, high, unit)
    object.__setattr__(owner, name, checked)


def check_pair(name: str, pair: Any, what: str = "(x, y) [m]") -> tuple[float, float]:
    """Return two finite numbers as floats, or raise naming the argument that is something else."""
    try:
        one, other = (check_finite(name, value) for value in pair)
    except (TypeError, ValueError):
        raise ValueError(f"{name} must be two finite numbers {what}, got {pair!r}") from None
    return one, other


def check_range(name: str, pair: Any, low: float, high: float) -> tuple[float, float]:
    """Return a range (first, last) inside [low, high], or raise naming the argument."""
    first, last = check_pair(name, pair, "(low, high)")
    if not low <= first <= last <= high:
        raise ValueError(f"{name} must be a range inside [{low:g}, {high:g}], got {pair!r}")
    return first, last


def check_on_table(name: str, xy_m: Any) -> tuple[float, float]:
    """Return (x, y) [m] in the frame of the table, or raise when it is not a point on it."""
    x, y = check_pair(name, xy_m)
    if not (TABLE_X_M[0] <= x <= TABLE_X_M[1] and TABLE_Y_M[0] <= y <= TABLE_Y_M[1]):
        raise ValueError(
            f"{name} = ({x:g}, {y:g}) m lies off the table; choose x in "
            f"[{TABLE_X_M[0]:g}, {TABLE_X_M[1]:g}] and y in [{TABLE_Y_M[0]:g}, {TABLE_Y_M[1]:g}]"
        )
    return x, y


@dataclass(frozen=True)
class Observation:
    """What the robot sees of the object at rest, its arm parked.

    xy_m: estimated position (x, y) [m] in the frame of the table; image: (2, 48, 48), depth [m]
    from a plane 1 m above the table and the object's mask, centred there to some millimetres;
    std_m: σ of the position, where it is known. yaw_rad: how the object is turned, where the robot
    can tell, and yaw_std_rad: its σ; None where it was not seen but reckoned.
    """

    xy_m: tuple[float, float]
    image: np.ndarray
    std_m: float | None = None
    yaw_rad: float | None = None
    yaw_std_rad: float | None = None


@dataclass(frozen=True)
class Interaction:
    """What happened when a primitive was executed on one object.

    phase: (n,); action: (n, 5) commanded, channels `ACTION_CHANNELS`; effect: (n, 5), channels
    `EFFECT_CHANNELS` (metres and radians; gripper is 1 open, 0 closed); rest_effect: (5,) where
    the object rests after the gripper has retreated; image: (2, 48, 48), depth [m] and mask, of a
    lever-up (2, 128, 128) from the contact point in the lever's direction;
    start_pose: (x, y, yaw) of the object in the frame of the table; estimated_xy_m: where the
    robot measured it, and placed its action; tool: (26, 5) measured x, y, z [m], yaw [rad] of the
    tool and gap of the fingers [m], every 3 steps of 50 ms as in the paper.

    Of the execution: whether the object can roll as it lies now; how far the tool was off its path
    and how deep bodies sank into each other, at most [m]; whether the object left the table, and
    fell over; whether the arm could reach at all (if not, nothing happened).
    """

    primitive: affordlib.primitives.Primitive
    stop_phase: float
    phase: np.ndarray
    action: np.ndarray
    effect: np.ndarray
    rest_effect: np.ndarray
    image: np.ndarray
    start_pose: tuple[float, float, float]
    estimated_xy_m: tuple[float, float]
    tool: np.ndarray
    rolls: bool
    tracking_error_m: float = 0.0
    penetration_m: float = 0.0
    left_table: bool = False
    fell: bool = False
    reached: bool = True

    @property
    def faults(self) -> tuple[str, ...]:
        """Why the episode must not be believed; empty when nothing is wrong with it."""
        found = {"off_path": self.tracking_error_m, "penetration": self.penetration_m}
        return tuple(name for name, by_m in found.items() if by_m > FAULT_LIMIT_M)

    @property
    def object_path(self) -> np.ndarray:
        """(n + 2, 4) x, y [m], height above the start [m], yaw [rad], until the object rests."""
        moved = np.vstack([np.zeros(5), self.effect, self.rest_effect])[:, :4]
        x, y, yaw = self.start_pose
        return moved + np.array([x, y, 0.0, yaw])

    @property
    def success(self) -> bool:
        """Whether the primitive did what it is for."""
        return self.primitive.succeeded(self.effect[-1])


@runtime_checkable
class HasChannels(Protocol):
    """A model, or interactions, with these channels of actions and effects."""

    action_channels: tuple[str, ...]
    effect_channels: tuple[str, ...]


@dataclass(frozen=True)
class Observations:
    """What a model is conditioned on: action and effect at any times, in metres and radians.

    action: (B, n, C_a) at action_t: (B, n), those with action_mask: (B, n) counting; likewise
    effect: (B, m, C_e). weight: (B,), the blend w₁ of the action in equation (2), w₂ = 1 - w₁;
    it is 1 where only actions, 0 where only effects are observed.
    """

    action: torch.Tensor
    action_t: torch.Tensor
    action_mask: torch.Tensor
    effect: torch.Tensor
    effect_t: torch.Tensor
    effect_mask: torch.Tensor
    weight: torch.Tensor

    @classmethod
    def of(
        cls,
        model: HasChannels,
        action: tuple[torch.Tensor, torch.Tensor] | None = None,
        effect: tuple[torch.Tensor, torch.Tensor] | None = None,
        weight: torch.Tensor | None = None,
    ) -> Observations:
        """What is observed, for a model: action and effect as times (B, n) and values (B, n, C).

        At least one of the two. weight: (B,), by default 1 without an effect, 0 without an action,
        a half with both.
        """
        observed = action or effect
        if observed is None:
            raise ValueError("action or effect must be given; nothing would be observed")
        values = observed[1]
        b = len(values)

        def columns(what, channels):
            if what is None:
                t, empty = values.new_zeros(b, 1), values.new_zeros(b, 1, len(channels))
                return empty, t, t.bool()
            return what[1], what[0], what[0].new_ones(what[0].shape).bool()

        if weight is None:
            weight = values.new_full((b,), (1 + (action is not None) - (effect is not None)) / 2)
        of_action = columns(action, model.action_channels)
        return cls(*of_action, *columns(effect, model.effect_channels), weight)


@dataclass(frozen=True)
class Prediction:
    """Mean and σ of action and effect at the targets: (B, T, C) each, in metres and radians."""

    action_mean: torch.Tensor
    action_std: torch.Tensor
    effect_mean: torch.Tensor
    effect_std: torch.Tensor


@dataclass(frozen=True)
class Goal:
    """Where the object shall be: a position (x, y) [m] on the table and a tolerance [m].

    turn_rad: how far it shall be turned from how it stands, None if that does not matter;
    height_m: how far it shall be lifted above where it stands, None to leave it on the table.
    """

    xy_m: tuple[float, float]
    tolerance_m: float = 0.02
    turn_rad: float | None = None
    height_m: float | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "xy_m", check_on_table("goal xy_m", self.xy_m))
        check_field(self, "tolerance_m", 0.0, 0.5, "m")
        if self.turn_rad is not None:
            check_field(self, "turn_rad", -math.pi, math.pi, "rad")
        if self.height_m is not None:
            check_field(self, "height_m", 0.0, 0.5, "m")

    def distance_m(self, xy_m: Sequence[float]) -> float:
        """Distance [m] between the goal and a point (x, y) [m] of the table."""
        return float(np.hypot(xy_m[0] - self.xy_m[0], xy_m[1] - self.xy_m[1]))


@dataclass(frozen=True)
class Step:
    """One (partial) action of a plan and where the model expects the object to end.

    primitive: the action; stop_phase: the phase at which it stops; predicted_end_xy_m: (x, y)
    in the frame of the table; predicted_path_xy_m: (n, 2), the object's way there;
    path_xy_m: (m, 2) or None, a decoded end-effector path relative to the object, executed
    instead of the primitive's own where a planner gives one; std_m: the model's σ of the end;
    predicted_turn_rad: how far it expects the object to have turned since the plan's start;
    predicted_height_m: how far it expects it to be lifted.
    """

    primitive: affordlib.primitives.Primitive
    stop_phase: float
    predicted_end_xy_m: tuple[float, float]
    predicted_path_xy_m: np.ndarray
    path_xy_m: np.ndarray | None = None
    std_m: float = math.nan
    predicted_turn_rad: float = 0.0
    predicted_height_m: float = 0.0

    def __post_init__(self) -> None:
        check_field(self, "stop_phase", 0.0, 1.0)
        check_field(self, "predicted_turn_rad")
        check_field(self, "predicted_height_m")
        for name in ("predicted_end_xy_m", "predicted_path_xy_m", "path_xy_m"):
            if getattr(self, name) is not None:
                check_array(name, getattr(self, name), 2)


@dataclass(frozen=True)
class Plan:
    """Steps from (x, y) [m] to a goal, found in plan_s seconds; warning: a sentence, or empty."""

    goal: Goal
    start_xy_m: tuple[float, float]
    steps: tuple[Step, ...]
    planner: str
    reaches_goal: bool
    plan_s: float
    warning: str = ""

    def __post_init__(self) -> None:
        object.__setattr__(self, "start_xy_m", check_on_table("start_xy_m", self.start_xy_m))
        check_field(self, "plan_s", 0.0)

    @property
    def predicted_end_xy_m(self) -> tuple[float, float]:
        """Where the model expects the object after the last step."""
        return self.steps[-1].predicted_end_xy_m if self.steps else self.start_xy_m

    @property
    def predicted_distance_m(self) -> float:
        """Distance [m] that the model expects to remain."""
        return self.goal.distance_m(self.predicted_end_xy_m)


@dataclass(frozen=True)
class Outcome:
    """What carrying out a plan gave, as the robot recorded it; a `Tabletop` records the truth.

    distance_m: between the goal and the object at rest; object_paths_xy_m: one (n, 2) path of the
    object per executed step, in the frame of the table; end_pose: (x, y, yaw); words: on the end.
    """

    plan: Plan
    distance_m: float
    end_pose: tuple[float, float, float]
    object_paths_xy_m: tuple[np.ndarray, ...] = field(default=())
    turned_rad: float = 0.0
    lifted_m: float = 0.0
    words: str = ""

    def with_goal(self, goal: Goal) -> Outcome:
        """The same outcome, measured against another goal."""
        return replace(self, distance_m=goal.distance_m(self.end_pose[:2]))
