"""Files: their locations, atomic writing, and the tables of results that a notebook writes.

A relative path starts at the repository, wherever a program runs. A notebook writes
`<out_dir>/<notebook>.json`, which contains
`{"notebook", "parameters", "versions", "tables": {name: [flat rows]}}`. Column names carry units
(`mean_m`, `plan_ms_median`, `tp_percent`). `python -m experiments.tables` fills pages from them.
"""

import glob
import importlib.metadata
import json
import math
import os
import platform
import re
import secrets
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import psutil

if TYPE_CHECKING:
    import pandas

# unit in the column's name: (displayed unit, factor, decimals); lengths are stored in metres
UNITS = {
    "m": ("mm", 1000.0, 2),
    "mm": ("mm", 1.0, 2),
    "cm": ("cm", 1.0, 3),
    "percent": ("%", 1.0, 1),
    "ms": ("ms", 1.0, 1),
    "s": ("s", 1.0, 2),
    "rad": ("°", 180 / math.pi, 1),
    "deg": ("°", 1.0, 1),
}
_MARK = b'{\n "notebook"'
_STATISTIC = "_(?:mean|median|sem|std|min|max|p5|p95)"
_WITH_UNIT = re.compile(f"(.+?)_({'|'.join(UNITS)})((?:{_STATISTIC})*)")


def repo_root() -> Path:
    """Return the root folder of the checkout; FileNotFoundError if the package is apart from it."""
    root = Path(__file__).resolve().parents[1]
    if not (root / "pyproject.toml").is_file():
        raise FileNotFoundError(
            f"affordlib is installed in {root}, apart from its notebooks and data; run "
            "`make setup` in the checkout, which installs it in place"
        )
    return root


def from_root(path: str | os.PathLike[str]) -> Path:
    """Return an absolute path; a relative one is resolved against the root of the repository."""
    path = Path(path).expanduser()
    return path if path.is_absolute() else repo_root() / path


def file_at(path: str | os.PathLike[str]) -> Path:
    """Return the absolute path of a file to read, resolved as in `from_root`.

    Raises FileNotFoundError unless it is a regular file: a pipe or a device might never end.
    """
    path = from_root(path)
    if not path.is_file():
        raise FileNotFoundError(f"there is no file {path}")
    return path


def resolve_out_dir(out_dir: str | os.PathLike[str]) -> Path:
    """Return the folder for results, resolved as in `from_root`; it is created if missing."""
    if not os.fspath(out_dir):
        raise ValueError("out_dir must name a folder, such as 'runs/lab', got ''")
    path = from_root(out_dir)
    try:
        path.mkdir(parents=True, exist_ok=True)
    except (FileExistsError, NotADirectoryError):
        raise NotADirectoryError(
            f"out_dir must be a folder, but {path} is, or lies under, a file; choose another"
        ) from None
    return path


def write_results(
    out_dir: str | os.PathLike[str],
    notebook: str,
    parameters: Mapping[str, Any],
    tables: Mapping[str, Any],
) -> Path:
    """Write a notebook's results to `<out_dir>/<notebook>.json` atomically and return the path.

    `tables` maps a name to rows, each a flat mapping from column to number, text, bool or None.
    A relative `out_dir` starts at the repository. Raises TypeError or ValueError, before anything
    is written, for values of other types or numbers that are not finite.
    """
    if not re.fullmatch(r"\w[\w.-]*", notebook) or notebook.endswith((".json", ".ipynb")):
        raise ValueError(
            f"notebook must be a plain name such as '06_planning', got {notebook!r}; "
            "leave out the folder and the file extension"
        )
    packages = ("affordlib", "torch", "pybullet", "numpy")  # whose versions affect numbers
    versions = {"python": platform.python_version()}
    versions |= {name: importlib.metadata.version(name) for name in packages}
    versions |= {"platform": f"{platform.system()} {platform.machine()}"}
    about = {"notebook": notebook, "parameters": _plain(parameters, "parameters")}
    blocks, dump = [], partial(json.dumps, ensure_ascii=False)
    for name, rows in _plain(tables, "tables").items():
        if not isinstance(rows, list) or not all(isinstance(row, dict) for row in rows):
            kind = type(rows).__name__
            raise TypeError(f"tables[{name!r}] must be a list of rows, each a dict, got {kind}")
        # One line per row, so that a changed number changes one line of the file.
        body = ",\n".join(f"   {dump(row)}" for row in rows)
        blocks.append(f"  {dump(name)}: [\n{body}\n  ]")
    lines = [f" {dump(k)}: {dump(v)},\n" for k, v in (about | {"versions": versions}).items()]
    text = "".join(["{\n", *lines, ' "tables": {\n', ",\n".join(blocks), "\n }\n}\n"])
    path = resolve_out_dir(out_dir) / f"{notebook}.json"
    write_atomically(path, text, _MARK)
    return path


