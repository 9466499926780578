"""The parameters of the notebooks: their defaults, the profiles, and what the reader sets.

Names and types are checked before anything runs: papermill itself only logs an unknown name.
"""

from __future__ import annotations

import ast
import difflib
import math
import re
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import nbformat
import yaml


class WorkbookError(Exception):
    """A batch that cannot start, or a notebook that failed; the text is for the reader."""


def notebook_paths(folder: Path) -> dict[str, Path]:
    """Return the notebooks of the book in order, by name."""
    return {path.stem: path for path in sorted(folder.glob("[0-9][0-9]_*.ipynb"))}


def read_notebook(path: Path) -> nbformat.NotebookNode:
    """Read a notebook; raises WorkbookError if it is none."""
    try:
        return nbformat.read(path, as_version=4)
    except Exception as error:
        raise WorkbookError(f"{path.name} is not a notebook that can be read: {error}") from None


def default_parameters(notebook: nbformat.NotebookNode, name: str) -> dict[str, Any]:
    """Return the parameters of a notebook: the plain literals of its cell tagged `parameters`."""
    cells = [c for c in notebook.cells if "parameters" in c.metadata.get("tags", [])]
    if len(cells) != 1:
        raise WorkbookError(f"{name} has {len(cells)} cells tagged 'parameters'; it needs one")
    defaults = {}
    try:
        for line in ast.parse(cells[0].source).body:
            if isinstance(line, ast.Assign):
                (target,) = line.targets
            elif isinstance(line, ast.AnnAssign):
                target = line.target
            else:
                raise ValueError(ast.unparse(line))
            defaults[target.id] = ast.literal_eval(line.value)
    except (SyntaxError, ValueError, AttributeError, TypeError) as error:
        raise WorkbookError(
            f"{name}: its parameters must be plain literals, one `name = value` each ({error})"
        ) from None
    missing = {"seed", "out_dir"} - defaults.keys()
    if missing:
        raise WorkbookError(f"{name} has no parameter {min(missing)!r}; every notebook takes it")
    return defaults


def read_profile(notebooks: Path, profile: str) -> dict[str, dict[str, Any]]:
    """Return the values of `profiles/<profile>.yaml`, `{notebook: {parameter: value}}`."""
    folder = notebooks / "profiles"
    choose("profile", profile, [path.stem for path in sorted(folder.glob("*.yaml"))])
    try:
        values = yaml.safe_load((folder / f"{profile}.yaml").read_text(encoding="utf-8")) or {}
        return {str(name): dict(entry or {}) for name, entry in values.items()}
    except (yaml.YAMLError, AttributeError, TypeError, ValueError) as error:
        raise WorkbookError(
            f"profile: {profile}.yaml must map notebooks to their parameters ({error})"
        ) from None


def choose(kind: str, given: str, known: Sequence[str]) -> str:
    """Return the known name that is meant; raises WorkbookError naming the near ones.

    A notebook may be meant by its number alone.
    """
    matches = [name for name in known if name == given or (given.isdigit() and name[:2] == given)]
    if len(matches) == 1:
        return matches[0]
    near = difflib.get_close_matches(given, known, n=3, cutoff=0.5)
    hint = f"did you mean {' or '.join(near)}?" if near else f"there are: {', '.join(known)}"
    raise WorkbookError(f"{kind} {given!r} is unknown; {hint}")


def fitting(where: str, value: object, default: object) -> Any:
    """Return a value as the type of its default; raises WorkbookError for one of another type."""
    if isinstance(default, float) and type(value) is int:
        return float(value)
    if isinstance(default, list | tuple) and isinstance(value, list | tuple):
        return [
            fitting(f"{where}[{i}]", each, default[0] if default else each)
            for i, each in enumerate(value)
        ]
    if default is not None and type(value) is not type(default):
        raise WorkbookError(
            f"{where} must be {type(default).__name__} like its default {default!r}, "
            f"got {type(value).__name__} {value!r:.60}"
        )
    if isinstance(value, int) and value < 0:
        raise WorkbookError(f"{where} must be a whole number from 0, got {value}")
    if isinstance(value, float) and not math.isfinite(value):
        raise WorkbookError(f"{where} must be a finite number, got {value}")
    return value


def parse_setting(setting: str) -> tuple[str, str, str]:
    """Split `NN_title.parameter=value`."""
    match = re.fullmatch(r"(?P<notebook>\w+)\.(?P<parameter>\w+)=(?P<value>.*)", setting)
    if not match:
        raise WorkbookError(f"{setting!r} is no setting; write it like 06_planning.n_goals=20")
    return match["notebook"], match["parameter"], match["value"]


def literal(text: str, default: object) -> Any:
    """Return the value that a command line means; text needs no quotes."""
    value: object = text
    for parse in (yaml.safe_load, ast.literal_eval):  # what neither can read is text
        with suppress(Exception):
            value = parse(text)
    return text if isinstance(default, str) and not isinstance(value, str) else value
