"""Work in units, each of which leaves a part: one JSON file that says by hashes what it is of.

A part that is there is not made again; one of another configuration or other data is refused. What
the units are is told by `units.py` and `lever_up.py`.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import fields
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import xarray as xr
from tqdm.auto import tqdm

from affordlib.interactions import open_interactions
from affordlib.paths import resolve_out_dir

if TYPE_CHECKING:
    from dask.distributed import Client


class AnyUnit(Protocol):
    """Something to run that leaves a part."""

    @property
    def file(self) -> str:
        """The name of its part."""


Run = Callable[[Any, Path], bool]
"""Makes a unit's part in a folder; whether that had to be done."""


@lru_cache(maxsize=4)
def open_once(name: str) -> xr.Dataset:
    """A shipped data set, kept open between units."""
    return open_interactions(name)


def sha256_of(told: dict[str, Any]) -> str:
    """Hash of plain values."""
    return hashlib.sha256(json.dumps(told, sort_keys=True).encode()).hexdigest()


def options_of(config: Any) -> dict[str, Any]:
    """All options that decide a training."""
    apart = ("max_minutes", "device", "temperature")  # of the machine; fitted anyway
    return {f.name: getattr(config, f.name) for f in fields(config) if f.name not in apart}


def checked_part(unit: AnyUnit, folder: Path, expected: dict[str, Any]) -> dict[str, Any] | None:
    """A unit's part; None when there is none, ValueError when it holds other hashes."""
    path = folder / unit.file
    if not path.is_file():
        return None
    part = json.loads(path.read_text())
    for name, value in expected.items():
        if part.get(name) != value:
            raise ValueError(
                f"part {unit.file} has another {name} than its unit has now; delete it and run "
                "the unit again"
            )
    return part


def run_parts(
    units: Sequence[AnyUnit],
    run: Run,
    out_dir: str | Path,
    client: Client | None = None,
    progress: bool = True,
) -> int:
    """Run what is missing of some units, in order, or on a Dask client's workers; how many ran.

    Workers write their parts themselves, so `out_dir` must be a folder that they share.
    """
    folder = resolve_out_dir(out_dir)
    ran = 0
    made = _here(units, folder, run) if client is None else _away(units, folder, run, client)
    with tqdm(total=len(units), desc="units", unit=" units", disable=not progress) as bar:
        for unit, had_to in made:
            ran += had_to
            bar.set_postfix_str(unit.file.removesuffix(".json"))
            bar.update()
    return ran


def _here(units: Sequence[AnyUnit], folder: Path, run: Run) -> Iterator[tuple[AnyUnit, bool]]:
    for unit in units:
        yield unit, run(unit, folder)


def _away(
    units: Sequence[AnyUnit], folder: Path, run: Run, client: Client
) -> Iterator[tuple[AnyUnit, bool]]:
    from dask.distributed import as_completed

    futures = {client.submit(run, unit, folder, pure=False): unit for unit in units}
    try:
        for future in as_completed(list(futures)):
            yield futures[future], future.result()
    finally:
        client.cancel(list(futures))
