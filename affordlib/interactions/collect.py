"""Collecting experience: seeded, resumable, in this process or on a Dask cluster.

One task makes one whole chunk and writes its files itself; a rerun makes only what is missing.
The finished set is the same bits whoever collected it, in whatever order.
"""

from __future__ import annotations

import hashlib
import threading
from collections.abc import Iterable, Iterator
from contextlib import closing
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING

from tqdm.auto import tqdm

from affordlib.interactions.chunks import (
    CHUNK,
    Layout,
    create,
    metadata_files,
    read_chunk,
    write_chunk,
)
from affordlib.interactions.places import Place
from affordlib.interactions.recipes import Recipe
from affordlib.interactions.records import collect_chunk, describe
from affordlib.interactions.store import FOLDER_SUFFIX, SUFFIX, finish, is_finished, pack
from affordlib.types import check_count
from affordlib.workers import dask_client

if TYPE_CHECKING:
    import dask.distributed

WINDOW = 4
"""Tasks that each worker is given ahead; the driver knows of no more futures than these."""

_ONE_WORLD = threading.Lock()


@dataclass(frozen=True)
class _Task:
    """Makes the chunk of a number where it is missing; what a worker is sent."""

    recipe: Recipe
    layout: Layout
    place: Place

    def __call__(self, number: int) -> bool:
        """Whether the chunk had to be made."""
        if read_chunk(self.place, self.layout, number) is not None:
            return False
        here = describe(self.recipe, self.layout.chunk)
        if here != self.layout:
            raise RuntimeError(
                f"this worker would make another set than the collector described: it has "
                f"{here.attrs}, not {self.layout.attrs}; give both the same packages"
            )
        with _ONE_WORLD:  # threads of one worker take turns: the simulator gains nothing by them
            arrays = collect_chunk(self.recipe, self.layout.rows(number))
        write_chunk(self.place, self.layout, number, arrays)
        return True

    def failure(self, number: int, error: Exception) -> RuntimeError:
        """The error that says which interactions could not be made, and why."""
        rows = self.layout.rows(number)
        return RuntimeError(
            f"interactions {rows.start} to {rows.stop - 1} could not be collected: "
            f"{type(error).__name__}: {error}; finished chunks are kept, collect again into the "
            "same path when the cause is mended"
        )


def collect(
    recipe: Recipe,
    path: str | Path,
    client: dask.distributed.Client | None = None,
    workers: int = 1,
    progress: bool = True,
    replace: bool = False,
) -> str | Path:
    """Collect a recipe into `path` and return it.

    path: a file ending in .zarr.zip, or a folder ending in .zarr; local, or an fsspec URL that
    all workers reach. client: a Dask client to collect with; None means `workers` processes of
    this machine, or this process alone for 1. Interrupted, a rerun goes on with what is missing,
    and a zip that is there, whole, is not made again unless `replace` says so. Raises ValueError
    for a path or `workers` that cannot be, and where a set of another recipe is; RuntimeError while
    another process collects into the path, and when a chunk cannot be made.
    """
    if not str(path).endswith((SUFFIX, FOLDER_SUFFIX)):
        raise ValueError(f"path must end in {SUFFIX!r} or {FOLDER_SUFFIX!r}, got {str(path)!r}")
    check_count("workers", workers)
    place = Place.of(path)
    if place.is_private and (client is not None or workers > 1):
        raise ValueError(
            f"path {str(path)!r} lies in the memory of one process, which other workers do not "
            "see; collect with workers=1 and no client, or give a path that they share"
        )
    if client is None and workers > 1:
        with dask_client(workers) as local:
            return collect(recipe, path, local, progress=progress, replace=replace)

    layout = describe(recipe, CHUNK)
    if str(path).endswith(SUFFIX) and place.fs.isdir(place.root):
        raise ValueError(f"path {str(path)!r} is a folder; choose another path, or delete it")
    with place.locked():
        work = _working_place(place, layout)
        if not replace and work != place and is_finished(place, layout):
            work.delete_all()
            return path
        create(work, layout)
        task = _Task(recipe, layout, work)
        numbers = range(layout.n_chunks)
        results = _here(task, numbers) if client is None else _by_workers(client, task, numbers)
        with (
            closing(results),
            tqdm(
                total=recipe.n_interactions,
                desc=place.name,
                unit=" interactions",
                disable=not progress,
            ) as bar,
        ):
            try:
                for number, made in results:
                    count = len(layout.rows(number))
                    if progress and not made:
                        bar.initial += count  # what was there says nothing about the rate
                    bar.update(count)
            except KeyboardInterrupt as interrupt:
                interrupt.add_note("finished chunks are kept; collect into the same path to go on")
                raise
        finish(work, layout)
        if work != place:
            pack(work, place)
            work.delete_all()
    return path


def _working_place(place: Place, layout: Layout) -> Place:
    """Where chunks grow: beside a zip a hidden folder, which only the very same set finds again."""
    if not place.name.endswith(SUFFIX):
        return place
    digest = hashlib.sha256()
    for name, content in sorted(metadata_files(layout).items()):
        digest.update(name.encode() + content)
    return place.sibling(f".{place.name}.{digest.hexdigest()[:8]}.chunks")


def _here(task: _Task, numbers: Iterable[int]) -> Iterator[tuple[int, bool]]:
    """Yield each chunk's number, and whether it was made, after making it in this process."""
    for number in numbers:
        try:
            made = task(number)
        except Exception as error:
            raise task.failure(number, error) from error
        yield number, made


def _by_workers(
    client: dask.distributed.Client, task: _Task, numbers: Iterable[int], alone: bool = False
) -> Iterator[tuple[int, bool]]:
    """Yield each chunk's number, and whether it was made, as the client's workers finish it."""
    from dask.distributed import KilledWorker, as_completed

    waiting, running, killed = iter(numbers), as_completed(), []
    chunks = {}
    try:
        while True:
            room = WINDOW * max(1, len(client.nthreads())) - len(chunks)
            for number in islice(waiting, max(0, room)):
                future = client.submit(task, number, pure=False)
                chunks[future] = number
                running.add(future)
            if not chunks:
                break
            future = next(running)
            number = chunks.pop(future)
            try:
                made = future.result()
            except KilledWorker as error:
                if alone:
                    raise task.failure(number, error) from error
                killed.append(number)
                continue
            except Exception as error:
                raise task.failure(number, error) from error
            yield number, made
    finally:
        if chunks:
            client.cancel(list(chunks))
    # A chunk may only have shared its workers with the one that kills them: each goes alone now.
    for number in sorted(killed):
        yield from _by_workers(client, task, [number], alone=True)
