"""The table in the browser, and what `table.js` needs to plan and draw, in JSON's types."""

import base64
import math
from pathlib import Path
from typing import Any

import anywidget
import numpy as np
import traitlets
from torch import nn

from affordlib.geometry import rotated
from affordlib.perception import adapt_to_object
from affordlib.planning import Skills
from affordlib.planning.effect_map import EffectMap
from affordlib.planning.free_space import FULL_AT_M, MARGIN_M, START_M, hand_m
from affordlib.primitives import DURATION_S, Push
from affordlib.types import ACTION_CHANNELS, TABLE_X_M, TABLE_Y_M, Obstacle, Plan
from affordlib.world import BASE_X_M, REACH_M, TabletopObject

PUSH_RUN_UP_M = 0.2
"""Largest distance [m] of a push's start from the object; it bounds the shaded reachable ring."""


class TableView(anywidget.AnyWidget):
    """The table from above, whose goal is dragged; see `table.js`.

    table: what `table_data` returns; object: `object_data`'s; scene: pose, goal, steps, trail and
    marks, and "answered", the number of the last request that it includes. obstacles: those on the
    table, as `obstacle_data` writes them. searched: lines [[x, y], …] [m] of the planner's search.
    wanted: x, y [m] and the growing number of a request for a goal. It sends {"press": "run"} and
    "stop", and plays {"motions": [x, y, yaw, lift, the hand's x, y, z, yaw, gap, bodies]} as they
    come, in 3-D too: of the bodies [a scene's name, their numbers], positions and quaternions.
    """

    _esm = Path(__file__).with_name("table.js")
    _css = Path(__file__).with_name("table.css")
    table = traitlets.Dict().tag(sync=True)
    object = traitlets.Dict().tag(sync=True)
    scene = traitlets.Dict().tag(sync=True)
    obstacles = traitlets.List().tag(sync=True)
    searched = traitlets.List().tag(sync=True)
    wanted = traitlets.List([0.0, 0.0, 0]).tag(sync=True)


def obstacle_data(obstacle: Obstacle) -> dict[str, Any]:
    """An obstacle in JSON's types; its corners, radius and height [m] make it again."""
    corners = [list(corner) for corner in obstacle.corners_m]
    return {"corners": corners, "radius": obstacle.radius_m, "height": obstacle.height_m}


def plan_data(plan: Plan, yaw_rad: float) -> list[dict[str, Any]]:
    """A plan's steps; yaw_rad: the object's yaw at the start."""
    steps, at = [], [*plan.start_xy_m, yaw_rad]
    for step in plan.steps:
        end = [*step.predicted_end_xy_m, yaw_rad + step.predicted_turn_rad]
        yaws = np.linspace(at[2], end[2], len(step.predicted_path_xy_m))
        path = np.column_stack([step.predicted_path_xy_m, yaws]).round(5)
        moves = hasattr(step.primitive, "direction_rad")
        about = {"from": at, "end": end, "path": path.tolist(), "stop": step.stop_phase}
        about["direction"] = step.primitive.direction_rad if moves else None
        about["name"] = step.primitive.name.removeprefix("push").replace("_", " ")
        steps.append(about | {"std": None if math.isnan(step.std_m) or not moves else step.std_m})
        at = end
    return steps


def object_data(obj: TabletopObject, effects: EffectMap, yaw_rad: float = 0.0) -> dict[str, Any]:
    """Outline, true and as seen, hand during an action, and effect map of an object, for JSON.

    yaw_rad: the object's yaw in the map's image.
    """
    action, seen = effects.kind.towards(0.0), rotated(effects.outline_m, -yaw_rad)
    size, path = hand_m(action).max(axis=0).tolist(), action.path(np.linspace(0, 1, 26))
    path = path[:, [0, ACTION_CHANNELS.index("gripper")]] * (1, action.opening_m)
    grip = None if isinstance(action, Push) else adapt_to_object(action, effects.image).grip_yaw
    return {
        "outline": obj.footprint_m.round(6).tolist(),
        "yaw": yaw_rad,
        "seen": seen.round(6).tolist(),
        "hand": {"size": size, "grip": grip, "path": path.round(5).tolist()},
        "margins": [START_M, MARGIN_M, FULL_AT_M],
        "map": effects.numbers(),
    }


def table_data(skills: Skills) -> dict[str, Any]:
    """The table, the ring in which the arm can push, and the skills' reachability, as JSON."""
    ring = [BASE_X_M, REACH_M[0] + PUSH_RUN_UP_M, REACH_M[1] - PUSH_RUN_UP_M]
    table = {"table": [*TABLE_X_M, *TABLE_Y_M], "ring": ring, "seconds": DURATION_S}
    if skills.reachability is None:
        return table
    layers = []
    for linear in skills.reachability.layers[::2]:
        numbers = nn.utils.parameters_to_vector(linear.parameters()).detach().numpy()
        packed = base64.b64encode(numbers.astype("<f4").tobytes()).decode()
        layers.append([linear.in_features, packed])
    reach = {"layers": layers, "primitives": list(skills.reachability.primitives)}
    return table | {"reach": reach | {"threshold": skills.threshold}}
