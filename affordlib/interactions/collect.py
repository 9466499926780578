"""Collection of data sets: seeded, resumable, in one or many processes, or on a Dask cluster.

This module also defines the variables of a data set: arrays, dimensions, units and provenance.

Workers return chunks of interactions, which are stored in a hidden folder beside the file until
all are complete; a rerun collects only missing chunks. The finished set is bit-identical for any
number of workers and any size and order of chunks. On a cluster:

    with Client("tcp://HOST:8786"), joblib.parallel_config("dask"):
        collect(recipe, path)
"""

import os
import shutil
from collections.abc import Callable
from contextlib import closing, suppress
from dataclasses import fields
from functools import partial
from importlib import metadata
from pathlib import Path

import numpy as np
import xarray as xr
from tqdm.auto import tqdm

from affordlib.interactions.recipes import Recipe, interact
from affordlib.interactions.store import SUFFIX, open_interactions, write_interactions
from affordlib.primitives import PRIMITIVES, LeverUp, primitive_named
from affordlib.results import from_root
from affordlib.types import (
    ACTION_CHANNELS,
    CROP_WIDTH_M,
    EFFECT_CHANNELS,
    IMAGE_CHANNELS,
    LEVER_CROP_WIDTH_M,
    Interaction,
    check_count,
)
from affordlib.workers import spread
from affordlib.world import CATEGORIES, Tabletop, TabletopObject, WorldConfig
from affordlib.world.execution import RECORDED_SAMPLES
from affordlib.world.trajectory import N_SAMPLES, interpolated

CHUNK = 50
"""Usual number of interactions per chunk, the unit that a worker collects, returns and stores."""

GRAIN = 2.0**-20
"""Resolution of stored float32 values, about 1 µm or 1 µrad, to which they are rounded."""

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
    "estimated_xy": ("float64", "xy", "m", "where the robot took the object to be"),
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
"""Type, dimensions after `interaction`, unit and meaning of the variables of every set."""

_PARAMETER = ("float64", "", "m or rad", "parameter of the primitive")
_FULL_EFFECT = "the state of the full execution at stop_phase"
_PHASE = {
    "long_name": "normalised time of the primitive; of a partial one, times stop_phase",
    "every_150_ms": f"every {(N_SAMPLES - 1) // (RECORDED_SAMPLES - 1)}th sample",
}


def collect(
    recipe: Recipe,
    path: str | Path,
    workers: int = 1,
    progress: bool = True,
    replace: bool = False,
    chunk: int | None = None,
) -> Path:
    """Collect a recipe's data set into a local file and return its path, which ends in .zarr.zip.

    A rerun collects missing chunks; a complete file is replaced only with `replace`. chunk:
    interactions per chunk, 50 by default. Raises ValueError if the path holds anything else, and
    RuntimeError if a chunk cannot be collected.
    """
    if not str(path).endswith(SUFFIX):
        raise ValueError(f"path must end in {SUFFIX!r}, got {str(path)!r}")
    check_count("workers", workers, 1, 256)
    size = check_count("chunk", CHUNK if chunk is None else chunk)
    attrs, file, n = attributes_for(recipe), from_root(path), recipe.n_interactions
    parts, missing, files = file.with_name(f".{file.name}.parts"), {}, {}
    if not _is_there(file, attrs, replace):
        for rows in (range(k, min(k + size, n)) for k in range(0, n, size)):
            name = f"interactions {rows.start} to {rows[-1]}"
            files[name] = parts / f"{rows.start:08d}-{rows.stop:08d}{SUFFIX}"
            if _attributes(files[name]) != attrs:
                missing[name] = rows
        left = sum(map(len, missing.values()))
        bar = tqdm(total=n, initial=n - left, unit=" interactions", disable=not progress)
        try:
            known = dict(PRIMITIVES), dict(CATEGORIES)
            make = partial(_with_classes, known, collect_chunk, recipe)
            with closing(spread(make, missing, workers)) as made, bar:
                for name, data in made:
                    if data.attrs != attrs:
                        there, here = data.attrs["versions"], attrs["versions"]
                        raise RuntimeError(f"{name} were made with {there}, but need {here}")
                    write_interactions(data, files[name], level=1)  # temporary, and fast
                    bar.update(len(missing[name]))
            chunks = [open_interactions(part) for part in files.values()]
            how = {"data_vars": "minimal", "combine_attrs": "override"}
            write_interactions(xr.concat(chunks, "interaction", **how), file)
        except (KeyboardInterrupt, OSError, RuntimeError) as error:
            if isinstance(error, OSError) and _attributes(file) == attrs:
                return file  # another process has just completed it
            error.add_note("finished chunks are kept; collect into the same path to continue")
            raise
    shutil.rmtree(parts, ignore_errors=True)  # also of a process that was killed at its very end
    return file


