"""Goals and plans as JSON files, so that a plan can be kept, sent and carried out later.

A plan is written with its goal. Numbers come back to the last bit; what is not a number, such as
the σ that a planner did not give, is null in the file.
"""

from __future__ import annotations

import json
import math
import os
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np

from affordlib.primitives import Primitive, primitive_named
from affordlib.results import write_text_atomically
from affordlib.types import Goal, Plan, Step

_MARK = b'{\n "goal"'


def save_plan(path: str | os.PathLike[str], plan: Plan) -> Path:
    """Write a plan and its goal to a JSON file and return its path."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_text_atomically(path, json.dumps(_plain(plan), indent=1, allow_nan=False) + "\n", _MARK)
    return path


def plan_file(folder: Path, name: str) -> Path:
    """The file of a plan's name in a folder; raises ValueError for a name that leads elsewhere."""
    if not name or name in (".", "..") or Path(name).name != name or "\\" in name:
        raise ValueError(f"name must be a plain file name such as plan.json, got {name!r}")
    return folder / name


def load_plan(path: str | os.PathLike[str]) -> Plan:
    """Return the plan that `save_plan` wrote.

    Raises FileNotFoundError, or ValueError naming the file and what is wrong in it.
    """
    if not Path(path).is_file():
        raise FileNotFoundError(f"there is no plan {path}")
    try:
        return _plan(json.loads(Path(path).read_text(encoding="utf-8")))
    except Exception as error:
        what = f"{error.args[0]!r} is missing" if isinstance(error, KeyError) else str(error)
        raise ValueError(f"path: {path} holds no plan: {what}") from None


def _plain(value: Any) -> Any:
    if isinstance(value, Primitive):
        return {"name": value.name} | {
            f.name: _plain(getattr(value, f.name)) for f in fields(value)
        }
    if is_dataclass(value):
        return {f.name: _plain(getattr(value, f.name)) for f in fields(value)}
    if isinstance(value, np.ndarray | tuple | list):
        return [_plain(item) for item in value]
    if isinstance(value, np.generic):
        value = value.item()
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _plan(data: dict[str, Any]) -> Plan:
    goal = {k: tuple(v) if isinstance(v, list) else v for k, v in data["goal"].items()}
    return Plan(
        **data
        | {
            "goal": Goal(**goal),
            "start_xy_m": tuple(data["start_xy_m"]),
            "steps": _steps(data["steps"]),
        }
    )


def _steps(steps: list[dict[str, Any]]) -> tuple[Step, ...]:
    return tuple(_step(step) for step in steps)


def _step(data: dict[str, Any]) -> Step:
    arguments = dict(data["primitive"])
    path = data["path_xy_m"]
    return Step(
        **data
        | {
            "primitive": primitive_named(arguments.pop("name"))(**arguments),
            "predicted_end_xy_m": tuple(data["predicted_end_xy_m"]),
            "predicted_path_xy_m": _path(data["predicted_path_xy_m"]),
            "path_xy_m": None if path is None else _path(path),
            "std_m": math.nan if data["std_m"] is None else float(data["std_m"]),
        }
    )


def _path(values: list[list[float]]) -> np.ndarray:
    path = np.array(values, dtype=float)
    if path.ndim != 2:
        raise ValueError(f"a path must be points (n, 2), got an array {path.shape}")
    return path
