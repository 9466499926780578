"""The table of plans that are made from one look and carried out blindly."""

import numpy as np
import pytest

from affordlib.paths import repo_root
from affordlib.results import read_results
from experiments import whole_plans


def test_rows_are_told_for_each_planner_and_class():
    records = [
        {"planner": planner, "object_class": name, "off": off, "distance_m": 10 * off}
        | {"promised": off < 0.01, "arm_refused": False, "actions": 3}
        for planner, factor in (("astar", 1.0), ("continuous", 0.1))
        for name, off in (("sphere", 0.002 * factor), ("cuboid", 0.02 * factor))
    ]
    rows = whole_plans.whole_plan_rows(records, "m", 0.005)
    told = {(row["planner"], row["object_class"]): row for row in rows}
    assert len(told) == len(rows) == 6
    assert told["astar", "all"]["within_percent"] == 0.0  # 20 mm off at the best
    assert told["astar", "all"]["pose_within_percent"] == 50.0
    assert told["continuous", "all"]["within_percent"] == 50.0
    assert told["continuous", "all"]["pose_within_percent"] == 100.0
    assert told["astar", "cuboid"]["off_m_median"] == 0.02
    assert told["astar", "all"]["promised"] == 1
    assert told["astar", "all"]["distance_m_mean"] == pytest.approx(0.11)


def test_a_trial_measures_what_is_missing(world, skills, monkeypatch):
    record = whole_plans.run_trial("height", 0, "continuous", world, skills)
    trial = whole_plans.draw_trial("height", 0)
    assert record["promised"]
    assert record["off"] < 0.005
    assert record["distance_m"] < 0.005
    # A plan that does nothing leaves the whole height missing, and the object where it stood.
    monkeypatch.setattr(whole_plans, "execute_plan", lambda *_: None)
    idle = whole_plans.run_trial("height", 0, "astar", world, skills)
    assert idle["off"] == pytest.approx(trial.goal.height_m, abs=1e-4)
    assert idle["distance_m"] == pytest.approx(np.hypot(*trial.goal.xy_m), abs=1e-4)


@pytest.mark.slow
def test_the_table_is_written(tmp_path):
    assert whole_plans.main(["--n", "1", "--out", str(tmp_path)]) == 0
    tables = read_results(tmp_path / "whole_plans.json")["tables"]
    assert [len(tables[name]) for name in ("orientation", "height")] == [4, 4]


def test_the_committed_table_is_of_the_shipped_checkpoints():
    committed = read_results(repo_root() / "data" / "results" / "whole_plans.json")
    assert committed["parameters"] == whole_plans.made_with()
