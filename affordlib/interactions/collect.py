"""Collecting experience: seeded, resumable, in this process or on a Dask cluster.

Workers send back chunks of interactions, which are kept in a hidden folder beside the file until
all are there; a rerun makes only what is missing. The finished set is the same bits whoever
collected it, in whatever order.
"""

from __future__ import annotations

import os
import shutil
import threading
from collections.abc import Iterator
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import xarray as xr
from filelock import FileLock, Timeout
from tqdm.auto import tqdm

from affordlib.interactions.recipes import Recipe
from affordlib.interactions.schema import attributes_for, collect_chunk
from affordlib.interactions.store import (
    SUFFIX,
    CorruptedDataError,
    open_interactions,
    write_interactions,
)
from affordlib.types import check_count
from affordlib.workers import dask_client

if TYPE_CHECKING:
    import dask.distributed

CHUNK = 50
"""Interactions that are made, sent and kept together."""

_ONE_WORLD = threading.Lock()


def collect(
    recipe: Recipe,
    path: str | Path,
    client: dask.distributed.Client | None = None,
    workers: int = 1,
    progress: bool = True,
    replace: bool = False,
) -> str | Path:
    """Collect a recipe into a local file and return its path, which ends in .zarr.zip.

    client: of Dask; None means `workers` processes of this machine. A rerun makes what is missing;
    a whole file is made again only with `replace`. Raises ValueError for a path where anything else
    is, RuntimeError while another process collects into it, and when a chunk cannot be made.
    """
    if not str(path).endswith(SUFFIX):
        raise ValueError(f"path must end in {SUFFIX!r}, got {str(path)!r}")
    check_count("workers", workers)
    if client is None and workers > 1:
        with dask_client(workers) as local:
            return collect(recipe, path, local, progress=progress, replace=replace)

    attrs, file = attributes_for(recipe), Path(path).absolute()
    is_there = _is_there(file, attrs, replace)
    parts = file.with_name(f".{file.name}.parts")
    parts.mkdir(parents=True, exist_ok=True)
    try:
        with FileLock(parts / "lock", timeout=0):
            if not is_there:
                whole = _collected(recipe, attrs, parts, client, progress)
                write_interactions(whole, file)
            shutil.rmtree(parts, ignore_errors=True)
    except Timeout:
        raise RuntimeError(
            f"another process is collecting into {file}; wait for it or choose another path"
        ) from None
    except (KeyboardInterrupt, OSError) as error:
        error.add_note("finished chunks are kept; collect into the same path to go on")
        raise
    return path


def _attributes(file: Path) -> dict[str, str] | None:
    """The attributes of a set that is there, whole."""
    try:
        return open_interactions(file).attrs
    except (CorruptedDataError, OSError):
        return None


def _is_there(file: Path, attrs: dict[str, str], replace: bool) -> bool:
    """Whether this very set is there, and is to stay; ValueError if anything else is."""
    found = None if replace else _attributes(file)
    if found != attrs and (file.is_dir() or (os.path.lexists(file) and not replace)):
        what = "a set of another recipe, or of other package versions" if found else "no whole set"
        raise ValueError(
            f"path {file} is {what}; choose another path, delete it, or pass replace=True"
        )
    return found == attrs


def _collected(
    recipe: Recipe,
    attrs: dict[str, str],
    parts: Path,
    client: dask.distributed.Client | None,
    progress: bool,
) -> xr.Dataset:
    """The whole set; chunks that are missing among the parts are made."""
    n = recipe.n_interactions
    rows = [range(k, min(k + CHUNK, n)) for k in range(0, n, CHUNK)]
    kept = {r: parts / f"{r.start:08d}-{r.stop:08d}{SUFFIX}" for r in rows}
    missing = [r for r in rows if _attributes(kept[r]) != attrs]
    made = _made(partial(_make, recipe, attrs), missing, client)
    there, disable = n - sum(map(len, missing)), not progress
    bar = tqdm(total=n, initial=there, unit=" interactions", disable=disable)
    with closing(made), bar:
        for r, chunk in made:
            write_interactions(chunk, kept[r], level=1)  # read once: speed counts
            bar.update(len(r))
    chunks = [open_interactions(path) for path in kept.values()]
    return xr.concat(chunks, "interaction", data_vars="minimal", combine_attrs="override")


def _make(recipe: Recipe, attrs: dict[str, str], rows: range) -> xr.Dataset:
    """A chunk of a set that has these attributes; what a worker is sent."""
    here = attributes_for(recipe)
    if here != attrs:
        raise RuntimeError(
            f"this worker would make another set than the collector described: it has {here}, "
            f"not {attrs}; give both the same packages"
        )
    with _ONE_WORLD:  # threads of one worker take turns: the simulator gains nothing by them
        return collect_chunk(recipe, rows)


def _made(
    make: partial, missing: list[range], client: dask.distributed.Client | None
) -> Iterator[tuple[range, xr.Dataset]]:
    """Yield the rows and the data of each chunk as it is made, here or by the client's workers."""
    futures = {}
    if client is None:
        results = ((rows, partial(make, rows)) for rows in missing)
    else:
        from dask.distributed import as_completed

        futures = {client.submit(make, rows, pure=False): rows for rows in missing}
        results = ((futures.pop(f), f.result) for f in as_completed(list(futures)))
    try:
        for rows, result in results:
            try:
                chunk = result()
            except Exception as error:
                raise RuntimeError(
                    f"interactions {rows.start} to {rows.stop - 1} could not be collected: "
                    f"{type(error).__name__}: {error}; finished chunks are kept, collect again "
                    "into the same path when the cause is fixed"
                ) from error
            yield rows, chunk
    finally:
        if futures:
            client.cancel(list(futures))
