"""Collecting experience: seeded, resumable, in this process or on a Dask cluster.

Workers send back chunks of interactions, which are kept in a hidden folder beside the file until
all are there; a rerun makes only what is missing. The finished set is the same bits whoever
collected it, in whatever order.
"""

from __future__ import annotations

import hashlib
import io
import shutil
import threading
import zipfile
from collections.abc import Iterable, Iterator
from contextlib import closing, contextmanager
from functools import partial
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from filelock import FileLock, Timeout
from tqdm.auto import tqdm

from affordlib.interactions.recipes import Recipe
from affordlib.interactions.schema import collect_chunk, schema_for
from affordlib.interactions.store import (
    SUFFIX,
    CorruptedDataError,
    open_interactions,
    write_interactions,
)
from affordlib.results import write_atomically
from affordlib.types import check_count
from affordlib.workers import dask_client

if TYPE_CHECKING:
    import dask.distributed

CHUNK = 50
"""Interactions that are made, sent and kept together."""

WINDOW = 4
"""Chunks that each worker is given ahead; the driver knows of no more futures than these."""

_ONE_WORLD = threading.Lock()
_Arrays = dict[str, np.ndarray]


def _make(recipe: Recipe, rows: range, attrs: dict[str, str]) -> _Arrays:
    """A chunk of a set that has these attributes; what a worker is sent."""
    here = schema_for(recipe).attrs
    if here != attrs:
        raise RuntimeError(
            f"this worker would make another set than the collector described: it has {here}, "
            f"not {attrs}; give both the same packages"
        )
    with _ONE_WORLD:  # threads of one worker take turns: the simulator gains nothing by them
        return collect_chunk(recipe, rows)


def collect(
    recipe: Recipe,
    path: str | Path,
    client: dask.distributed.Client | None = None,
    workers: int = 1,
    progress: bool = True,
    replace: bool = False,
) -> str | Path:
    """Collect a recipe into a local file and return its path, which ends in .zarr.zip.

    client: a Dask client to collect with; None means `workers` processes of this machine, or this
    process alone for 1. Interrupted, a rerun goes on with what is missing, and a file that is
    there, whole, is not made again unless `replace` says so. Raises ValueError for a path or
    `workers` that cannot be, and where anything else is; RuntimeError while another process
    collects into the path, and when a chunk cannot be made.
    """
    if not str(path).endswith(SUFFIX):
        raise ValueError(f"path must end in {SUFFIX!r}, got {str(path)!r}")
    check_count("workers", workers)
    if client is None and workers > 1:
        with dask_client(workers) as local:
            return collect(recipe, path, local, progress=progress, replace=replace)

    schema, file = schema_for(recipe), Path(path).absolute()
    with _alone(file):
        digest = hashlib.sha256(str(schema.attrs).encode()).hexdigest()[:8]
        parts = file.with_name(f".{file.name}.{digest}.parts")
        if _is_there(file, schema.attrs, replace):
            shutil.rmtree(parts, ignore_errors=True)
            return path
        parts.mkdir(exist_ok=True)
        numbers = range(0, recipe.n_interactions, CHUNK)
        rows = {k: range(k, min(k + CHUNK, recipe.n_interactions)) for k in numbers}
        chunks = {k: _read_part(parts / f"{k:08d}.npz") for k in numbers}
        missing = [rows[k] for k in numbers if chunks[k] is None]
        n_there = recipe.n_interactions - sum(map(len, missing))
        task = partial(_make, recipe, attrs=schema.attrs)
        made = _here(task, missing) if client is None else _by_workers(client, task, missing)
        bar = tqdm(
            total=recipe.n_interactions,
            initial=n_there,
            desc=file.name,
            unit=" interactions",
            disable=not progress,
        )
        with closing(made), bar:
            try:
                for of, arrays in made:
                    _write_part(parts / f"{of.start:08d}.npz", arrays)
                    chunks[of.start] = arrays
                    bar.update(len(of))
            except (KeyboardInterrupt, OSError) as error:
                error.add_note("finished chunks are kept; collect into the same path to go on")
                raise
        write_interactions(schema.dataset([chunks[k] for k in numbers]), file)
        shutil.rmtree(parts, ignore_errors=True)
    return path


