"""What `table.js` needs to plan and draw: an object, its effect map, where the arm can act."""

import base64
from typing import Any

import numpy as np
from torch import nn

from affordlib.planning import Skills
from affordlib.planning.effect_map import EffectMap
from affordlib.primitives import DURATION_S
from affordlib.types import ACTION_CHANNELS, TABLE_X_M, TABLE_Y_M
from affordlib.world import BASE_X_M, REACH_M, TabletopObject

PUSH_RUN_UP_M = 0.2
"""Largest distance [m] of a push's start from the object; it bounds the shaded reachable ring."""

HAND_SAMPLES = 26


def object_data(obj: TabletopObject, effects: EffectMap, yaw_rad: float = 0.0) -> dict[str, Any]:
    """Outline, motion of the hand along an action, and effect map of an object, in JSON's types.

    yaw_rad: the object's yaw in the map's image.
    """
    action = effects.kind.towards(0.0)
    path = action.path(np.linspace(0, 1, HAND_SAMPLES))
    along, opening = path[:, 0], path[:, ACTION_CHANNELS.index("gripper")] * action.opening_m
    return {
        "category": obj.category,
        "outline": obj.footprint_m.round(6).tolist(),
        "yaw": yaw_rad,
        "hand": {"along": along.round(5).tolist(), "gap": opening.round(5).tolist()},
        "map": effects.numbers(),
        "warning": effects.warning,
    }


def table_data(skills: Skills) -> dict[str, Any]:
    """The table, the ring in which the arm can push, and the skills' reachability, as JSON."""
    ring = [BASE_X_M, REACH_M[0] + PUSH_RUN_UP_M, REACH_M[1] - PUSH_RUN_UP_M]
    table = {"table": [*TABLE_X_M, *TABLE_Y_M], "ring": ring, "seconds": DURATION_S}
    if skills.reachability is None:
        return table
    linear = [layer for layer in skills.reachability.layers if isinstance(layer, nn.Linear)]
    layers = [
        [layer.in_features, _packed(layer.weight.detach().numpy(), layer.bias.detach().numpy())]
        for layer in linear
    ]
    reach = {"layers": layers, "primitives": list(skills.reachability.primitives)}
    return table | {"reach": reach | {"threshold": skills.threshold}}


def _packed(*values: np.ndarray) -> str:
    numbers = np.concatenate([value.ravel() for value in values]).astype("<f4")
    return base64.b64encode(numbers.tobytes()).decode()
