"""Plans, with their goals, as JSON files that can be kept, sent, and executed later.

Numbers come back to the last bit; a σ that the planner did not give is null in the file.
"""

import json
import math
import os
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

from affordlib.primitives import Primitive, primitive_named
from affordlib.results import write_atomically
from affordlib.types import Goal, Plan, Step

_MARK = b'{\n "goal"'


def save_plan(path: str | os.PathLike[str], plan: Plan) -> Path:
    """Write a plan and its goal to a JSON file and return its path."""
    path = Path(path)
    text = json.dumps(plan, default=_as_data, indent=1, allow_nan=False)
    write_atomically(path, text + "\n", _MARK)
    return path


def load_plan(path: str | os.PathLike[str]) -> Plan:
    """Return the plan that `save_plan` wrote.

    Raises FileNotFoundError, or ValueError naming the file and what is wrong in it.
    """
    if not Path(path).is_file():
        raise FileNotFoundError(f"there is no plan {path}")
    try:
        data = json.loads(Path(path).read_text(encoding="utf-8"))
        return Plan(**data | {"goal": Goal(**data["goal"]), "steps": _steps(data["steps"])})
    except Exception as error:
        what = f"{error.args[0]!r} is missing" if isinstance(error, KeyError) else str(error)
        raise ValueError(f"path: {path} holds no plan: {what}") from None


def _as_data(value: Any) -> Any:
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    data = {field.name: getattr(value, field.name) for field in fields(value)}
    if isinstance(value, Primitive):
        return {"name": value.name} | data
    if isinstance(value, Step) and math.isnan(value.std_m):
        data["std_m"] = None
    return data


def _steps(steps: list[dict[str, Any]]) -> tuple[Step, ...]:
    return tuple(_step(**step) for step in steps)


def _step(**data: Any) -> Step:
    arguments = dict(data["primitive"])
    data["primitive"] = primitive_named(arguments.pop("name"))(**arguments)
    data["predicted_end_xy_m"] = tuple(data["predicted_end_xy_m"])
    data["std_m"] = math.nan if data["std_m"] is None else float(data["std_m"])
    for name in ("predicted_path_xy_m", "path_xy_m"):
        if data[name] is not None:
            data[name] = np.array(data[name], dtype=float)
            if data[name].ndim != 2:
                raise ValueError(f"{name} must be points (n, 2), got {data[name].shape}")
    return Step(**data)
