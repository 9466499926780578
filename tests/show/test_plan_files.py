import json
import math

import numpy as np
import pytest

from affordlib.plan_files import load_plan, save_plan
from affordlib.primitives import Drag, Push, Rotate
from affordlib.types import Goal, Plan, Step


@pytest.mark.parametrize("primitive", [Push(0.3, length=0.02), Drag(1.0), Rotate()])
def test_any_primitive_and_a_decoded_path_come_back(primitive, tmp_path):
    path = np.array([[0.0, 0.1], [1 / 3, 0.2]])
    step = Step(primitive, 0.7, (0.1, 0.2), path, path_xy_m=path / 7)
    plan = Plan(Goal((0.1, 0.2), 0.005), (0.0, 0.0), (step,), "any", False, 3, 0.1)
    file = save_plan(tmp_path / "new" / "plan.json", plan)
    (back,) = load_plan(file).steps
    assert back.primitive == primitive
    assert math.isnan(back.std_m)
    np.testing.assert_array_equal(back.path_xy_m, path / 7)
    assert json.loads(file.read_text())["steps"][0]["std_m"] is None


@pytest.mark.parametrize(
    ("content", "why"),
    [
        (b"{", "line 1"),
        (b"\xff", "utf-8"),
        (b"[]", "list"),
        (b"{}", "'goal' is missing"),
        (b'{"goal": {"xy_m": [9, 9], "tolerance_m": 0.02}}', "off the table"),
        (b'{"goal": {"xy_m": [0, 1' + 400 * b"0" + b"]}}", "two finite numbers"),
        (b"[" * 100_000, "recursion"),
    ],
)
def test_a_file_without_a_plan_is_named(content, why, tmp_path):
    file = tmp_path / "bad.json"
    file.write_bytes(content)
    with pytest.raises(ValueError, match=why) as refusal:
        load_plan(file)
    assert f"{file} holds no plan" in str(refusal.value)


@pytest.mark.parametrize(
    ("place", "value", "why"),
    [
        (("steps", 0, "stop_phase"), "0.5", "stop_phase"),
        (("goal", "tolerance_m"), "0.02", "tolerance_m"),
        (("steps", 0, "primitive", "length"), "0.05", "length"),
        (("steps", 0, "predicted_turn_rad"), None, "predicted_turn_rad"),
        (("steps", 0, "predicted_end_xy_m"), [math.inf, 0.0], "predicted_end_xy_m"),
        (("steps", 0, "path_xy_m"), [[0.0, math.nan]], "path_xy_m"),
        (("start_xy_m",), [1e9, 0.0], "start_xy_m"),
        (("reaches_goal",), "yes", "reaches_goal"),
        (("plan_s",), [], "plan_s"),
        (("steps",), {}, "steps"),
    ],
)
def test_a_plan_with_a_wrong_value_is_refused_by_its_name(place, value, why, tmp_path):
    step = Step(Push(0.0), 0.5, (0.02, 0.0), np.zeros((2, 2)), np.zeros((2, 2)))
    plan = Plan(Goal((0.05, 0.0)), (0.0, 0.0), (step,), "by hand", True, 1, 0.0)
    file = save_plan(tmp_path / "plan.json", plan)
    data = json.loads(file.read_text())
    inner = data
    for key in place[:-1]:
        inner = inner[key]
    inner[place[-1]] = value
    file.write_text(json.dumps(data))
    with pytest.raises(ValueError, match=why):
        load_plan(file)
