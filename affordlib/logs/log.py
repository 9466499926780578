"""Logs of a robot's own pushes of one object: checks and conversion to a common frame.

`Log` accepts raw numbers, in its own unit and in the world frame. `Log.pushes` returns metres and
radians in the object's frame before each push: from its centroid, with the recorded pose's axes.
"""

import itertools
import math
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, fields, replace
from typing import Any, Self

import numpy as np
from scipy.optimize import brentq

from affordlib.geometry import centroid, cross, rotated
from affordlib.results import plain
from affordlib.types import check_array, check_choice, check_within

UNITS_M = {"mm": 1e-3, "cm": 1e-2, "m": 1.0}
UNITS_RAD = {"deg": math.pi / 180, "rad": 1.0}
MOST_ROWS, MOST_CORNERS = 20_000, 1000
FEET = 12  # at most, in context["feet"], (feet, 3): x, y [m] and share of the weight
LARGEST_M = 1.0
SLACK_M = 0.03  # by which an object may move farther than the tool
OFF_M, OFF_SHARE = 0.002, 0.2  # the tool's way back or aside, plus a share of its depth
LATE_SHARE = 0.05  # of its duration, by which a push may be seen late; two frames at most
SAMPLES = 500  # points of a path, at least, at which contact is looked for
DEEP_M = 0.003  # of the tool in the outline, in the first row and at the final pose
BACK_M = 0.01  # how far the path of a tool that touches in the first row is extended backwards
MOST_TILT_RAD, WOBBLE_RAD = math.radians(20), math.radians(3)  # wobble: if the yaw varies less
ORDERS = {"xyzw": [0, 1, 2, 3], "wxyz": [1, 2, 3, 0]}
UPS = {"z": 0, "y": 1, "x": -1}  # shift of x, y, z that puts the axis that points up last


@dataclass(frozen=True, kw_only=True)
class Pushes:
    """n pushes of one object, each in the object's frame before the push; metres and radians.

    contact_m: (n, 2), where the tool first touches the outline; normal: (n, 2), inward unit normal
    there; direction: (n, 2), unit vector, and length_m: (n,), from there to the tool's final
    position; groups: (n,), names of the conditions; context: further known values by name, (n, …);
    outline_m: (k, 2), counter-clockwise around the centroid; tool_radius_m: of a round tool.
    """

    contact_m: np.ndarray
    normal: np.ndarray
    direction: np.ndarray
    length_m: np.ndarray
    groups: np.ndarray
    context: dict[str, np.ndarray]
    outline_m: np.ndarray
    tool_radius_m: float = 0.0

    def __len__(self) -> int:
        return len(self.contact_m)

    def select(self, rows: np.ndarray) -> Self:
        """Return the pushes with these row numbers, or where a mask (n,) is True."""
        names = {f.name for f in fields(self)} - {"context", "outline_m", "tool_radius_m"}
        context = {name: values[rows] for name, values in self.context.items()}
        return replace(self, context=context, **{n: getattr(self, n)[rows] for n in names})


@dataclass(frozen=True, kw_only=True)
class LoggedPushes(Pushes):
    """Pushes with their effects: displacement_m, (n, 2), of the centroid, and turn_rad, (n,)."""

    displacement_m: np.ndarray
    turn_rad: np.ndarray


def planar(values: Any, order: str = "xyzw", up: str = "z") -> np.ndarray:
    """Positions (n, 3) as x, y (n, 2), or with quaternions (n, 7) as x, y and yaw [rad] (n, 3).

    order: of the quaternion, "xyzw" or "wxyz"; up: the axis of the world that points up, "z", "y"
    or "x"; the plane's x and y are the two that follow it, for "y" these are z and x. Raises
    ValueError if the object's own axis of this name does not point up, or if its tilt varies where
    its yaw does not, as in another order. Poses that hardly turn may be of any order: try one of
    the object turned by 90°.
    """
    check_choice("order", order, ORDERS)
    shift = UPS[check_choice("up", up, UPS)]
    rows = _rows("values", values, 3, 7, least=1)
    xy = np.roll(rows[:, :3], shift, axis=1)[:, :2]
    if rows.shape[1] == 3:
        return xy
    quaternions = rows[:, 3:][:, ORDERS[order]]
    size = np.linalg.norm(quaternions, axis=1)
    row = int(np.abs(size - 1).argmax())
    check_within(f"the length of the quaternion in row {row} of values", size[row], 0.95, 1.05)
    i, j, k = np.roll(quaternions[:, :3], shift, axis=1).T
    w, tilt = quaternions[:, 3], np.arccos(np.clip(1 - 2 * (i * i + j * j), -1, 1))
    yaw, row = np.arctan2(2 * (w * k + i * j), 1 - 2 * (j * j + k * k)), int(tilt.argmax())
    wobble = 2 * np.hypot(*np.std([i * k - w * j, j * k + w * i], axis=1))  # of up, as it sees it
    if tilt[row] > MOST_TILT_RAD or wobble > max(WOBBLE_RAD, np.unwrap(yaw).std()):
        raise ValueError(
            f"values: the object's {up} axis must point up, but in row {row} it is tilted by "
            f"{math.degrees(tilt[row]):.0f}°, which varies by {math.degrees(wobble):.0f}°; choose "
            f"another order ({order}) or up ({up}), or turn the frame fixed to the object"
        )
    return np.column_stack([xy, yaw])


