"""What one interaction leaves in a data set: its arrays, dimensions, units and provenance."""

from __future__ import annotations

from importlib import metadata

import numpy as np

from affordlib.interactions.chunks import AXIS, CHUNK, Layout, Variable
from affordlib.interactions.recipes import Recipe, interact
from affordlib.types import ACTION_CHANNELS, EFFECT_CHANNELS, IMAGE_CHANNELS, IMAGE_PIXELS
from affordlib.world import FAMILIES, Tabletop
from affordlib.world.scene import N_SAMPLES

TRACKING_LIMIT_M = 0.002

_SIZES = {
    "sample": N_SAMPLES,
    "action_channel": len(ACTION_CHANNELS),
    "effect_channel": len(EFFECT_CHANNELS),
    "image_channel": len(IMAGE_CHANNELS),
    "row": IMAGE_PIXELS,
    "column": IMAGE_PIXELS,
    "size_axis": 3,
    "pose_channel": 3,
}

_VARIABLES = {
    "interaction": Variable((AXIS,), "int64"),
    "phase": Variable(("sample",), "float64", {"long_name": "normalised time of the primitive"}),
    "image": Variable(
        (AXIS, "image_channel", "row", "column"), "float32", {"units": "m (depth), 1 (mask)"}
    ),
    "action": Variable(
        (AXIS, "sample", "action_channel"),
        "float32",
        {"units": "m, rad; gripper 1 open, 0 closed"},
    ),
    "effect": Variable((AXIS, "sample", "effect_channel"), "float32", {"units": "m, rad"}),
    "rest_effect": Variable((AXIS, "effect_channel"), "float32", {"units": "m, rad"}),
    "family": Variable((AXIS,), "int8", {"flag_meanings": " ".join(FAMILIES)}),
    "size": Variable((AXIS, "size_axis"), "float32", {"units": "m"}),
    "mass": Variable((AXIS,), "float32", {"units": "kg"}),
    "theta": Variable((AXIS,), "float64", {"units": "rad"}),
    "start_pose": Variable((AXIS, "pose_channel"), "float64", {"units": "m, m, rad"}),
    "tracking_error": Variable((AXIS,), "float32", {"units": "m"}),
    "fault": Variable((AXIS,), "bool", {"long_name": "the simulator failed: exclude"}),
}


def describe(recipe: Recipe, chunk: int = CHUNK) -> Layout:
    """The layout of a recipe's data set: all that is known of it before it is collected."""
    packages = ("affordlib", "numpy", "pybullet", "example-robot-data", "ur-analytic-ik")
    attrs = {
        "recipe": recipe.to_json(),
        "image_channels": " ".join(IMAGE_CHANNELS),
        "action_channels": " ".join(ACTION_CHANNELS),
        "effect_channels": " ".join(EFFECT_CHANNELS),
        "frame": "origin where the object stood at the start, axes of the table",
        "versions": " ".join(f"{name}={metadata.version(name)}" for name in packages),
    }
    return Layout(_VARIABLES, {AXIS: recipe.n_interactions, **_SIZES}, attrs, chunk)


def collect_chunk(recipe: Recipe, indices: range) -> dict[str, np.ndarray]:
    """The interactions of a recipe with the given numbers, as arrays by name.

    The first axis is the interaction, for all that have it in `describe`.
    """
    families = list(FAMILIES)
    rows: dict[str, list] = {}
    with Tabletop(recipe.world) as world:
        for index in indices:
            thing, seen = interact(recipe, index, world)
            extent = np.ptp(thing.footprint_m, axis=0)
            on_table = world.object_state()[2] > 0
            row = {
                "interaction": np.int64(index),
                "image": seen.image,
                "action": seen.action.astype(np.float32),
                "effect": seen.effect.astype(np.float32),
                "rest_effect": seen.rest_effect.astype(np.float32),
                "family": np.int8(families.index(thing.family)),
                "size": np.array([*extent, thing.height_m], dtype=np.float32),
                "mass": np.float32(recipe.world.density_kg_m3 * thing.volume_m3),
                "theta": np.float64(seen.primitive.theta),
                "start_pose": np.array(seen.start_pose),
                "tracking_error": np.float32(seen.tracking_error_m),
                "fault": np.bool_(seen.tracking_error_m > TRACKING_LIMIT_M or not on_table),
            }
            for name, value in row.items():
                rows.setdefault(name, []).append(value)
    arrays = {name: np.stack(values) for name, values in rows.items()}
    return {"phase": seen.phase, **arrays}
