"""What one interaction leaves in a data set: its arrays, dimensions, units and provenance."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from importlib import metadata

import numpy as np
import xarray as xr

from affordlib.interactions.recipes import Recipe, interact
from affordlib.primitives import PRIMITIVES, LeverUp, primitive_named
from affordlib.types import (
    ACTION_CHANNELS,
    EFFECT_CHANNELS,
    IMAGE_CHANNELS,
    Interaction,
)
from affordlib.world import CATEGORIES, Tabletop, TabletopObject, WorldConfig
from affordlib.world.execution import RECORDED_SAMPLES
from affordlib.world.trajectory import N_SAMPLES

GRAIN = 2.0**-20
"""About 1 µm or 1 µrad: what is smaller in a float32 is not kept."""

AXIS = "interaction"


@dataclass(frozen=True)
class Variable:
    """One array of a data set; `interaction`, where it has that dimension, comes first."""

    dims: tuple[str, ...]
    dtype: str
    attrs: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Schema:
    """What a data set will hold, known before it is made."""

    variables: dict[str, Variable]
    attrs: dict[str, str]

    def dataset(self, chunks: Sequence[dict[str, np.ndarray]]) -> xr.Dataset:
        """The set made of its chunks, in order."""
        data = {
            name: (
                variable.dims,
                np.concatenate([chunk[name] for chunk in chunks])
                if AXIS in variable.dims
                else chunks[0][name],
                variable.attrs,
            )
            for name, variable in self.variables.items()
        }
        return xr.Dataset(data, attrs=self.attrs)


def _per_interaction(dtype: str, *dims: str, **attrs: str) -> Variable:
    return Variable((AXIS, *dims), dtype, attrs)


_VARIABLES = {
    "interaction": _per_interaction("int64"),
    "phase": Variable(
        ("sample",),
        "float64",
        {
            "long_name": "normalised time of the primitive; of a partial one, times stop_phase",
            "every_150_ms": f"every {(N_SAMPLES - 1) // (RECORDED_SAMPLES - 1)}th sample",
        },
    ),
    "image": _per_interaction("float32", "image_channel", "row", "column", units="m (depth), 1"),
    "action": _per_interaction(
        "float32", "sample", "action_channel", units="m, rad; gripper 1 open, 0 closed"
    ),
    "effect": _per_interaction("float32", "sample", "effect_channel", units="m, rad"),
    "rest_effect": _per_interaction("float32", "effect_channel", units="m, rad"),
    "tool": _per_interaction(
        "float32",
        "recorded_sample",
        "tool_channel",
        units="m, rad, m",
        long_name="measured x, y, z, yaw and finger gap, every 150 ms of a full execution",
    ),
    "stop_phase": _per_interaction("float64"),
    "size": _per_interaction("float32", "size_axis", units="m"),
    "mass": _per_interaction("float32", units="kg"),
    "com_offset": _per_interaction("float32", "xyz", units="m"),
    "friction": _per_interaction("float32", "surface", long_name="of table, object, fingers"),
    "tip_offset": _per_interaction(
        "float32", units="m", long_name="how much higher than commanded the tool moved"
    ),
    "start_pose": _per_interaction("float64", "pose_channel", units="m, m, rad"),
    "believed_xy": _per_interaction(
        "float64", "xy", units="m", long_name="where the robot took the object to be"
    ),
    "rollable": _per_interaction("bool", long_name="can roll as it was placed"),
    "rolls": _per_interaction("bool", long_name="can roll as it lies at the end"),
    "fell": _per_interaction("bool", long_name="lies differently than it was placed"),
    "reached": _per_interaction("bool", long_name="the arm could do it; if not, nothing happened"),
    "success": _per_interaction("bool", long_name="the primitive did what it is for"),
    "tracking_error": _per_interaction("float32", units="m"),
    "penetration": _per_interaction("float32", units="m"),
    "left_table": _per_interaction("bool"),
    "fault": _per_interaction("bool", long_name="not to be believed: exclude"),
}

_FULL_EFFECT = _per_interaction(
    "float32",
    "effect_channel",
    units="m, rad",
    long_name="the state of the full execution at stop_phase",
)


def _parameters(recipe: Recipe) -> list[str]:
    """Names of the parameters of a recipe's primitives, in a fixed order."""
    kinds = [primitive_named(name) for name in recipe.primitives]
    return sorted({field.name for kind in kinds for field in fields(kind)})