class Log:
    """Pushes of one object, added one by one; invalid numbers are rejected when they are added.

    unit: of all lengths, "mm", "cm" or "m"; angle_unit: of yaws, "rad" or "deg"; outline: corners
    (x, y) of a simple polygon in the frame whose pose is recorded (from an image: `outline_of`);
    tool_radius: radius of a round tool whose centre is recorded. names: of the added pushes;
    refused: why others were not added, by name.
    """

    def __init__(
        self, unit: str, outline: Any, angle_unit: str = "rad", tool_radius: float = 0.0
    ) -> None:
        self._metres = UNITS_M[check_choice("unit", unit, UNITS_M)]
        self._radians = UNITS_RAD[check_choice("angle_unit", angle_unit, UNITS_RAD)]
        self._angle_unit = angle_unit
        corners = check_array("outline", outline, 2) * self._metres
        self.origin_m, self.outline_m = centred(corners)
        radius_m = float(np.linalg.norm(self.outline_m, axis=1).max())
        check_within(f"the radius of outline, in {unit},", radius_m, 0.0, LARGEST_M, "m")
        self._radius_m = check_within("tool_radius", tool_radius, 0.0, 1e3) * self._metres
        self._pushes: list[dict[str, Any]] = []
        self._numbers = itertools.count()
        self.names: list[str] = []
        self.refused: dict[str, str] = {}

    def __len__(self) -> int:
        return len(self._pushes)

    def add(
        self,
        tool_t: Any,
        tool_xy: Any,
        poses: Any,
        poses_t: Any = None,
        context: Mapping[str, Any] | None = None,
        group: str = "all",
        name: str | None = None,
    ) -> None:
        """Add one push, in the world frame.

        tool_t: (m,), increasing times; tool_xy: (m, 2), nearly straight path of the tool, which
        begins outside the object, or touches it, and ends where the push ends; poses: (k, 3), x, y
        and yaw of the object, at the times poses_t (k,) of the tool's clock, or without times two
        poses, before and after the push; context: further known values, numbers or text; group:
        name of the pushes that belong together; name: of this push (default: the number of the
        call, from 0, or the next free one). Raises ValueError, and adds nothing, with name, value
        and what is expected.
        """
        number = next(n for n in map(str, self._numbers) if n not in self.names)
        name = number if name is None else str(name)
        try:
            if name in self.names:
                raise ValueError("another push has this name; give each push its own")
            tool = _rows("tool_xy", tool_xy, 2) * self._metres
            t = _growing("tool_t", tool_t, len(tool))
            ends = self._ends(t, poses, poses_t)
            centre = ends[:, :2] + np.stack([rotated(self.origin_m, yaw) for yaw in ends[:, 2]])
            centre, tool = (rotated(p - centre[0], -ends[0, 2]) for p in (centre, tool))
            push = _contact(self.outline_m, tool, self._radius_m)
            push |= {"displacement_m": centre[1], "turn_rad": ends[1, 2] - ends[0, 2]}
            self._refuse_jumps(push, tool[-1:])
            push |= {"groups": group, "context": self._context(context or {})}
        except ValueError as error:
            self.refused[name] = str(error)
            raise ValueError(f"push {plain(name):.80} (group {group!r:.80}): {error}") from None
        self._pushes.append(push)
        self.names.append(name)

    def add_all(self, pushes: Iterable[Mapping[str, Any]]) -> dict[str, str]:
        """Add pushes, each the arguments of `add`; returns why some were refused, by name."""
        before = dict(self.refused)
        for each in pushes:
            with suppress(ValueError):
                self.add(**each)
        return {name: why for name, why in self.refused.items() if before.get(name) is not why}

    def query(
        self, tool_xy: Any, context: Mapping[str, Any] | None = None, group: str = "all"
    ) -> Pushes:
        """Return a push that is not made yet, to predict it: the tool's path in the recorded frame.

        tool_xy: (m, 2); context, group: as in `add`. Raises ValueError as `add` does.
        """
        tool = _rows("tool_xy", tool_xy, 2) * self._metres - self.origin_m
        push = _contact(self.outline_m, tool, self._radius_m)
        push |= {"groups": group, "context": self._context(context or {})}
        return self._stacked(Pushes, [push])

    def pushes(self) -> LoggedPushes:
        """Return all added pushes; raises ValueError if there are none."""
        if not self._pushes:
            raise ValueError("the log is empty; add(...) pushes first")
        return self._stacked(LoggedPushes, self._pushes)

    def centroid_pose(self, pose: Any) -> tuple[float, float, float]:
        """Convert a recorded pose (x, y, yaw) to that of the centroid, in metres and radians."""
        ((x, y, yaw), _) = self._poses("pose", [pose, pose]).tolist()
        return (*np.add((x, y), rotated(self.origin_m, yaw)).tolist(), yaw)

    def _stacked(self, kind: type, pushes: list[dict[str, Any]]) -> Any:
        arrays = {n: np.array([p[n] for p in pushes]) for n in pushes[0] if n != "context"}
        context = {n: np.array([p["context"][n] for p in pushes]) for n in pushes[0]["context"]}
        of_all = {"outline_m": self.outline_m, "tool_radius_m": self._radius_m}
        return kind(**arrays, context=context, **of_all)

    def _poses(self, name: str, values: Any) -> np.ndarray:
        """Poses (k, 3) in metres and radians, without jumps of the yaw by 2π; ValueError."""
        poses = _rows(name, values, 3) * [self._metres, self._metres, self._radians]
        worst, turn = np.abs(poses[:, 2]).max() / self._radians, 2 * math.pi / self._radians
        how = f"angle_unit is {self._angle_unit!r}; take away whole turns that were counted"
        check_within(f"yaws of {name} ({how})", float(worst), -turn, turn, self._angle_unit)
        poses[:, 2] = np.unwrap(poses[:, 2])
        return poses

    def _ends(self, t: np.ndarray, poses: Any, poses_t: Any) -> np.ndarray:
        """Poses (2, 3) before the push and when the tool stops."""
        known = self._poses("poses", poses)
        if poses_t is None and len(known) > 2:
            raise ValueError(f"poses are {len(known)}; give their times, poses_t, as well")
        at = t[[0, -1]] if poses_t is None else _growing("poses_t", poses_t, len(known))
        most = min(2 * float(np.median(np.diff(at))), LATE_SHARE * float(t[-1] - t[0]))
        if max(at[0] - t[0], t[-1] - at[-1]) > most:
            raise ValueError(
                f"poses_t are from {at[0]:g} to {at[-1]:g}, but tool_t from {t[0]:g} to "
                f"{t[-1]:g}: the object must be seen before it moves and when the tool has "
                "stopped, by the same clock, in the same unit"
            )
        return np.column_stack([np.interp(t[[0, -1]], at, column) for column in known.T])

    def _refuse_jumps(self, push: dict[str, Any], tool: np.ndarray) -> None:
        """Raise ValueError if the object moved by more or less than the tool (1, 2) can cause."""
        moved_m, turn_rad = push["displacement_m"], push["turn_rad"]
        of = f"poses after {push['length_m']:.3g} m of contact (are they another push's?)"
        most_m = push["length_m"] + SLACK_M
        # A rotation's lever arm is at least the distance to the nearest edge.
        lever_m = max(1e-3, abs(_nearest(self.outline_m, np.zeros((1, 2)))[0].item()))
        turn, most_rad = f"the turn, in {self._angle_unit}, of {of}", min(most_m / lever_m, math.pi)
        check_within(turn, abs(turn_rad), 0.0, most_rad, "rad")
        check_within(f"the motion of {of}", math.hypot(*moved_m), 0.0, most_m, "m")
        at_end = rotated(tool - moved_m, -turn_rad)
        deep = self._radius_m - _nearest(self.outline_m, at_end)[0].item()
        if deep > DEEP_M:
            raise ValueError(
                f"tool_xy ends {1e3 * deep:.1f} mm inside the outline at the pose of then "
                f"(poses, by tool_t and poses_t), more than {1e3 * DEEP_M:g} mm; likely causes: "
                "sign, unit or axis of the yaw, or order of the quaternion; a pose that was held, "
                "or seen before the push ended; another push's pose; a marker off the outline's "
                "origin"
            )

    def _context(self, context: Mapping[str, Any]) -> dict[str, np.ndarray]:
        """Values as arrays of finite numbers or text, alike in all pushes; raises ValueError."""
        found = {n: np.array(v) for n, v in context.items() if isinstance(v, str)}
        found |= {n: check_array(f"context {n!r}", v) for n, v in context.items() if n not in found}
        feet = found.get("feet", np.zeros((1, 3)))
        if feet.ndim < 2 or feet.shape[-1] != 3 or feet.shape[-2] > FEET:
            raise ValueError(f"context feet must be (…, up to {FEET}, 3), got {feet.shape}")
        expected = self._pushes[0]["context"] if self._pushes else found
        shapes = [{n: (v.dtype.kind, v.shape) for n, v in c.items()} for c in (found, expected)]
        if shapes[0] != shapes[1]:
            raise ValueError(
                f"context has (kind, shape) {shapes[0]}, but that of the first push {shapes[1]}; "
                "use the same names and kinds of values in all pushes"
            )
        return {name: found[name] for name in expected}