def _plain(value: Any, where: str) -> Any:
    """Convert data to JSON's types; raises TypeError or ValueError that names the invalid entry."""
    value = value.item() if isinstance(value, np.generic) else value
    if isinstance(value, float) and not math.isfinite(value):
        raise ValueError(f"{where} is {value}; write None for a number that does not exist")
    if isinstance(value, Mapping):
        for key in value:
            if not isinstance(key, str) or not key:
                raise TypeError(f"{where} has the key {key!r}; names must be non-empty text")
        return {k: _plain(v, f"{where}[{k!r}]") for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(v, f"{where}[{i}]") for i, v in enumerate(value)]
    if value is None or isinstance(value, str | bool | int | float):
        return value
    raise TypeError(
        f"{where} must be a number, text, True, False or None, got {type(value).__name__}"
    )


def read_results(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Read a file that `write_results` wrote; a relative path starts at the repository.

    Raises FileNotFoundError if it is missing and ValueError if it is not a file of results.
    """
    try:
        path = file_at(path)
    except FileNotFoundError as error:
        raise FileNotFoundError(f"path: {error}; run the notebook that writes it") from None
    try:
        document = _plain(json.loads(path.read_text(encoding="utf-8")), "it")
        return {key: document[key] for key in ("notebook", "parameters", "versions", "tables")}
    except (ValueError, TypeError, KeyError, RecursionError) as error:
        raise ValueError(
            f"path: {path} holds no results ({error!r:.300}); delete it and run its notebook again"
        ) from None


def write_atomically(path: Path, content: bytes | str, mark: bytes = b"") -> None:
    """Replace a file with `content` atomically; a crash leaves the old file or the new one.

    mark: bytes near the start of every file of this type. Raises FileExistsError, and changes
    nothing, for a file without them, a folder or a broken link; OSError that names the file if it
    cannot be written. Missing folders are created, the file's mode is kept, a link is replaced.
    """
    if os.path.lexists(path):
        head = b""
        if path.is_file():
            with path.open("rb") as file:
                head = file.read(64) or mark
        if not path.is_file() or mark not in head:
            raise FileExistsError(
                f"{path} exists and is not a file that this call may replace; delete it, or "
                "choose another path"
            )
    path.parent.mkdir(parents=True, exist_ok=True)
    for left in path.parent.glob(f".{glob.escape(path.name)}.*.tmp"):  # of killed processes
        pid = left.name.split(".")[-3]
        if pid.isdigit() and not psutil.pid_exists(int(pid)):
            left.unlink(missing_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.{secrets.token_hex(8)}.tmp")
    try:
        with temporary.open("xb") as file:  # x: nothing that has this name is opened
            file.write(content.encode() if isinstance(content, str) else content)
            file.flush()
            os.fsync(file.fileno())
            if path.exists():
                os.fchmod(file.fileno(), path.stat().st_mode & 0o777)
        os.replace(temporary, path)
    except BaseException as error:
        temporary.unlink(missing_ok=True)
        if isinstance(error, OSError) and error.filename is None:
            error.filename = str(path)
        raise


def results_table(
    rows: Sequence[Mapping[str, Any]], columns: Sequence[str] | None = None
) -> "pandas.DataFrame":
    """Return rows as a table for display: text cells, lengths in mm, angles in degrees, few digits.

    `columns` selects and orders the columns. For calculations use the rows themselves.
    """
    import pandas  # imported here because its import takes as long as all others together

    names = columns_of(rows, columns)
    cells = [[cell(name, row.get(name)) for name in names] for row in rows]
    return pandas.DataFrame(cells, columns=[heading(n) for n in names], index=[""] * len(cells))


def heading(column: str) -> str:
    """Return the heading of a column: `plan_ms_median` becomes `plan median, ms`."""
    name, unit = _split_unit(column)
    return plain(name.replace("_", " ")) + (f", {unit[0]}" if unit else "")


def cell(column: str, value: object) -> str:
    """Return a value as text in the unit, and with the decimals, of its column's heading."""
    value = value.item() if isinstance(value, np.generic) else value
    if value is None:
        return "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    _, unit = _split_unit(column)
    if unit and isinstance(value, int | float):
        return f"{round(value * unit[1], unit[2]) + 0.0:.{unit[2]}f}"
    if isinstance(value, float):
        return f"{value:.3g}" if abs(value) < 999.5 else f"{value:.0f}"
    return plain(value)


def plain(text: object) -> str:
    """Return a text as one line without control characters, cut where it is very long."""
    return "".join(c if c.isprintable() else " " for c in str(text)[:2000])


def _split_unit(column: str) -> tuple[str, tuple[str, float, int] | None]:
    """Split a column's name into name and unit: its last word, or the last before a statistic."""
    found = _WITH_UNIT.fullmatch(column)
    return (found[1] + found[3], UNITS[found[2]]) if found else (column, None)


def columns_of(rows: Sequence[Mapping[str, Any]], columns: Sequence[str] | None) -> list[str]:
    """Return all column names of the rows, or `columns`; raises ValueError for an unknown one."""
    there = list(dict.fromkeys(name for row in rows for name in row))
    for name in columns or ():
        if rows and name not in there:
            known = plain(", ".join(there))
            raise ValueError(f"columns: {name!r} is not in the table; it has {known:.999}")
    return there if columns is None else list(columns)
