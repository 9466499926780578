"""The table from above as a live picture in the notebook: it draws a scene and asks for a goal.

Everything it needs is in this package; nothing is fetched from anywhere.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import anywidget
import numpy as np
import traitlets

from affordlib.show.picker_controls import step_in_words
from affordlib.show.plots import ENLARGED
from affordlib.types import TABLE_X_M, TABLE_Y_M, Goal, Step
from affordlib.world import BASE_X_M, REACH_M, Tabletop, TabletopObject
from affordlib.world.motion import StepCallback

PUSH_RUN_UP_M = 0.2
_HERE = Path(__file__).parent


class TableView(anywidget.AnyWidget):
    """Shows a `scene` and plays a `film`; what the reader asks for arrives in `asked`.

    scene: as `make_scene` gives it. film: {"poses": [[x, y, yaw], ...], "seconds": s}, played when
    it changes. asked: [x_m, y_m, number], the number growing, so that equal goals differ. Pressing
    Enter or Escape on the table sends {"press": "run"} or {"press": "stop"}.
    """

    _esm = _HERE / "table_view.js"
    _css = _HERE / "table_view.css"
    scene = traitlets.Dict().tag(sync=True)
    film = traitlets.Dict().tag(sync=True)
    asked = traitlets.List([0.0, 0.0, 0]).tag(sync=True)


def make_scene(
    obj: TabletopObject,
    pose: Sequence[float],
    goal: Goal,
    steps: Sequence[Step],
    start: Sequence[float],
    turn_from_rad: float,
    truth_xy_m: Sequence[np.ndarray],
    half_width_m: float,
    limit_m: float,
    answered: int,
    running: bool = False,
    draft: bool = False,
    planning: bool = False,
) -> dict[str, Any]:
    """What `TableView` draws, in metres.

    pose: (x, y, yaw) of the object; steps: of the plan, from start (x, y, yaw) on; turn_from_rad:
    the yaw from which the goal's turn is counted; truth_xy_m: paths (n, 2) that the object has
    gone; half_width_m: of the view; limit_m: how far from the middle a goal may be asked for;
    answered: the number of the question that this answers; running: whether the robot is at work,
    so that a film goes on; draft: whether a better plan will follow;
    planning: whether one is being made.

    The shaded ring is where an object can be pushed towards any side: as far within the tool's
    reach as a push begins from the object.
    """
    inner, outer = REACH_M[0] + PUSH_RUN_UP_M, REACH_M[1] - PUSH_RUN_UP_M
    x, y, yaw = start
    starts = [(x, y), *(step.predicted_end_xy_m for step in steps)]
    return {
        "half_width": half_width_m,
        "limit": limit_m,
        "table": [*TABLE_X_M, *TABLE_Y_M],
        "reach": {"centre": [BASE_X_M, 0.0], "inner": inner, "outer": outer},
        "object": {"outline": rounded(obj.footprint_m), "pose": rounded(pose)},
        "goal": {
            "xy": rounded(goal.xy_m),
            "tolerance": goal.tolerance_m,
            "yaw": None if goal.turn_rad is None else round(turn_from_rad + goal.turn_rad, 4),
        },
        "steps": [
            {
                "start": rounded(starts[k]),
                "path": rounded(step.predicted_path_xy_m),
                "end": rounded(step.predicted_end_xy_m),
                "disc": None if math.isnan(step.std_m) else round(ENLARGED * step.std_m, 5),
                "yaw": round(yaw + step.predicted_turn_rad, 4),
                "direction": getattr(step.primitive, "direction_rad", None),
                "label": f"{k + 1}: {step_in_words(step)}",
            }
            for k, step in enumerate(steps)
        ],
        "truth": [rounded(path) for path in truth_xy_m],
        "answered": answered,
        "running": running,
        "draft": draft,
        "planning": planning,
    }


def draw_way(
    rng: np.random.Generator, xy_m: Sequence[float], least_m: float, most_m: float, limit_m: float
) -> np.ndarray:
    """A random displacement (2,) [m] of (x, y) that stays in sight; from outside, one towards it.

    limit_m: how far from the middle x and y may lie.
    """
    for _ in range(100):
        angle, far = rng.uniform(0, 2 * np.pi), rng.uniform(least_m, most_m)
        way = far * np.array([np.cos(angle), np.sin(angle)])
        if np.abs(np.add(xy_m, way)).max() < limit_m:
            return way
    return -far * np.array(xy_m) / np.hypot(*xy_m)


def whole_mm(x_m: float, y_m: float) -> tuple[float, float]:
    """A position [m] to the nearest millimetre."""
    return round(x_m, 3), round(y_m, 3)


def rounded(values: Any) -> list:
    """The numbers as nested lists, to a hundredth of a millimetre."""
    return np.round(np.asarray(values, dtype=float), 5).tolist()


EVERY = 12
"""Simulation steps (1/240 s) between two poses."""

_RESTING = 1e-4


def pose_recorder(poses: list[tuple[float, ...]], before: StepCallback | None) -> StepCallback:
    """A film for a world that appends the object's poses to a list, beside the world's own film."""
    steps = itertools.count()

    def record(world: Tabletop) -> None:
        if before is not None:
            before(world)
        if next(steps) % EVERY == 0:
            poses.append(world.object_pose())

    return record


def moving_part(poses: Sequence[tuple[float, ...]]) -> np.ndarray:
    """The poses (n, 3) from the first move to the last; none where nothing moved."""
    told = np.array(poses).reshape(-1, 3)
    moving = np.abs(np.diff(told, axis=0)).max(axis=1, initial=0.0) > _RESTING
    if not moving.any():
        return told[:0]
    first, last = np.flatnonzero(moving)[[0, -1]]
    return told[first : last + 2]
