"""Logs of a robot's own pushes of one object: checks and conversion to a common frame.

`Log` accepts raw numbers, in millimetres or metres and in the world frame. `Log.tensors` returns a
`PushLog` in metres and radians, in the object's frame before each push: the origin is the centroid
of the outline, the axes are those of the recorded pose.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
import torch

from affordlib.geometry import cross, rotated
from affordlib.interactions.dataset import InteractionTensors
from affordlib.perception import outline_image
from affordlib.types import CROP_WIDTH_M, check_array, check_choice, check_within

UNITS_M = {"mm": 1e-3, "m": 1.0}
UNITS_RAD = {"deg": math.pi / 180, "rad": 1.0}
N_PHASES = 51
MOST_ROWS = 20_000
LARGEST_M = 1.0
SLACK_M = 0.03
"""Distance [m] by which an object may move farther than the tool."""
OFF_M, OFF_SHARE = 0.002, 0.2
"""How far the tool may go back or aside: a length [m], and a share of its greatest depth."""


@dataclass(frozen=True)
class PushLog:
    """n pushes of one object, each in the object's frame before the push; metres and radians.

    contact_m: (n, 2), where the tool first touches the outline; normal: (n, 2), inward unit normal
    there; direction: (n, 2), unit vector, and length_m: (n,), from there to the tool's final
    position; displacement_m: (n, 2), of the centroid, and turn_rad: (n,), in total; groups: (n,);
    context: further known values of each push by name, (n,); action: (n, T, 2) of the tool and
    effect: (n, T, 3) x, y, yaw at equally spaced phases in [0, 1], NaN where unknown; outline_m:
    (k, 2), counter-clockwise; crop_width_m: width of the object's images.
    """

    contact_m: np.ndarray
    normal: np.ndarray
    direction: np.ndarray
    length_m: np.ndarray
    displacement_m: np.ndarray
    turn_rad: np.ndarray
    groups: np.ndarray
    context: dict[str, np.ndarray]
    action: np.ndarray
    effect: np.ndarray
    outline_m: np.ndarray
    crop_width_m: float = CROP_WIDTH_M
    tool_radius_m: float = 0.0

    def __len__(self) -> int:
        return len(self.contact_m)

    def select(self, rows: np.ndarray) -> PushLog:
        """Return the pushes with these row numbers, or where a mask (n,) is True."""
        taken = {f.name: getattr(self, f.name) for f in fields(self)[:-3]}
        taken["context"] = {name: values[rows] for name, values in self.context.items()}
        return replace(self, **{n: v if n == "context" else v[rows] for n, v in taken.items()})

    def image(self) -> np.ndarray:
        """Render depth [m] and mask (2, 48, 48) of the object in its own frame from the outline.

        The height is unknown and set to 5 cm.
        """
        return outline_image(self.outline_m, self.crop_width_m)

    def interaction_tensors(self) -> InteractionTensors:
        """Return the pushes as tensors for the networks, at the phases where all effects are known.

        Shipped models assume images of width `CROP_WIDTH_M`, but do not check `crop_width_m`.
        """
        known = np.flatnonzero(np.isfinite(self.effect).all(axis=(0, 2)))
        image = torch.from_numpy(self.image()).expand(len(self), -1, -1, -1)
        phase = torch.linspace(0, 1, self.action.shape[1])[known]
        both = (torch.from_numpy(v[:, known]).float() for v in (self.action, self.effect))
        return InteractionTensors(image, phase, *both, ("x", "y"), ("x", "y", "yaw"))


class Log:
    """Pushes of one object, added one by one; invalid numbers are rejected when they are added.

    unit: of all lengths, "mm" or "m"; angle_unit: of yaws, "rad" or "deg"; outline: corners (x, y)
    of a simple polygon in the frame whose pose is recorded (from an image: `outline_of`);
    crop_width_m: width [m] of the object's images, which must contain it; tool_radius: radius of a
    round tool whose centre is recorded.
    """

    def __init__(
        self,
        unit: str,
        outline: Sequence[tuple[float, float]] | np.ndarray,
        crop_width_m: float = CROP_WIDTH_M,
        angle_unit: str = "rad",
        tool_radius: float = 0.0,
    ) -> None:
        self._metres = UNITS_M[check_choice("unit", unit, UNITS_M)]
        self._radians = UNITS_RAD[check_choice("angle_unit", angle_unit, UNITS_RAD)]
        self._angle_unit = angle_unit
        corners = check_array("outline", outline, 2) * self._metres
        self.origin_m, self.outline_m = centred(corners)
        wide = 2 * float(np.linalg.norm(self.outline_m, axis=1).max())
        if wide > 2 * LARGEST_M:
            raise ValueError(f"outline is {wide:.3g} m wide; is it in {unit}?")
        self.crop_width_m = check_within("crop_width_m", crop_width_m, wide, 10 * wide, "m")
        self._radius_m = check_within("tool_radius", tool_radius, 0.0, 1e3) * self._metres
        self._pushes: list[dict[str, Any]] = []

    def __len__(self) -> int:
        return len(self._pushes)

    def add(
        self,
        start: Sequence[float],
        tool_t: Sequence[float] | np.ndarray,
        tool_xy: Sequence[Sequence[float]] | np.ndarray,
        end: Sequence[float] | None = None,
        poses: tuple[np.ndarray, np.ndarray] | None = None,
        context: Mapping[str, Any] | None = None,
        group: str = "all",
    ) -> None:
        """Add one push, in the world frame.

        start, end: pose (x, y, yaw) of the object before and after; poses: times (k,) and poses
        (k, 3) instead of `end`, if the motion was recorded, with the same clock as the tool;
        tool_t: (m,), increasing times; tool_xy: (m, 2), nearly straight path of the tool, which
        begins outside the object and ends where the push ends; context: further known values,
        numbers or text; group: name of the pushes that belong together. Raises ValueError, and adds
        nothing, with the push, its value and the expected value.
        """
        where = f"interaction {len(self)} (group {group!r})"
        t, xy = self._tool(where, tool_t, tool_xy)
        first = self._poses(where, "start", start)
        if (end is None) == (poses is None):
            raise ValueError(f"{where}: give either end or poses, and not both")
        at, known = t[[0, -1]], np.stack([first, first])
        if end is not None:
            known[1] = self._poses(where, "end", end)
        else:
            at = _growing(where, "the times of poses", poses[0])
            known = self._poses(where, "poses", poses[1])
            if known.shape != (len(at), 3):
                raise ValueError(f"{where}: poses hold {len(at)} times and {len(known)} poses")
            if not np.allclose(known[0], first, atol=1e-3):
                raise ValueError(
                    f"{where}: the first of poses is {np.round(known[0] - first, 4)} (m, rad) away "
                    "from start; it must be the same, because effects start at zero"
                )
        centre = known[:, :2] + np.stack([rotated(self.origin_m, yaw) for yaw in known[:, 2]])
        centre, tool = (rotated(p - centre[0], -first[2]) for p in (centre, xy))
        turn = np.unwrap(known[:, 2]) - first[2]
        push = _contact(where, self.outline_m, tool, self._radius_m)
        name = "poses" if end is None else "end"
        self._refuse_jumps(where, name, np.column_stack([centre, turn]), push["length_m"])
        phase = np.linspace(0, 1, N_PHASES)
        tool_phase, at = ((v - t[0]) / (t[-1] - t[0]) for v in (t, at))
        effect = np.full((N_PHASES, 3), np.nan)
        inside = (phase >= at[0]) & (phase <= at[-1]) if end is None else np.isin(phase, (0.0, 1.0))
        for c, values in enumerate((*centre.T, turn)):
            effect[inside, c] = np.interp(phase[inside], at, values)
        effect[0], effect[-1] = 0.0, (*centre[-1], turn[-1])
        self._pushes.append(
            {
                **push,
                "displacement_m": centre[-1],
                "turn_rad": turn[-1],
                "groups": group,
                "context": self._context(where, context or {}),
                "action": np.column_stack([np.interp(phase, tool_phase, v) for v in tool.T]),
                "effect": effect,
            }
        )

    def centroid_pose(self, pose: Sequence[float]) -> tuple[float, float, float]:
        """Convert a recorded pose (x, y, yaw) to that of the centroid, in metres and radians."""
        *xy, yaw = self._poses("centroid_pose", "pose", pose).tolist()
        return (*np.add(xy, rotated(self.origin_m, yaw)).tolist(), yaw)

    def tensors(self) -> PushLog:
        """Return all added pushes; raises ValueError if there are none."""
        if not self._pushes:
            raise ValueError("the log is empty; add(...) interactions first")
        by_name = {n: np.array([p[n] for p in self._pushes]) for n in self._pushes[0]}
        by_name["context"] = {
            n: np.array([p["context"][n] for p in self._pushes]) for n in self._pushes[0]["context"]
        }
        of_all = {"crop_width_m": self.crop_width_m, "tool_radius_m": self._radius_m}
        return PushLog(**by_name, outline_m=self.outline_m, **of_all)

    def _tool(self, where: str, tool_t: Any, tool_xy: Any) -> tuple[np.ndarray, np.ndarray]:
        t = _growing(where, "tool_t", tool_t)
        xy = _array(where, "tool_xy", tool_xy) * self._metres
        if xy.shape != (len(t), 2):
            raise ValueError(
                f"{where}: tool_xy must hold x and y at each of the {len(t)} times of tool_t, got "
                f"an array {xy.shape}"
            )
        return t, xy

    def _poses(self, where: str, name: str, values: Any) -> np.ndarray:
        """Convert poses (..., 3) to metres and radians; raises ValueError."""
        poses = _array(where, name, values)
        if poses.shape[-1:] != (3,):
            raise ValueError(f"{where}: {name} must be x, y and yaw, got {values!r:.80}")
        poses = poses * [self._metres, self._metres, self._radians]
        if (most := float(np.abs(poses[..., 2]).max())) > 2 * math.pi:
            raise ValueError(
                f"{where}: {name} has a yaw of {most:.3g} rad, but at most 2π is expected; angles "
                f"are read in {self._angle_unit}, see Log(angle_unit=...)"
            )
        return poses

    def _refuse_jumps(self, where: str, name: str, moved: np.ndarray, length_m: float) -> None:
        """Raise ValueError if the object's motion (k, 3) exceeds what the tool can cause.

        The lever arm of the rotation is taken to be at least the inscribed circle's radius.
        """
        most_m = length_m + SLACK_M
        most_rad = min(most_m / _inradius_m(self.outline_m), math.pi)
        for row, (x, y, turn) in enumerate(moved.tolist()):
            if abs(turn) > most_rad:
                raise ValueError(
                    f"{where}: pose {row} of start and {name} is turned by {turn:.3g} rad, but at "
                    f"most {most_rad:.2g} is expected; yaws are read in {self._angle_unit}"
                )
            if math.hypot(x, y) > most_m:
                raise ValueError(
                    f"{where}: pose {row} of start and {name} is {math.hypot(x, y):.3g} m away, "
                    f"but the tool moves {length_m:.3g} m after contact; is it another push's?"
                )

    def _context(self, where: str, context: Mapping[str, Any]) -> dict[str, Any]:
        expected = self._pushes[0]["context"] if self._pushes else context
        if set(context) != set(expected):
            raise ValueError(
                f"{where}: context names {sorted(context)}, but that of interaction 0 "
                f"{sorted(expected)}; use the same names in all interactions"
            )
        return dict(context)


def _array(where: str, name: str, values: Any) -> np.ndarray:
    array = check_array(f"{where}: {name}", values)
    if len(array) > MOST_ROWS:
        raise ValueError(
            f"{where}: {name} has {len(array)} rows, but one push may have at most {MOST_ROWS}; "
            "split the recording at each push, or subsample it"
        )
    return array


def _growing(where: str, name: str, times: Any) -> np.ndarray:
    t = _array(where, name, times)
    if t.ndim != 1 or len(t) < 2:
        raise ValueError(f"{where}: {name} must be at least two times (m,), got {t.shape}")
    if (stuck := np.flatnonzero(np.diff(t) <= 0)).size:
        row = int(stuck[0]) + 1
        raise ValueError(
            f"{where}: {name} must increase, but row {row} is {t[row].item()!r} after "
            f"{t[row - 1].item()!r}; remove repeated rows, and check that no column is missing"
        )
    return t


def centred(corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return a polygon's centroid (2,) and its corners (k, 2) relative to it, counter-clockwise."""
    if corners.ndim != 2 or len(corners) < 3:
        raise ValueError(f"outline must be at least three corners (k, 2), got {corners.shape}")
    following = np.roll(corners, -1, axis=0)
    # On which side of each edge each corner lies: crossing edges separate each other's corners.
    side = np.sign(cross((following - corners)[:, None], corners - corners[:, None]))
    parts = side * np.roll(side, -1, axis=1) <= 0
    meet = np.triu(parts & parts.T, 2)
    meet[0, -1] = False  # these two are neighbours
    if meet.any():
        i, j = np.argwhere(meet)[0]
        raise ValueError(
            f"outline crosses itself: its edges from corner {i} and from corner {j} meet; "
            "give the corners in order around it, each once"
        )
    doubled = cross(corners, following)
    if abs(doubled.sum()) < 1e-9:
        raise ValueError("outline has no area; give its corners in order around it")
    centroid = ((corners + following) * doubled[:, None]).sum(axis=0) / (3 * doubled.sum())
    return centroid, (corners - centroid)[:: 1 if doubled.sum() > 0 else -1]


