"""The tables of the closed loop: trials by seed, the kinematic oracle, what rows tell."""

import math
import re

import numpy as np
import pytest

from affordlib.primitives import Drag, Push
from affordlib.world import Cuboid
from experiments import closed_loop
from experiments.closed_loop import N_TRIALS, draw_trial
from experiments.closed_loop_tables import ROWS
from experiments.feasibility import is_feasible, on_the_rim, possible


def test_the_kinematic_oracle_is_the_kinematics(world):
    """Its circles around the base answer as the inverse kinematics of whole actions does."""
    rng = np.random.default_rng(11)
    world.place(Cuboid(0.06, 0.05, 0.05), (0.0, 0.0))
    no = 0
    for _ in range(80):
        xy, angle = rng.uniform([-0.45, -0.65], [0.65, 0.65]), rng.uniform(-math.pi, math.pi)
        for kind, half in ((Push, 0.02), (Drag, 0.0)):
            action = kind.towards(angle)
            length = action.length + half
            said = possible(kind, half)(xy[None], np.array([angle]), np.array([length]))[0]
            truth = world.can_reach(action, 1.0, tuple(xy))
            near = possible(kind, half, 0.004)(xy[None], np.array([angle]), np.array([length]))[0]
            far = possible(kind, half, -0.004)(xy[None], np.array([angle]), np.array([length]))[0]
            assert truth == said or near != far
            no += not truth
    assert no > 10


def test_an_object_cannot_be_pushed_back_from_where_it_can_be_pushed_to():
    outside, middle = (0.555, 0.0), (0.0, 0.0)
    assert is_feasible(Push, 0.03, middle, outside)
    assert not is_feasible(Push, 0.03, outside, middle)
    assert is_feasible(Drag, 0.03, outside, middle)
    assert not is_feasible(Drag, 0.03, middle, (0.68, 0.68))
    assert on_the_rim(Drag, 0.03, middle, (0.566, 0.0))


def test_trials_are_a_function_of_seed_and_number():
    for name in N_TRIALS:
        assert draw_trial(name, 5, 3) == draw_trial(name, 5, 3)
        assert draw_trial(name, 5, 3) != draw_trial(name, 5, 4)
    with pytest.raises(ValueError, match="table must be one of"):
        draw_trial("speed", 0)


def test_rows_tell_the_endings_and_both_rates():
    def record(feasible, ending, distance_m=0.001):
        return {
            "object_class": "sphere",
            "feasible": feasible,
            "ending": ending,
            "on_the_rim": False,
            "moved": ending != "unreachable",
            "vetoes": 1,
            "actions": 3,
            "distance_m": distance_m,
            "height_error_m": distance_m,
        }

    records = [record(True, "reached")] * 6 + [record(True, "gave_up", 0.1)] * 2
    records += [record(False, "unreachable")] * 3 + [record(False, "gave_up", 0.1)]
    (row,) = (r for r in ROWS["reachability"](records) if r["goals"] == r["object_class"] == "all")
    assert row["feasible_reached_percent"] == 75.0
    assert row["infeasible_refused_percent"] == 75.0
    assert row["right_percent"] == 75.0
    assert row["moved_for_nothing_percent"] == 25.0
    height = ROWS["height"](records)[0]
    assert (height["feasible"], height["within_percent"]) == (8, 75.0)
    assert height["off_m_mean"] == pytest.approx(0.001)
    lost = [record(True, "lost") | {"object_class": "cuboid"}] * 2
    of_class = {r["object_class"]: r for r in ROWS["height"](records + lost)}
    assert (of_class["cuboid"]["within_percent"], of_class["cuboid"]["lost"]) == (100.0, 2)
    assert of_class["cuboid"]["off_m_mean"] is None
    aside = [record(True, "reached") | {"distance_m": 0.02}] * 2  # as high, but not there
    assert ROWS["height"](records + aside)[0]["within_percent"] == 60.0


def test_a_table_of_other_models_is_refused(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(closed_loop, "repo_root", lambda: tmp_path)
    monkeypatch.setattr(closed_loop, "settings_sha256", lambda table, seed: table)
    monkeypatch.setattr(closed_loop, "run_table", lambda *asked: None)
    part = closed_loop._part("height", 0)
    closed_loop._write_records(part, "of other models", {})
    assert closed_loop.main(["--tables", "reachability", "--out", str(tmp_path)]) == 1
    words = capsys.readouterr().err
    assert re.search(r"height_0\.jsonl is of other models .*--tables height", words)
    assert not (tmp_path / "closed_loop.json").exists()
