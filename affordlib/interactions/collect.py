"""Collecting experience: seeded, resumable, in this process or on a Dask cluster.

One task makes one whole chunk and leaves it as a file of its own; a rerun makes only the missing
ones. The finished set is the same bits whoever collected it, in whatever order.
"""

from __future__ import annotations

import hashlib
import os
import tempfile
from contextlib import contextmanager
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import xarray as xr
from tqdm.auto import tqdm

from affordlib.interactions.recipes import Recipe, interact
from affordlib.interactions.store import CHUNK, SUFFIX, array_sha256, write_interactions
from affordlib.types import ACTION_CHANNELS, EFFECT_CHANNELS, IMAGE_CHANNELS
from affordlib.world import FAMILIES, Tabletop

if TYPE_CHECKING:
    from collections.abc import Iterator

    from dask.distributed import Client

TRACKING_LIMIT_M = 0.002

_UNITS = {
    "image": "m (depth), 1 (mask)",
    "action": "m, rad; gripper 1 open, 0 closed",
    "effect": "m, rad",
    "rest_effect": "m, rad",
    "size": "m",
    "mass": "kg",
    "theta": "rad",
    "start_pose": "m, m, rad",
    "tracking_error": "m",
}


def collect_chunk(recipe: Recipe, indices: range) -> dict[str, np.ndarray]:
    """The interactions of a recipe with the given numbers, as arrays by name."""
    families = list(FAMILIES)
    rows: dict[str, list] = {}
    with Tabletop(recipe.world) as world:
        for index in indices:
            thing, seen = interact(recipe, index, world)
            extent = np.ptp(thing.footprint_m, axis=0)
            on_table = world.object_state()[2] > 0
            row = {
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
    return {"phase": seen.phase, "index": np.array(indices), **arrays}


def _write_chunk(recipe: Recipe, indices: range, path: str) -> None:
    """Collect one chunk into a file that appears whole or not at all; the task of a worker."""
    arrays = collect_chunk(recipe, indices)
    folder = Path(path).parent
    handle, temporary = tempfile.mkstemp(dir=folder, prefix=".chunk")
    try:
        with os.fdopen(handle, "wb") as file:
            np.savez(file, **arrays, sha256=_chunk_sha256(arrays))
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except BaseException:
        Path(temporary).unlink(missing_ok=True)
        raise


def _chunk_sha256(arrays: dict[str, np.ndarray]) -> str:
    text = "".join(name + array_sha256(arrays[name]) for name in sorted(arrays))
    return hashlib.sha256(text.encode()).hexdigest()


def _read_chunk(path: Path) -> dict[str, np.ndarray] | None:
    """A finished chunk's arrays, or None when the file is missing or damaged."""
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        return arrays if str(arrays.pop("sha256")) == _chunk_sha256(arrays) else None
    except (OSError, ValueError, KeyError, EOFError):
        return None


def _as_dataset(arrays: dict[str, np.ndarray], recipe: Recipe) -> xr.Dataset:
    dims = {
        "image": ("interaction", "image_channel", "row", "column"),
        "action": ("interaction", "sample", "action_channel"),
        "effect": ("interaction", "sample", "effect_channel"),
        "rest_effect": ("interaction", "effect_channel"),
        "size": ("interaction", "size_axis"),
        "start_pose": ("interaction", "pose_channel"),
    }
    variables = {
        name: (
            dims.get(name, ("interaction",)),
            array,
            {"units": _UNITS[name]} if name in _UNITS else {},
        )
        for name, array in arrays.items()
        if name not in ("phase", "index")
    }
    data = xr.Dataset(variables, coords={"interaction": arrays["index"]})
    data["phase"] = ("sample", arrays["phase"], {"long_name": "normalised time of the primitive"})
    data["family"].attrs["flag_meanings"] = " ".join(FAMILIES)
    data["fault"].attrs["long_name"] = "the simulator failed: exclude"
    packages = ("affordlib", "numpy", "pybullet", "example-robot-data", "ur-analytic-ik")
    data.attrs = {
        "recipe": recipe.to_json(),
        "image_channels": " ".join(IMAGE_CHANNELS),
        "action_channels": " ".join(ACTION_CHANNELS),
        "effect_channels": " ".join(EFFECT_CHANNELS),
        "frame": "origin where the object stood at the start, axes of the table",
        "versions": " ".join(f"{name}={metadata.version(name)}" for name in packages),
    }
    return data


@contextmanager
def _exclusive(path: Path) -> Iterator[None]:
    """Hold a file lock that the system frees even after a kill; refuse a second collector."""
    import fcntl

    with open(path, "w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise RuntimeError(
                f"another process is collecting into {path.parent}; wait for it or choose another "
                "path"
            ) from error
        yield


def collect(
    recipe: Recipe,
    path: str | Path,
    client: Client | None = None,
    workers: int = 1,
    progress: bool = True,
) -> Path:
    """Collect a recipe into one file at `path` (ending in .zarr.zip) and return it.

    client: a Dask client to collect with; None means `workers` processes of this machine, or this
    process alone for 1. Interrupted, a rerun goes on with what is missing.
    """
    path = Path(path)
    if not path.name.endswith(SUFFIX):
        raise ValueError(f"path must end in {SUFFIX!r}, got {str(path)!r}")
    if isinstance(workers, bool) or not isinstance(workers, int) or workers < 1:
        raise ValueError(f"workers must be a whole number of at least 1, got {workers!r}")
    if client is None and workers > 1:
        from dask.distributed import Client, LocalCluster

        with (
            LocalCluster(
                n_workers=workers, threads_per_worker=1, dashboard_address=None
            ) as cluster,
            Client(cluster) as local,
        ):
            return collect(recipe, path, local, progress=progress)

    fingerprint = hashlib.sha256(recipe.to_json().encode()).hexdigest()[:8]
    folder = path.parent / f".{path.name}.{fingerprint}.chunks"
    folder.mkdir(parents=True, exist_ok=True)
    with _exclusive(folder / "lock"):
        everything = range(recipe.n_interactions)
        chunks = [everything[k : k + CHUNK] for k in everything[::CHUNK]]
        files = {chunk: folder.resolve() / f"{chunk.start:08d}.npz" for chunk in chunks}
        missing = [chunk for chunk in chunks if _read_chunk(files[chunk]) is None]
        bar = tqdm(
            total=recipe.n_interactions,
            desc=path.name,
            unit=" interactions",
            disable=not progress,
            initial=sum(len(chunk) for chunk in chunks if chunk not in missing),
        )
        with bar:
            for chunk in _done(recipe, missing, files, client):
                bar.update(len(chunk))
        write_interactions((_as_dataset(_read_chunk(files[c]), recipe) for c in chunks), path)
        for file in files.values():
            file.unlink()
        (folder / "lock").unlink()
    folder.rmdir()
    return path


def _done(
    recipe: Recipe, missing: list[range], files: dict[range, Path], client: Client | None
) -> Iterator[range]:
    """Yield each missing chunk's numbers as it is finished, here or by the client's workers."""
    if client is None:
        for chunk in missing:
            _write_chunk(recipe, chunk, str(files[chunk]))
            yield chunk
        return
    from dask.distributed import as_completed

    futures = {
        client.submit(_write_chunk, recipe, chunk, str(files[chunk]), pure=False, retries=2): chunk
        for chunk in missing
    }
    for future in as_completed(futures):
        future.result()
        yield futures[future]