def _rows(name: str, values: Any, *columns: int, least: int = 2) -> np.ndarray:
    """Finite numbers (m, columns), least ≤ m ≤ `MOST_ROWS`; raises ValueError."""
    try:
        array = np.ma.asarray(values, dtype=float).filled(np.nan)
    except (TypeError, ValueError, RuntimeError, OverflowError):
        array = check_array(name, values)
    array = array[:, None] if array.ndim == 1 and columns == (1,) else array
    if array.ndim != 2 or array.shape[1] not in columns or not least <= len(array) <= MOST_ROWS:
        raise ValueError(
            f"{name} must have {least} to {MOST_ROWS} rows of {' or '.join(map(str, columns))} "
            f"numbers, got {array.shape}; "
            "split a session into its pushes, and read positions and quaternions in space by planar"
        )
    if (lost := np.flatnonzero(~np.isfinite(array).all(axis=1))).size:
        raise ValueError(
            f"{name} must be finite, but {lost.size} of {len(array)} rows are not, the first is "
            f"row {lost[0]}; drop them: the motion between the others is interpolated"
        )
    return array


def _growing(name: str, times: Any, n: int) -> np.ndarray:
    """Increasing times (n,); raises ValueError."""
    if getattr(getattr(times, "dtype", None), "kind", "") == "M":  # dates, as nanoseconds
        times = np.ma.asarray(times, "datetime64[ns]").filled(np.datetime64("NaT"))
        times = np.where(np.isnat(times), np.nan, times.astype(np.int64))
    t = _rows(name, times, 1)[:, 0]
    if len(t) != n:
        raise ValueError(f"{name} must be {n} times, one for each row, got {len(t)}")
    if (stuck := np.flatnonzero(np.diff(t) <= 0)).size:
        row = int(stuck[0]) + 1
        raise ValueError(
            f"{name} must increase, but row {row} is {t[row].item()!r} after "
            f"{t[row - 1].item()!r}; remove repeated rows, check that no column is missing, and "
            "store times since 1970 with 64 bits"
        )
    return t