def _variables(recipe: Recipe) -> dict[str, Variable]:
    # Read when a set is made: a reader may have added families and primitives.
    kinds = {"primitive": PRIMITIVES, "family": CATEGORIES}
    variables = _VARIABLES | {
        name: _per_interaction("int8", flag_meanings=" ".join(known))
        for name, known in kinds.items()
    }
    variables |= {
        name: _per_interaction("float64", units="m or rad", long_name="parameter of the primitive")
        for name in _parameters(recipe)
    }
    if recipe.partial:
        variables["full_effect"] = _FULL_EFFECT
    return variables


def schema_for(recipe: Recipe) -> Schema:
    """The schema of a recipe's data set: all that is known of it before it is collected."""
    lever = [name == LeverUp.name for name in recipe.primitives]
    if any(lever) and not all(lever):
        raise ValueError(
            f"primitives {recipe.primitives} have images of different sizes; collect lever_up "
            "in a set of its own"
        )
    packages = ("affordlib", "numpy", "pybullet", "example-robot-data", "ur-analytic-ik")
    attrs = {
        "recipe": recipe.to_json(),
        "image_channels": " ".join(IMAGE_CHANNELS),
        "action_channels": " ".join(ACTION_CHANNELS),
        "effect_channels": " ".join(EFFECT_CHANNELS),
        "frame": "origin where the object stood at the start, axes of the table",
        "versions": " ".join(f"{name}={metadata.version(name)}" for name in packages),
    }
    return Schema(_variables(recipe), attrs)


def collect_chunk(recipe: Recipe, indices: range) -> dict[str, np.ndarray]:
    """The interactions of a recipe with the given numbers, as arrays by name.

    The first axis is the interaction, for all that have it in `schema_for`.
    """
    variables = _variables(recipe)
    rows: dict[str, list] = {name: [] for name in variables if name != "phase"}
    with Tabletop(recipe.world) as world:
        for index in indices:
            obj, seen = interact(recipe, index, world)
            row = _row(obj, seen, world.config)
            if recipe.partial:
                _, full = interact(recipe, index, world, stop_phase=1.0)
                row["full_effect"] = np.array(
                    [np.interp(seen.stop_phase, full.phase, e) for e in full.effect.T]
                )
            for name in rows:
                value = index if name == "interaction" else row[name]
                rows[name].append(_grained(value, variables[name].dtype))
    return {"phase": np.linspace(0, 1, N_SAMPLES)} | {n: np.stack(v) for n, v in rows.items()}


def _grained(value: object, dtype: str) -> np.ndarray:
    """A value as it is stored: float32 rounded to `GRAIN`, so that noise takes no space."""
    if dtype != "float32":
        return np.asarray(value, dtype=dtype)
    return (np.round(np.asarray(value, dtype=np.float64) / GRAIN) * GRAIN).astype(dtype)


def _row(obj: TabletopObject, seen: Interaction, config: WorldConfig) -> dict[str, object]:
    parameters = {name: np.nan for kind in PRIMITIVES.values() for name in _fields(kind)}
    parameters |= {name: getattr(seen.primitive, name) for name in _fields(type(seen.primitive))}
    return parameters | {
        "image": seen.image,
        "action": seen.action,
        "effect": seen.effect,
        "rest_effect": seen.rest_effect,
        "tool": seen.tool,
        "primitive": list(PRIMITIVES).index(seen.primitive.name),
        "stop_phase": seen.stop_phase,
        "family": list(CATEGORIES).index(obj.category),
        "size": [*np.ptp(obj.footprint_m, axis=0), obj.height_m],
        "mass": config.density_kg_m3 * obj.volume_m3,
        "com_offset": config.com_offset_m,
        "friction": (config.table_friction, config.object_friction, config.finger_friction),
        "tip_offset": config.tip_offset_m,
        "start_pose": seen.start_pose,
        "believed_xy": seen.estimated_xy_m,
        "rollable": obj.rollable,
        "rolls": seen.rolls,
        "fell": seen.fell,
        "reached": seen.reached,
        "success": seen.success,
        "tracking_error": seen.tracking_error_m,
        "penetration": seen.penetration_m,
        "left_table": seen.left_table,
        "fault": bool(seen.faults),
    }


def _fields(kind: type) -> list[str]:
    return [field.name for field in fields(kind)]
