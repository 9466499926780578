"""Table 3: its rows, its planners, and that the committed one belongs to what is shipped."""

import json
from dataclasses import replace

import numpy as np
import pytest

from affordlib.evaluation.tasks import FROZEN, ROLLABLE, STANDING, PlanningTask, frozen_tasks
from affordlib.planning import MODES
from affordlib.primitives import Drag
from affordlib.results import read_results
from experiments import planning, shipped
from experiments.planning import (
    CONFIGS,
    attempt,
    decomposition_rows,
    paired_rows,
    planning_rows,
    tasks_sha256,
)
from experiments.runner import read


def records(distances, object_class="cuboid", tasks=None):
    about = {"goals": "constructed", "mode": "single_full", "object_class": object_class}
    about |= {"predicted_m": 0.0, "std_m": 0.001, "steps": 1, "actions": 1, "plan_s": 0.02}
    tasks = range(len(distances)) if tasks is None else tasks
    return [
        about | {"task": k, "distance_m": d, "prediction_error_m": d}
        for k, d in zip(tasks, distances, strict=True)
    ]


def test_rows_are_of_all_of_groups_and_of_categories():
    some = records([0.001, 0.003]) + records([0.005], "sphere")
    rows = {r["object_class"]: r for r in planning_rows(some, planner="p")}
    assert set(rows) == {"all", "standing", "rollable", "cuboid", "sphere"}
    assert rows["all"]["mean_m"] == pytest.approx(0.003)
    assert rows["standing"]["n"] == 2
    assert rows["rollable"]["mean_m"] == pytest.approx(0.005)
    assert rows["cuboid"]["plan_ms_median"] == pytest.approx(20.0)


def test_the_cost_of_execution_is_that_of_the_plain_oracle():
    """Not of the one with a σ; and planners for stable objects only have no row of all."""
    rows = []
    for name, distance in (("continuous", 1e-3), ("oracle", 2e-3), ("oracle_risk_averse", 3e-3)):
        both = records([distance]) + records([distance], "sphere")
        rows += planning_rows(both, planner=name, **CONFIGS[name].columns())
    rows += planning_rows(
        records([9e-3]), planner="astar_cnp_500", **CONFIGS["astar_cnp_500"].columns()
    )
    found = {(r["planner"], r["object_class"]): r for r in decomposition_rows(rows)}
    assert found["continuous", "standing"]["execution_mean_m"] == pytest.approx(2e-3)
    assert found["continuous", "all"]["execution_mean_m"] == pytest.approx(2e-3)
    assert ("astar_cnp_500", "standing") in found
    assert ("astar_cnp_500", "all") not in found


def test_pairs_are_of_the_same_goals():
    every = {"perturbed": records([0.001, *[0.002] * 4, 0.003])}
    every["perturbed_oracle"] = records([0.011, 0.013], tasks=(0, 5))
    (row,) = paired_rows(every, "perturbed")
    assert row["n"] == 2
    for name in ("difference_mean_m", "low_m", "high_m"):
        assert row[name] == pytest.approx(0.01)


def test_goals_survive_the_file_and_perturbed_worlds_differ():
    tasks = frozen_tasks("perturbed")
    for task in frozen_tasks()[:4] + tasks[:4]:
        assert PlanningTask.from_json(json.loads(json.dumps(task.to_json()))) == task
    assert len({t.config.table_friction for t in tasks}) == len(tasks)
    assert all(t.config.camera == "kinect" for t in tasks)
    with pytest.raises(ValueError, match=r"world must be one of .*'noisy'"):
        frozen_tasks("noisy")


def test_frozen_goals_are_never_written_over(capsys):
    before = [tasks_sha256(which) for which in FROZEN]
    assert shipped.main(["goals"]) == 0
    assert "all are there" in capsys.readouterr().out
    assert [tasks_sha256(which) for which in FROZEN] == before


def test_a_shipped_checkpoint_can_be_trained_again(monkeypatch, capsys):
    spec, saved = shipped.CHECKPOINT_SPECS["cnp_500"], []
    short = replace(spec, training=replace(spec.training, steps=2, batch_size=4, augment=False))
    monkeypatch.setitem(shipped.CHECKPOINT_SPECS, "cnp_500", short)
    monkeypatch.setattr(shipped, "save_checkpoint", lambda _, path, about: saved.append(path.name))
    shipped.train_checkpoint("cnp_500")
    assert saved == ["cnp_500.safetensors"]
    assert "2 steps" in capsys.readouterr().out


@pytest.mark.parametrize("name", CONFIGS)
def test_planners_are_asked_about_all_their_categories_alike(name):
    config, tasks = CONFIGS[name], frozen_tasks(CONFIGS[name].world)
    chosen = [tasks[k] for k in config.chosen(tasks)]
    for mode in MODES:
        of_mode = [t.obj.category for t in chosen if (t.mode, t.goals) == (mode, "constructed")]
        counts = [of_mode.count(category) for category in config.classes]
        assert sum(counts) == len(of_mode) > 0
        assert max(counts) - min(counts) <= 1


def test_planners_differ_and_are_asked_only_for_what_they_can():
    assert CONFIGS["continuous"].classes == CONFIGS["oracle"].classes == STANDING + ROLLABLE
    assert CONFIGS["gradient_100"].classes == CONFIGS["perturbed_oracle"].classes == STANDING
    assert len({json.dumps(planning.job(name).made_of()) for name in CONFIGS}) == len(CONFIGS)


def test_an_object_with_a_perturbed_start_is_missed_by_as_much(world):
    tasks = [t for t in frozen_tasks() if t.mode == "single_partial" and not t.obj.rollable][:4]
    planner = CONFIGS["continuous"].make(world)
    there, perturbed = (
        np.mean([attempt(world, t, planner, perturbed_start=p).distance_m for t in tasks])
        for p in (False, True)
    )
    assert there < 0.0005
    assert 0.0008 < perturbed < 0.02


@pytest.mark.slow
@pytest.mark.parametrize("rollable", [False, True])
def test_with_the_simulator_as_model_hardly_anything_remains(world, rollable):
    task = next(
        t for t in frozen_tasks() if t.mode == "single_partial" and t.obj.rollable == rollable
    )
    outcome = attempt(world, task, CONFIGS["oracle"].make(world))
    assert outcome.distance_m < 0.001
    assert isinstance(outcome.plan.steps[0].primitive, Drag) == rollable


def test_the_committed_tables_are_of_what_is_shipped(monkeypatch):
    measured = {about["config"]: result for about, result in read("planning", planning.job)}
    assert set(measured) == set(CONFIGS)
    committed = read_results("data/results/planning.json")["tables"]
    assert json.loads(json.dumps(planning.tables(measured))) == committed
    monkeypatch.setitem(planning.VERSIONS, planning.plan_astar, 99)
    with pytest.raises(ValueError, match=r"'astar\w*'} was made of another version"):
        read("planning", planning.job)