def _attributes(file: Path) -> dict[str, str] | None:
    """Return the attributes of a complete set, or None if there is none."""
    with suppress(ValueError, OSError):  # ValueError: it is damaged
        return open_interactions(file).attrs
    return None


def _is_there(file: Path, attrs: dict[str, str], replace: bool) -> bool:
    """Return whether the file is this set and is kept; raises ValueError for any other content."""
    found = None if replace else _attributes(file)
    if found != attrs and (file.is_dir() or (os.path.lexists(file) and not replace)):
        what = "a set of another recipe or of other package versions" if found else "not a full set"
        raise ValueError(
            f"path {file} is {what}; choose another path, delete it, or pass replace=True"
        )
    return found == attrs


def attributes_for(recipe: Recipe) -> dict[str, str]:
    """Return the attributes of a recipe's data set, which are known before it is collected."""
    if LeverUp.name in recipe.primitives and set(recipe.primitives) != {LeverUp.name}:
        raise ValueError(
            f"primitives {recipe.primitives} have images of different sizes; collect lever_up "
            "in a separate set"
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


def _with_classes(known: tuple[dict, dict], make: Callable, *arguments: object) -> object:
    """Call a function in a process that may not know the classes that a user has added."""
    for classes, here in zip(known, (PRIMITIVES, CATEGORIES), strict=True):
        here.update(classes)
    return make(*arguments)


def collect_chunk(recipe: Recipe, numbers: range) -> xr.Dataset:
    """Collect the interactions of a recipe with the given numbers."""
    # Evaluated at run time, because a user may have added categories and primitives.
    flags = {"primitive": " ".join(PRIMITIVES), "category": " ".join(CATEGORIES)}
    variables = _VARIABLES | dict.fromkeys(flags, ("int8", ""))
    kinds = [primitive_named(name) for name in recipe.primitives]
    parameters = sorted({field.name for kind in kinds for field in fields(kind)})
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
                row["full_effect"] = interpolated(done.phase[-1:], full.phase, full.effect)[0]
            rows.append(row | {"interaction": number})
    data = {"phase": ("sample", np.linspace(0, 1, N_SAMPLES), _PHASE)}
    for name, (dtype, dims, *about) in variables.items():
        known = zip(("units", "long_name"), about, strict=False)
        attrs = {"flag_meanings": flags[name]} if name in flags else {k: v for k, v in known if v}
        if name == "image":
            attrs["width_m"] = LEVER_CROP_WIDTH_M if LeverUp in kinds else CROP_WIDTH_M
        values = np.stack([row[name] for row in rows])
        if dtype == "float32":  # digits below the resolution compress badly
            values = np.round(values.astype(np.float64) / GRAIN) * GRAIN
        data[name] = (("interaction", *dims.split()), values.astype(dtype), attrs)
    return xr.Dataset(data, attrs=attributes_for(recipe))


def _row(obj: TabletopObject, done: Interaction, config: WorldConfig) -> dict[str, object]:
    """Return an interaction's values by variable name, including some that are not stored."""
    of_interaction = {name.removesuffix("_m"): value for name, value in vars(done).items()}
    parameters = {f.name: getattr(done.primitive, f.name) for f in fields(done.primitive)}
    row = of_interaction | parameters
    return row | {
        "primitive": list(PRIMITIVES).index(done.primitive.name),
        "category": list(CATEGORIES).index(obj.category),
        "size": [*np.ptp(obj.footprint_m, axis=0), obj.height_m],
        "mass": config.density_kg_m3 * obj.volume_m3,
        "com_offset": config.com_offset_m,
        "friction": (config.table_friction, config.object_friction, config.finger_friction),
        "tip_offset": config.tip_offset_m,
        "rollable": obj.rollable,
        "success": done.success,
        "fault": bool(done.faults),
    }