def _inradius_m(outline_m: np.ndarray) -> float:
    """Return the distance [m] from the centroid to the nearest edge."""
    edges = np.roll(outline_m, -1, axis=0) - outline_m
    return float(np.abs(cross(edges, outline_m) / np.linalg.norm(edges, axis=1)).min())


def _contact(where: str, outline_m: np.ndarray, tool: np.ndarray, radius_m: float) -> dict:
    """Find the contact where the path (m, 2) of a tool with a radius first enters the outline."""
    edges = np.roll(outline_m, -1, axis=0) - outline_m
    inward = np.stack([-edges[:, 1], edges[:, 0]], axis=1) / np.linalg.norm(edges, axis=1)[:, None]
    off = tool[:, None] - outline_m
    depth = (off * inward).sum(axis=-1) + radius_m
    share = depth[:-1] / np.where(depth[:-1] == depth[1:], np.inf, depth[:-1] - depth[1:])
    at = tool[:-1, None] + share[..., None] * (tool[1:] - tool[:-1])[:, None] + radius_m * inward
    along = ((at - outline_m) * edges).sum(axis=-1) / (edges**2).sum(axis=-1)
    enters = (depth[:-1] <= 0) & (depth[1:] > 0) & (along >= 0) & (along <= 1)
    if not enters.any():
        on = np.clip((off * edges).sum(axis=-1) / (edges**2).sum(axis=-1), 0, 1)
        gap = np.linalg.norm(off - on[..., None] * edges, axis=-1).min() - radius_m
        raise ValueError(
            f"{where}: tool_xy never enters the outline from outside (smallest gap {gap:.3g} m); "
            "start and tool_xy must share a frame and unit, and a thick tool needs tool_radius"
        )
    step, edge = np.argwhere(enters)[0]
    inside, path = depth[step + 1 :, edge], tool[step + 1 :] + radius_m * inward[edge]
    deepest, final = inside.max().item(), inside[-1].item()
    if deepest - final > (most := OFF_M + OFF_SHARE * deepest):
        raise ValueError(
            f"{where}: the tool goes back: it is {deepest:.3g} m inside the outline at most, "
            f"but {final:.3g} m at the end; cut tool_xy where the push ends"
        )
    travelled = path[-1] - at[step, edge]
    length = float(np.linalg.norm(travelled))
    if not 1e-4 < length < LARGEST_M:
        raise ValueError(
            f"{where}: tool_xy continues for {length:.3g} m after contact, but 0.1 mm to "
            f"{LARGEST_M:g} m are expected; check the unit of lengths"
        )
    if (off := np.abs(cross(travelled, path - at[step, edge])).max() / length) > most:
        raise ValueError(
            f"{where}: the push is not straight: tool_xy is {off:.3g} m from the line from contact "
            f"to end, but at most {most:.3g} m is expected; cut tool_xy where the push ends"
        )
    return {
        "contact_m": at[step, edge],
        "normal": inward[edge],
        "direction": travelled / length,
        "length_m": length,
    }
