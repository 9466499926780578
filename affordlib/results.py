"""Files of results: the tables that a notebook writes, and plans.

A notebook writes `<out_dir>/<notebook>.json`, which contains
`{"notebook", "parameters", "versions", "tables": {name: [flat rows]}}`. Column names carry units
(`mean_m`, `plan_ms_median`, `tp_percent`). `python -m experiments.tables` fills pages from them.

Plans, with their goals, are JSON files as well, and can be executed later. Numbers are restored to
the last bit; a σ that the planner did not provide is null in the file.
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
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import psutil

from affordlib.paths import file_at, from_root, resolve_out_dir
from affordlib.primitives import Primitive, primitive_named
from affordlib.types import Goal, Plan, Step

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
_MARK, _PLAN_MARK = b'{\n "notebook"', b'{\n "goal"'
_STATISTIC = "_(?:mean|median|sem|std|min|max|p5|p95)"
_WITH_UNIT = re.compile(f"(.+?)_({'|'.join(UNITS)})((?:{_STATISTIC})*)")


def versions() -> dict[str, str]:
    """Return the versions that affect numbers: Python, the package, the libraries, the platform."""
    packages = ("affordlib", "torch", "pybullet", "numpy")
    return {
        "python": platform.python_version(),
        **{name: importlib.metadata.version(name) for name in packages},
        "platform": f"{platform.system()} {platform.machine()}",
    }


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
    about = {"notebook": notebook, "parameters": _plain(parameters, "parameters")}
    lines = [f" {_dump(k)}: {_dump(v)},\n" for k, v in (about | {"versions": versions()}).items()]
    blocks = []
    for name, rows in _plain(tables, "tables").items():
        if not isinstance(rows, list) or not all(isinstance(row, dict) for row in rows):
            kind = type(rows).__name__
            raise TypeError(f"tables[{name!r}] must be a list of rows, each a dict, got {kind}")
        # One line per row, so that a changed number changes one line of the file.
        body = ",\n".join(f"   {_dump(row)}" for row in rows)
        blocks.append(f"  {_dump(name)}: [\n{body}\n  ]")
    text = "".join(["{\n", *lines, ' "tables": {\n', ",\n".join(blocks), "\n }\n}\n"])
    path = resolve_out_dir(out_dir) / f"{notebook}.json"
    write_atomically(path, text, _MARK)
    return path


def _dump(value: Any) -> str:
    return json.dumps(value, ensure_ascii=False)


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
            f"path: {path} holds no results ({error!r}); delete it and run its notebook again"
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


def save_plan(path: str | os.PathLike[str], plan: Plan) -> Path:
    """Write a plan and its goal to a JSON file and return its path."""
    path = from_root(path)
    text = json.dumps(plan, default=_as_data, indent=1, allow_nan=False)
    write_atomically(path, text + "\n", _PLAN_MARK)
    return path


def load_plan(path: str | os.PathLike[str]) -> Plan:
    """Load a plan that `save_plan` wrote.

    Raises FileNotFoundError, or ValueError that names the file and its fault.
    """
    path = file_at(path)
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
        if not isinstance(data["steps"], list):
            raise ValueError(f"steps must be a list, got {data['steps']!r:.40}")
        steps = tuple(_step(**step) for step in data["steps"])
        return Plan(**data | {"goal": Goal(**data["goal"]), "steps": steps})
    except Exception as error:
        what = f"{error.args[0]!r} is missing" if isinstance(error, KeyError) else str(error)
        raise ValueError(f"path: {path} holds no plan: {what}") from None


def _as_data(value: Any) -> Any:
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    data = {field.name: getattr(value, field.name) for field in fields(value)}
    if isinstance(value, Step) and math.isnan(value.std_m):
        data["std_m"] = None
    return {"name": value.name} | data if isinstance(value, Primitive) else data


def _step(**data: Any) -> Step:
    arguments = dict(data["primitive"])
    name = arguments.pop("name")
    data["primitive"] = primitive_named(name)(**arguments)
    data["predicted_end_xy_m"] = tuple(data["predicted_end_xy_m"])
    data["std_m"] = math.nan if data["std_m"] is None else float(data["std_m"])
    for name in ("predicted_path_xy_m", "path_xy_m"):
        if data[name] is not None:
            data[name] = np.array(data[name], dtype=float)
            if data[name].ndim != 2:
                raise ValueError(f"{name} must be points (n, 2), got {data[name].shape}")
    return Step(**data)


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
    return name.replace("_", " ") + (f", {UNITS[unit][0]}" if unit else "")


def factor(column: str) -> float:
    """Return the factor that converts a column's numbers to the unit of its heading."""
    _, unit = _split_unit(column)
    return UNITS[unit][1] if unit else 1.0


def cell(column: str, value: object) -> str:
    """Return a value as text in the unit, and with the decimals, of its column's heading."""
    value = value.item() if isinstance(value, np.generic) else value
    if value is None:
        return "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    _, unit = _split_unit(column)
    if unit and isinstance(value, int | float):
        digits = UNITS[unit][2]
        return f"{round(value * factor(column), digits) + 0.0:.{digits}f}"
    if isinstance(value, float):
        return f"{value:.3g}" if abs(value) < 999.5 else f"{value:.0f}"
    return " ".join(str(value).splitlines())


def _split_unit(column: str) -> tuple[str, str | None]:
    """Split a column's name into name and unit: its last word, or the last before a statistic."""
    found = _WITH_UNIT.fullmatch(column)
    return (found[1] + found[3], found[2]) if found else (column, None)


def columns_of(rows: Sequence[Mapping[str, Any]], columns: Sequence[str] | None) -> list[str]:
    """Return all column names of the rows, or `columns`; raises ValueError for an unknown one."""
    there = list(dict.fromkeys(name for row in rows for name in row))
    for name in columns or ():
        if rows and name not in there:
            raise ValueError(f"columns: {name!r} is not in the table; it has {', '.join(there)}")
    return there if columns is None else list(columns)
