"""What one interaction leaves in a data set: its arrays, dimensions, units and provenance."""

from dataclasses import fields
from importlib import metadata

import numpy as np
import xarray as xr

from affordlib.interactions.recipes import Recipe, interact
from affordlib.primitives import PRIMITIVES, LeverUp, primitive_named
from affordlib.types import ACTION_CHANNELS, EFFECT_CHANNELS, IMAGE_CHANNELS, Interaction
from affordlib.world import CATEGORIES, Tabletop, TabletopObject, WorldConfig
from affordlib.world.execution import RECORDED_SAMPLES
from affordlib.world.trajectory import N_SAMPLES

GRAIN = 2.0**-20
"""About 1 µm or 1 µrad: what is smaller in a float32 is not kept."""

_VARIABLES = {
    "interaction": ("int64", ""),
    "image": ("float32", "image_channel row column", "m (depth), 1"),
    "action": ("float32", "sample action_channel", "m, rad; gripper 1 open, 0 closed"),
    "effect": ("float32", "sample effect_channel", "m, rad"),
    "rest_effect": ("float32", "effect_channel", "m, rad"),
    "tool": (
        "float32",
        "recorded_sample tool_channel",
        "m, rad, m",
        "measured x, y, z, yaw and finger gap, every 150 ms of a full execution",
    ),
    "stop_phase": ("float64", ""),
    "size": ("float32", "size_axis", "m"),
    "mass": ("float32", "", "kg"),
    "com_offset": ("float32", "xyz", "m"),
    "friction": ("float32", "surface", "", "of table, object, fingers"),
    "tip_offset": ("float32", "", "m", "how much higher than commanded the tool moved"),
    "start_pose": ("float64", "pose_channel", "m, m, rad"),
    "believed_xy": ("float64", "xy", "m", "where the robot took the object to be"),
    "rollable": ("bool", "", "", "can roll as it was placed"),
    "rolls": ("bool", "", "", "can roll as it lies at the end"),
    "fell": ("bool", "", "", "lies differently than it was placed"),
    "reached": ("bool", "", "", "the arm could do it; if not, nothing happened"),
    "success": ("bool", "", "", "the primitive did what it is for"),
    "tracking_error": ("float32", "", "m"),
    "penetration": ("float32", "", "m"),
    "left_table": ("bool", ""),
    "fault": ("bool", "", "", "not to be believed: exclude"),
}
"""Type, dimensions after the interaction, unit and meaning of what every set holds."""

_PARAMETER = ("float64", "", "m or rad", "parameter of the primitive")
_FULL_EFFECT = "the state of the full execution at stop_phase"
_PHASE = {
    "long_name": "normalised time of the primitive; of a partial one, times stop_phase",
    "every_150_ms": f"every {(N_SAMPLES - 1) // (RECORDED_SAMPLES - 1)}th sample",
}


def attributes_for(recipe: Recipe) -> dict[str, str]:
    """The attributes of a recipe's data set, known before it is collected."""
    if LeverUp.name in recipe.primitives and set(recipe.primitives) != {LeverUp.name}:
        raise ValueError(
            f"primitives {recipe.primitives} have images of different sizes; collect lever_up "
            "in a set of its own"
        )
    packages = ("affordlib", "numpy", "pybullet", "example-robot-data", "ur-analytic-ik")
    return {
        "recipe": recipe.to_json(),
        "image_channels": " ".join(IMAGE_CHANNELS),
        "action_channels": " ".join(ACTION_CHANNELS),
        "effect_channels": " ".join(EFFECT_CHANNELS),
        "frame": "origin where the object stood at the start, axes of the table",
        "versions": " ".join(f"{name}={metadata.version(name)}" for name in packages),
    }


def collect_chunk(recipe: Recipe, numbers: range) -> xr.Dataset:
    """The interactions of a recipe with the given numbers."""
    # Read when a set is made: a reader may have added categories and primitives.
    flags = {"primitive": " ".join(PRIMITIVES), "family": " ".join(CATEGORIES)}
    variables = _VARIABLES | dict.fromkeys(flags, ("int8", ""))
    kinds = [primitive_named(name) for name in recipe.primitives]
    parameters = sorted({name for kind in kinds for name in _field_names(kind)})
    variables |= dict.fromkeys(parameters, _PARAMETER)
    if recipe.partial:
        variables["full_effect"] = ("float32", "effect_channel", "m, rad", _FULL_EFFECT)
    rows = []
    with Tabletop(recipe.world) as world:
        for number in numbers:
            obj, done = interact(recipe, number, world)
            row = dict.fromkeys(parameters, np.nan) | _row(obj, done, world.config)
            if recipe.partial:
                _, full = interact(recipe, number, world, stop_phase=1.0)
                row["full_effect"] = [
                    np.interp(done.stop_phase, full.phase, effect) for effect in full.effect.T
                ]
            rows.append(row | {"interaction": number})
    data = {"phase": ("sample", np.linspace(0, 1, N_SAMPLES), _PHASE)}
    for name, (dtype, dims, *about) in variables.items():
        known = zip(("units", "long_name"), about, strict=False)
        attrs = {"flag_meanings": flags[name]} if name in flags else {k: v for k, v in known if v}
        values = np.stack([_grained(row[name], dtype) for row in rows])
        data[name] = (("interaction", *dims.split()), values, attrs)
    return xr.Dataset(data, attrs=attributes_for(recipe))


def _grained(value: object, dtype: str) -> np.ndarray:
    """A value as it is stored: float32 rounded to `GRAIN`, so that noise takes no space."""
    if dtype != "float32":
        return np.asarray(value, dtype=dtype)
    return (np.round(np.asarray(value, dtype=np.float64) / GRAIN) * GRAIN).astype(dtype)


def _row(obj: TabletopObject, done: Interaction, config: WorldConfig) -> dict[str, object]:
    """The values of an interaction by the names of variables, and others that are not stored."""
    primitive = done.primitive
    parameters = {name: getattr(primitive, name) for name in _field_names(type(primitive))}
    return (
        vars(done)
        | parameters
        | {
            "primitive": list(PRIMITIVES).index(primitive.name),
            "family": list(CATEGORIES).index(obj.category),
            "size": [*np.ptp(obj.footprint_m, axis=0), obj.height_m],
            "mass": config.density_kg_m3 * obj.volume_m3,
            "com_offset": config.com_offset_m,
            "friction": (config.table_friction, config.object_friction, config.finger_friction),
            "tip_offset": config.tip_offset_m,
            "believed_xy": done.estimated_xy_m,
            "rollable": obj.rollable,
            "success": done.success,
            "tracking_error": done.tracking_error_m,
            "penetration": done.penetration_m,
            "fault": bool(done.faults),
        }
    )


def _field_names(kind: type) -> list[str]:
    return [field.name for field in fields(kind)]
