"""Logs of a robot's own pushes of one object: checks and conversion to a common frame.

`Log` accepts raw numbers, in millimetres or metres and in the world frame. `Log.pushes` returns
them in metres and radians, in the object's frame before each push: the origin is the centroid of
the outline, the axes are those of the recorded pose.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Any, Self

import numpy as np
from scipy.optimize import brentq

from affordlib.geometry import cross, rotated
from affordlib.types import check_array, check_choice, check_within

UNITS_M = {"mm": 1e-3, "m": 1.0}
UNITS_RAD = {"deg": math.pi / 180, "rad": 1.0}
MOST_ROWS, MOST_CORNERS = 20_000, 1000
FEET = 12
"""Maximum number of feet in `context["feet"]`, (feet, 3): x, y [m] and share of the weight."""
LARGEST_M = 1.0
SLACK_M = 0.03
"""Distance [m] by which an object may move farther than the tool."""
OFF_M, OFF_SHARE = 0.002, 0.2
"""How far the tool may go back or aside: a length [m], and a share of its greatest depth."""
LATE_SHARE = 0.05
"""Share of a push's duration by which its poses may begin late or end early; two frames at most."""
SAMPLES = 500
"""Number of points of a path, at least, at which contact is looked for."""


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


class Log:
    """Pushes of one object, added one by one; invalid numbers are rejected when they are added.

    unit: of all lengths, "mm" or "m"; angle_unit: of yaws, "rad" or "deg"; outline: corners (x, y)
    of a simple polygon in the frame whose pose is recorded (from an image: `outline_of`);
    tool_radius: radius of a round tool whose centre is recorded.
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
        self._tried = 0

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
    ) -> None:
        """Add one push, in the world frame.

        tool_t: (m,), increasing times; tool_xy: (m, 2), nearly straight path of the tool, which
        begins outside the object and ends where the push ends; poses: (k, 3), x, y and yaw of the
        object, at the times poses_t (k,) of the tool's clock, or without times two poses, before
        and after the push; context: further known values, numbers or text; group: name of the
        pushes that belong together. Raises ValueError, and adds nothing, with the number of the
        push (of all calls, from 0), the value and what is expected.
        """
        number, self._tried = self._tried, self._tried + 1
        try:
            tool = _rows("tool_xy", tool_xy, 2) * self._metres
            t = _growing("tool_t", tool_t, len(tool))
            ends = self._ends(t, poses, poses_t)
            centre = ends[:, :2] + np.stack([rotated(self.origin_m, yaw) for yaw in ends[:, 2]])
            centre, tool = (rotated(p - centre[0], -ends[0, 2]) for p in (centre, tool))
            push = _contact(self.outline_m, tool, self._radius_m)
            push |= {"displacement_m": centre[1], "turn_rad": ends[1, 2] - ends[0, 2]}
            self._refuse_jumps(**push)
            push |= {"groups": group, "context": self._context(context or {})}
        except ValueError as error:
            raise ValueError(f"push {number} (group {group!r}): {error}") from None
        self._pushes.append(push)

    def query(
        self, tool_xy: Any, context: Mapping[str, Any] | None = None, group: str = "all"
    ) -> Pushes:
        """Return a push that is not made yet, to predict it: the tool's path in the recorded frame.

        tool_xy: (m, 2); context, group: as in `add`. Raises ValueError as `add` does.
        """
        tool = _rows("tool_xy", tool_xy, 2) * self._metres - self.origin_m
        push = _contact(self.outline_m, tool, self._radius_m)
        about = {"groups": group, "context": self._context(context or {})}
        return self._stacked(Pushes, [{**push, **about}])

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
        names = pushes[0]["context"]
        context = {n: np.array([p["context"][n] for p in pushes]) for n in names}
        of_all = {"outline_m": self.outline_m, "tool_radius_m": self._radius_m}
        return kind(**arrays, context=context, **of_all)

    def _poses(self, name: str, values: Any) -> np.ndarray:
        """Convert poses (k, 3) to metres and radians; raises ValueError."""
        poses = _rows(name, values, 3) * [self._metres, self._metres, self._radians]
        most = float(np.abs(poses[:, 2]).max())
        check_within(f"yaws of {name}, in {self._angle_unit},", most, 0.0, 2 * math.pi, "rad")
        return poses

    def _ends(self, t: np.ndarray, poses: Any, poses_t: Any) -> np.ndarray:
        """Poses (2, 3) before the push and when the tool stops, without a jump of the yaw by 2π."""
        known = self._poses("poses", poses)
        if poses_t is None and len(known) > 2:
            raise ValueError(f"poses are {len(known)}; give their times, poses_t, as well")
        at = t[[0, -1]] if poses_t is None else _growing("poses_t", poses_t, len(known))
        most = min(2 * float(np.median(np.diff(at))), LATE_SHARE * float(t[-1] - t[0]))
        if max(at[0] - t[0], t[-1] - at[-1]) > most:
            raise ValueError(
                f"poses_t are from {at[0]:g} to {at[-1]:g}, but the tool moves from {t[0]:g} to "
                f"{t[-1]:g}: the object must be seen before it moves and when the tool has "
                "stopped, by the same clock"
            )
        known[:, 2] = np.unwrap(known[:, 2])
        return np.stack([known[0], [np.interp(t[-1], at, column) for column in known.T]])

    def _refuse_jumps(
        self, length_m: float, displacement_m: np.ndarray, turn_rad: float, **_: Any
    ) -> None:
        """Raise ValueError if the object's motion exceeds what the tool can cause.

        The lever arm of the rotation is taken to be at least the distance to the nearest edge.
        """
        of = f"poses after {length_m:.3g} m of contact (are they another push's?)"
        most_m = length_m + SLACK_M
        lever_m = max(1e-3, abs(_nearest(self.outline_m, np.zeros((1, 2)))[0].item()))
        turn, most_rad = f"the turn, in {self._angle_unit}, of {of}", min(most_m / lever_m, math.pi)
        check_within(turn, abs(turn_rad), 0.0, most_rad, "rad")
        check_within(f"the motion of {of}", math.hypot(*displacement_m), 0.0, most_m, "m")

    def _context(self, context: Mapping[str, Any]) -> dict[str, np.ndarray]:
        """Values as arrays of finite numbers or text, alike in all pushes; raises ValueError."""
        found = {n: np.array(v) for n, v in context.items() if isinstance(v, str)}
        found |= {n: check_array(f"context {n!r}", v) for n, v in context.items() if n not in found}
        check_feet(found.get("feet", np.zeros((1, 3))))
        expected = self._pushes[0]["context"] if self._pushes else found
        shapes = [{n: (v.dtype.kind, v.shape) for n, v in c.items()} for c in (found, expected)]
        if shapes[0] != shapes[1]:
            raise ValueError(
                f"context has (kind, shape) {shapes[0]}, but that of the first push {shapes[1]}; "
                "use the same names and kinds of values in all pushes"
            )
        return {name: found[name] for name in expected}


def check_feet(feet: np.ndarray) -> None:
    """Raise ValueError unless these are up to 12 feet (…, k, 3)."""
    if feet.ndim < 2 or feet.shape[-1] != 3 or feet.shape[-2] > FEET:
        raise ValueError(f"context feet must be (…, up to {FEET}, 3), got {feet.shape}")


def _rows(name: str, values: Any, columns: int) -> np.ndarray:
    """Finite numbers (m, columns), m at least 2; raises ValueError."""
    array = check_array(name, values)
    if array.ndim != 2 or array.shape[1] != columns or not 2 <= len(array) <= MOST_ROWS:
        raise ValueError(
            f"{name} must have 2 to {MOST_ROWS} rows of {columns} numbers, got {array.shape}; "
            "split the recording at each push"
        )
    return array


def _growing(name: str, times: Any, n: int) -> np.ndarray:
    t = check_array(name, times)
    if t.shape != (n,):
        raise ValueError(f"{name} must be {n} times, one for each row, got {t.shape}")
    if (stuck := np.flatnonzero(np.diff(t) <= 0)).size:
        row = int(stuck[0]) + 1
        raise ValueError(
            f"{name} must increase, but row {row} is {t[row].item()!r} after "
            f"{t[row - 1].item()!r}; remove repeated rows, and check that no column is missing"
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
    following = np.roll(corners, -1, axis=0)
    if (meet := _crossings(corners, following - corners)).size:
        raise ValueError(
            f"outline crosses itself: its edges from corner {meet[0, 0]} and from corner "
            f"{meet[0, 1]} meet; give the corners in order around it, each once"
        )
    doubled = cross(corners, following)
    if abs(doubled.sum()) < 1e-9:
        raise ValueError("outline has no area; give its corners in order around it")
    centroid = ((corners + following) * doubled[:, None]).sum(axis=0) / (3 * doubled.sum())
    return centroid, (corners - centroid)[:: 1 if doubled.sum() > 0 else -1]


def _crossings(corners: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Pairs (m, 2) of edges that meet though they are no neighbours."""
    off, sizes = corners - corners[:, None], np.linalg.norm(edges, axis=1)[:, None]
    side = cross(edges[:, None], off) / sizes  # distance of corner j from the line of edge i
    side = np.where(np.abs(side) < 1e-9 * sizes.max(), 0.0, np.sign(side))
    along = (edges[:, None] * off).sum(axis=-1) / sizes**2
    ends = [np.stack([v, np.roll(v, -1, axis=1)]) for v in (side, along)]  # of edge j
    apart = (ends[1].min(axis=0) > 1) | (ends[1].max(axis=0) < 0)
    parts = (ends[0].prod(axis=0) <= 0) & ~(apart & (ends[0] == 0).all(axis=0))
    meet = np.triu(parts & parts.T, 2)
    meet[0, -1] = False  # these two are neighbours
    return np.argwhere(meet)