@contextmanager
def _alone(file: Path) -> Iterator[None]:
    """Hold the sole right to collect into a file; the lock dies with its process."""
    lock = file.with_name(f".{file.name}.lock")
    lock.parent.mkdir(parents=True, exist_ok=True)
    try:
        held = FileLock(lock).acquire(timeout=0)
    except Timeout:
        raise RuntimeError(
            f"another process is collecting into {file}; wait for it or choose another path"
        ) from None
    with held:
        try:
            yield
        finally:
            lock.unlink(missing_ok=True)  # who has opened it meanwhile finds it gone


def _is_there(file: Path, attrs: dict[str, str], replace: bool) -> bool:
    """Whether this very set is there, and is to stay; ValueError if anything else is."""
    if file.is_dir():
        raise ValueError(f"path {file} is a folder; choose another path, or delete it")
    if replace or not (file.exists() or file.is_symlink()):
        return False
    remedy = "choose another path, delete it, or pass replace=True"
    try:
        found = open_interactions(file).attrs
    except (CorruptedDataError, OSError) as error:
        raise ValueError(
            f"path {file} is no whole set of interactions ({error}); {remedy}"
        ) from error
    if found != attrs:
        raise ValueError(
            f"path {file} holds a set of another recipe, or of other package versions; {remedy}"
        )
    return True


def _write_part(path: Path, arrays: _Arrays) -> None:
    content = io.BytesIO()
    np.savez_compressed(content, **arrays)
    write_atomically(path, content.getvalue())


def _read_part(path: Path) -> _Arrays | None:
    """A chunk that was kept; None if it is missing or damaged, which its checksums tell."""
    try:
        with np.load(path, allow_pickle=False) as arrays:
            return dict(arrays)
    except (OSError, ValueError, EOFError, zipfile.BadZipFile):
        return None


def _failure(rows: range, error: Exception) -> RuntimeError:
    """The error that says which interactions could not be made, and why."""
    return RuntimeError(
        f"interactions {rows.start} to {rows.stop - 1} could not be collected: "
        f"{type(error).__name__}: {error}; finished chunks are kept, collect again into the same "
        "path when the cause is mended"
    )


def _here(task: partial, missing: Iterable[range]) -> Iterator[tuple[range, _Arrays]]:
    """Yield each chunk's interactions and arrays, made in this process."""
    for rows in missing:
        try:
            arrays = task(rows)
        except Exception as error:
            raise _failure(rows, error) from error
        yield rows, arrays


def _by_workers(
    client: dask.distributed.Client, task: partial, missing: Iterable[range], alone: bool = False
) -> Iterator[tuple[range, _Arrays]]:
    """Yield each chunk's interactions and arrays, as the client's workers finish them."""
    from dask.distributed import KilledWorker, as_completed

    waiting, running, killed = iter(missing), as_completed(), []
    chunks = {}
    try:
        while True:
            room = WINDOW * max(1, len(client.nthreads())) - len(chunks)
            for rows in islice(waiting, max(0, room)):
                future = client.submit(task, rows, pure=False)
                chunks[future] = rows
                running.add(future)
            if not chunks:
                break
            future = next(running)
            rows = chunks.pop(future)
            try:
                arrays = future.result()
            except KilledWorker as error:
                if alone:
                    raise _failure(rows, error) from error
                killed.append(rows)
                continue
            except Exception as error:
                raise _failure(rows, error) from error
            yield rows, arrays
    finally:
        if chunks:
            client.cancel(list(chunks))
    # A chunk may only have shared its workers with the one that kills them: each goes alone now.
    for rows in killed:
        yield from _by_workers(client, task, [rows], alone=True)
