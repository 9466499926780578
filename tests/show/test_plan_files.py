import json
import math

import numpy as np
import pytest

from affordlib.primitives import Drag, Push, PushAt, Rotate
from affordlib.results import load_plan, save_plan
from affordlib.types import Goal, Plan, Step

PATH = np.array([[0.0, 0.1], [1 / 3, 0.2]])


def saved(tmp_path, primitive=Push(0.0)):  # noqa: B008
    step = Step(primitive, 0.7, (0.1, 0.2), PATH, path_xy_m=PATH / 7)
    plan = Plan(Goal((0.1, 0.2), 0.005), (0.0, 0.0), (step,), "any", False, 0.1)
    return save_plan(tmp_path / "new" / "plan.json", plan)


@pytest.mark.parametrize(
    "primitive", [Push(0.3, length=0.02), Drag(1.0), Rotate(), PushAt((0.02, 0.01), 2.0)]
)
def test_any_primitive_and_a_decoded_path_come_back(primitive, tmp_path):
    file = saved(tmp_path, primitive)
    (back,) = load_plan(file).steps
    assert back.primitive == primitive
    assert math.isnan(back.std_m)
    np.testing.assert_array_equal(back.path_xy_m, PATH / 7)
    assert json.loads(file.read_text())["steps"][0]["std_m"] is None


@pytest.mark.parametrize(
    ("content", "why"),
    [
        (b"{", "line 1"),
        (b"\xff", "utf-8"),
        (b"[]", "list"),
        (b"{}", "'steps' is missing"),
        (b'{"steps": [], "goal": {"xy_m": [0, 1' + 400 * b"0" + b"]}}", "two finite numbers"),
        (b"[" * 100_000, "recursion"),
    ],
)
def test_a_file_without_a_plan_is_named(content, why, tmp_path):
    file = tmp_path / "bad.json"
    file.write_bytes(content)
    with pytest.raises(ValueError, match=rf"(?s)bad\.json holds no plan.*{why}"):
        load_plan(file)


@pytest.mark.parametrize(
    ("place", "value"),
    [
        (("steps", 0, "stop_phase"), "0.5"),
        (("goal", "tolerance_m"), "0.02"),
        (("steps", 0, "primitive", "length"), "0.05"),
        (("steps", 0, "predicted_turn_rad"), None),
        (("steps", 0, "predicted_end_xy_m"), [math.inf, 0.0]),
        (("steps", 0, "path_xy_m"), [[0.0, math.nan]]),
        (("start_xy_m",), [math.nan, 0.0]),
        (("reaches_goal",), "yes"),
        (("plan_s",), []),
        (("steps",), {}),
    ],
)
def test_a_plan_with_a_wrong_value_is_refused_by_its_name(place, value, tmp_path):
    file = saved(tmp_path)
    inner = data = json.loads(file.read_text())
    for key in place[:-1]:
        inner = inner[key]
    inner[place[-1]] = value
    file.write_text(json.dumps(data))
    with pytest.raises(ValueError, match=place[-1]):
        load_plan(file)