def centred(corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return a polygon's centroid (2,) and its corners (k, 2) relative to it, counter-clockwise."""
    if corners.ndim == 2:
        corners = corners[(corners != np.roll(corners, -1, axis=0)).any(axis=1)]  # each once
    if corners.ndim != 2 or not 3 <= len(corners) <= MOST_CORNERS:
        raise ValueError(
            f"outline must be three to {MOST_CORNERS} corners (k, 2), got {corners.shape}; of a "
            "contour in an image, take every tenth point"
        )
    following, each = np.roll(corners, -1, axis=0), np.arange(len(corners))
    gaps = segment_gaps(corners, corners, following)
    gaps[each, each] = gaps[each, (each + 1) % len(corners)] = np.inf  # an edge's own corners
    if (meet := np.argwhere(gaps < 1e-9 * np.ptp(corners))).size:
        raise ValueError(
            f"outline crosses itself: its edges from corner {meet[0, 0]} and from corner "
            f"{meet[0, 1]} meet; give the corners in order around it, each once"
        )
    doubled_area = cross(corners, following).sum()
    if abs(doubled_area) < 1e-9:
        raise ValueError("outline has no area; give its corners in order around it")
    centre = centroid(corners)
    return centre, (corners - centre)[:: 1 if doubled_area > 0 else -1]


def gyration_radius_m(outline_m: np.ndarray) -> float:
    """Radius of gyration [m] of a polygon (k, 2) about its centroid, the origin."""
    following = np.roll(outline_m, -1, axis=0)
    area = cross(outline_m, following)
    squares = (outline_m**2 + outline_m * following + following**2).sum(axis=1)
    return math.sqrt((area * squares).sum() / (6 * area.sum()))


def _nearest(outline_m: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, ...]:
    """Distances (n,) of points (n, 2) from an outline, negative inside; edges and points (n, 2) on
    them that are nearest. A loop over the edges needs little memory.
    """
    gap, inside = np.full(len(points), np.inf), np.zeros(len(points), dtype=bool)
    edges, on = np.zeros((2, len(points), 2))
    for corner, following in zip(outline_m, np.roll(outline_m, -1, axis=0), strict=True):
        edge, off = following - corner, points - corner
        share = np.clip((off * edge).sum(axis=1) / (edge @ edge), 0, 1)[:, None]
        of_edge = np.linalg.norm(off - share * edge, axis=1)
        nearer = of_edge < gap
        gap[nearer], edges[nearer] = of_edge[nearer], edge
        on[nearer] = corner + share[nearer] * edge
        passed = (off[:, 1] >= 0) != (off[:, 1] >= edge[1])
        inside ^= passed & ((cross(edge, off) > 0) == (edge[1] > 0))
    return np.where(inside, -gap, gap), edges, on


def segment_gaps(outline_m: np.ndarray, start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Distances (n, k) of an outline's corners from segments, from start to end (n, 2).

    Where a segment crosses the edge from a corner to the next, the distance of this corner is 0.
    """
    edges, along = np.roll(outline_m, -1, axis=0) - outline_m, end - start
    off = outline_m - start[:, None]
    share = (off * along[:, None]).sum(axis=-1) / np.maximum((along**2).sum(axis=1), 1e-18)[:, None]
    beside = off - np.clip(share, 0, 1)[..., None] * along[:, None]
    side = cross(along[:, None], off)
    crosses = side * np.roll(side, -1, axis=1) < 0
    crosses &= cross(edges, -off) * cross(edges, end[:, None] - outline_m) < 0
    return np.where(crosses, 0.0, np.linalg.norm(beside, axis=-1))


def _contact(outline_m: np.ndarray, tool: np.ndarray, radius_m: float) -> dict[str, Any]:
    """Contact, normal, direction and length of the push of a tool's path (m, 2); ValueError."""

    def at(rows):  # fractions of rows are points between them
        return np.column_stack([np.interp(rows, np.arange(len(tool)), xy) for xy in tool.T])

    first = _nearest(outline_m, tool[:1])[0].item() - radius_m
    if -DEEP_M <= first < 0:  # recorded from the contact on
        moved = tool - tool[0]
        way = moved[(np.linalg.norm(moved, axis=1) > OFF_M / 2).argmax()]
        tool = np.vstack([tool[0] - BACK_M * way / max(1e-12, np.linalg.norm(way)), tool])
    rows = np.linspace(0, len(tool) - 1, max(len(tool), SAMPLES))
    gaps = _nearest(outline_m, at(rows))[0] - radius_m
    if gaps[0] < 0 or gaps.min() > 0:
        inside = f"is already {-1e3 * first:.1f} mm inside the outline in its first row"
        never = f"never touches the outline; it comes within {1e3 * gaps.min():.1f} mm of it"
        raise ValueError(
            f"tool_xy {inside if gaps[0] < 0 else never}: poses and tool_xy must share a frame, "
            "unit and clock, and a thick tool needs tool_radius"
        )
    row, k = 0.0, int((gaps <= 0).argmax())
    if k > 0:
        ends = rows[k - 1], rows[k]
        row = brentq(lambda row: _nearest(outline_m, at(row))[0].item() - radius_m, *ends)
    _, edge, contact = (found[0] for found in _nearest(outline_m, at(row)))
    normal = np.array([-edge[1], edge[0]]) / np.linalg.norm(edge)
    if radius_m:  # at a corner, a round tool's normal is that of neither edge
        normal = (contact - at(row)[0]) / radius_m
    path = tool[int(row) + 1 :] + radius_m * normal
    inside = ((path - contact) * normal).sum(axis=-1)
    most, back = OFF_M + OFF_SHARE * inside.max(), inside.max() - inside[-1]
    check_within("tool_xy's way back (cut it where the push ends)", float(back), 0, most, "m")
    travelled = path[-1] - contact
    length = float(np.linalg.norm(travelled))
    check_within("the length of tool_xy after contact", length, 1e-4, LARGEST_M, "m")
    aside = float(np.abs(cross(travelled, path - contact)).max() / length)
    curved = "tool_xy's way aside (a push is straight: cut a curved one into pieces)"
    check_within(curved, aside, 0, most, "m")
    direction = travelled / length
    return {"contact_m": contact, "normal": normal, "direction": direction, "length_m": length}
