"""Work in units, each of which leaves a part: one JSON document that says by hashes what it is of.

A part that is there is not made again; one of another configuration or other data is refused. While
units run, each part is a file of its own, so that a kill costs one unit; `pack` gathers them into
one file, a line a part, `<folder>.jsonl.gz`. What the units are is told by `units.py`,
`lever_up.py` and `planning.py`.
"""

from __future__ import annotations

import gzip
import hashlib
import json
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import fields
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import xarray as xr
from tqdm.auto import tqdm

from affordlib.interactions import open_interactions
from affordlib.paths import resolve_out_dir
from affordlib.results import write_atomically

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


def packed(folder: Path) -> Path:
    """The file into which the parts of a folder are gathered."""
    return folder.with_name(f"{folder.name}.jsonl.gz")


@lru_cache(maxsize=4)
def _unpacked(path: Path, _mtime_ns: int) -> dict[str, dict[str, Any]]:
    with gzip.open(path, "rt", encoding="utf-8") as file:
        lines = [json.loads(line) for line in file]
    return {line["file"]: line["part"] for line in lines}


def parts_in(folder: Path) -> dict[str, dict[str, Any]]:
    """All parts of a folder by their names, gathered or not."""
    path = packed(folder)
    found = dict(_unpacked(path, path.stat().st_mtime_ns)) if path.is_file() else {}
    found |= {p.name: json.loads(p.read_text()) for p in sorted(folder.glob("*.json"))}
    return found


def part_of(file: str, folder: Path) -> dict[str, Any] | None:
    """The part of a name, gathered or not; None where there is none."""
    if (path := folder / file).is_file():
        return json.loads(path.read_text())
    path = packed(folder)
    return _unpacked(path, path.stat().st_mtime_ns).get(file) if path.is_file() else None


def pack(folder: Path) -> None:
    """Gather the parts of a folder into one file; equal parts give equal bytes."""
    if loose := sorted(folder.glob("*.json")):
        lines = [{"file": name, "part": part} for name, part in sorted(parts_in(folder).items())]
        text = "".join(f"{json.dumps(line, separators=(',', ':'))}\n" for line in lines)
        write_atomically(packed(folder), gzip.compress(text.encode(), mtime=0))
        for path in loose:
            path.unlink()
    with suppress(OSError):  # something else lies in it
        folder.rmdir()


def checked_part(unit: AnyUnit, folder: Path, expected: dict[str, Any]) -> dict[str, Any] | None:
    """A unit's part; None when there is none, ValueError when it holds other hashes."""
    part = part_of(unit.file, folder)
    if part is None:
        return None
    for name, value in expected.items():
        if part.get(name) != value:
            raise ValueError(
                f"part {unit.file} has another {name} than its unit has now; run the unit "
                "again, which replaces it"
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
    pack(folder)
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
