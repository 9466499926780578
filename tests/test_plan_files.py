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
    ],
)
def test_a_file_without_a_plan_is_named(content, why, tmp_path):
    file = tmp_path / "bad.json"
    file.write_bytes(content)
    with pytest.raises(ValueError, match=why) as refusal:
        load_plan(file)
    assert f"{file} holds no plan" in str(refusal.value)