def gyration_radius_m(outline_m: np.ndarray) -> float:
    """Radius of gyration [m] of a polygon (k, 2) about its centroid, the origin."""
    following = np.roll(outline_m, -1, axis=0)
    area = cross(outline_m, following)
    squares = (outline_m**2 + outline_m * following + following**2).sum(axis=1)
    return math.sqrt((area * squares).sum() / (6 * area.sum()))


def _nearest(
    outline_m: np.ndarray, points: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
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


def _contact(outline_m: np.ndarray, tool: np.ndarray, radius_m: float) -> dict[str, Any]:
    """Contact, normal, direction and length of the push of a tool's path (m, 2); ValueError."""

    def at(rows):  # fractions of rows are points between them
        return np.column_stack([np.interp(rows, np.arange(len(tool)), xy) for xy in tool.T])

    rows = np.linspace(0, len(tool) - 1, max(len(tool), SAMPLES))
    gaps = _nearest(outline_m, at(rows))[0] - radius_m
    if gaps[0] < 0 or gaps.min() > 0:
        raise ValueError(
            f"tool_xy {'begins inside' if gaps[0] < 0 else 'never touches'} the outline: the gap "
            f"is {gaps[0]:.3g} m at first, {gaps.min():.3g} m at least; poses and tool_xy must "
            "share a frame and unit, and a thick tool needs tool_radius"
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
    check_within("tool_xy's way aside (cut it where the push ends)", aside, 0, most, "m")
    known = {"contact_m": contact, "normal": normal}
    return known | {"direction": travelled / length, "length_m": length}
