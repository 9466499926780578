"""Table 3: its rows, its variants, and that the committed one belongs to what is shipped."""

import json
from dataclasses import replace

import numpy as np
import pytest

from affordlib.evaluation.tasks import (
    GOAL_SOURCES,
    ROLLABLE,
    STANDING,
    PlanningTask,
    frozen_tasks,
    main,
)
from affordlib.paths import repo_root
from affordlib.planning import MODES, plan_astar
from affordlib.primitives import Drag
from affordlib.results import read_results
from experiments import planners, planning
from experiments.parts import parts_in
from experiments.planners import VARIANTS
from experiments.planning import (
    PARTS,
    attempt,
    decomposition_rows,
    paired_rows,
    planning_rows,
    tasks_sha256,
)

COMMITTED = parts_in(repo_root() / PARTS)


def records(distances, object_class="cuboid", mode="single_full", goals="constructed"):
    return [
        {
            "goals": goals,
            "mode": mode,
            "object_class": object_class,
            "distance_m": d,
            "predicted_m": 0.0,
            "surprise_m": d,
            "std_m": 0.001,
            "steps": 1,
            "actions": 1,
            "plan_s": 0.02,
        }
        for d in distances
    ]


def test_rows_are_told_for_all_for_groups_and_for_classes():
    some = records([0.001, 0.003]) + records([0.005], "sphere")
    rows = {r["object_class"]: r for r in planning_rows(some, planner="p")}
    assert set(rows) == {"all", "standing", "rollable", "cuboid", "sphere"}
    assert rows["all"]["mean_m"] == pytest.approx(0.003)
    assert rows["standing"]["n"] == 2
    assert rows["rollable"]["mean_m"] == pytest.approx(0.005)
    assert rows["cuboid"]["plan_ms_median"] == pytest.approx(20.0)


def test_what_execution_costs_is_told_by_the_plain_oracle():
    """Not by one that has a σ; and who is only asked about what stands has no row of all."""
    rows = []
    for name, distance in (("continuous", 1e-3), ("oracle", 2e-3), ("oracle_wary", 3e-3)):
        both = records([distance]) + records([distance], "sphere")
        rows += planning_rows(both, variant=name, nudged=False, **VARIANTS[name].columns())
    alone = records([9e-3])
    about = VARIANTS["astar_paper"].columns()
    rows += planning_rows(alone, variant="astar_paper", nudged=False, **about)
    told = {(r["variant"], r["object_class"]): r for r in decomposition_rows(rows)}
    assert told["continuous", "standing"]["execution_mean_m"] == pytest.approx(2e-3)
    assert told["continuous", "all"]["execution_mean_m"] == pytest.approx(2e-3)
    assert ("astar_paper", "standing") in told
    assert ("astar_paper", "all") not in told


def test_pairs_are_of_the_same_goals():
    parts = {
        "continuous": records([0.001, 0.002, 0.001]) + records([0.004], "sphere"),
        "gradient_direction": records([0.011, 0.012, 0.011]),
    }
    (row,) = paired_rows(parts)
    assert row["n"] == 3
    assert row["difference_mean_m"] == pytest.approx(0.01)
    assert row["low_m"] == pytest.approx(0.01)
    assert row["high_m"] == pytest.approx(0.01)


def test_a_task_survives_the_file():
    for task in frozen_tasks()[:4] + frozen_tasks("varied")[:4]:
        assert PlanningTask.from_json(json.loads(json.dumps(task.to_json()))) == task


def test_the_worlds_of_the_varied_goals_differ():
    tasks = frozen_tasks("varied")
    assert len({t.config.table_friction for t in tasks}) == len(tasks)
    assert all(t.config.camera == "kinect" for t in tasks)
    with pytest.raises(ValueError, match=r"world must be one of .*'noisy'"):
        frozen_tasks("noisy")


@pytest.mark.parametrize("which", ["clean", "varied"])
def test_frozen_goals_are_never_written_over(capsys, which):
    before = tasks_sha256(which)
    assert main(["--world", which]) == 1
    assert "frozen" in capsys.readouterr().err
    assert tasks_sha256(which) == before


def test_a_nudged_object_is_off_where_the_robot_believes_it(world, film):
    tasks = [t for t in frozen_tasks() if t.mode == "single_partial" and not t.thing.rollable][:8]
    planner = VARIANTS["continuous"].make()
    there, nudged = (
        np.mean([attempt(world, task, planner, nudged=n).distance_m for task in tasks])
        for n in (False, True)
    )
    assert there < 0.0005
    assert 0.0008 < nudged < 0.02


def test_a_variant_asked_every_so_often_is_compared_on_the_same_goals():
    every = {"varied": records([0.001, *[0.002] * 4, 0.003, *[0.004] * 4])}
    every["varied_oracle"] = records([0.001, 0.003])
    assert VARIANTS["varied_oracle"].every == 5
    (row,) = paired_rows(every, "varied")
    assert row["n"] == 2
    assert row["difference_mean_m"] == pytest.approx(0.0)


@pytest.mark.parametrize("name", VARIANTS)
def test_variants_are_asked_about_all_their_classes_alike(name):
    variant = VARIANTS[name]
    classes = variant.classes if variant.world == "clean" else STANDING
    asked = variant.asked(frozen_tasks(variant.world), lambda t: (t.goals, t.thing.family))
    for mode in MODES:
        of_mode = [t.thing.family for t in asked if t.mode == mode and t.goals == "constructed"]
        counts = [of_mode.count(family) for family in classes]
        assert sum(counts) == len(of_mode) > 0
        assert max(counts) - min(counts) <= 1


def test_the_goals_belong_to_what_decides_the_numbers():
    fewer = VARIANTS["gradient_25"]
    assert fewer.about() != replace(fewer, goals=GOAL_SOURCES).about()


def test_variants_ask_only_for_what_they_can():
    assert VARIANTS["continuous"].classes == STANDING + ROLLABLE
    assert VARIANTS["gradient_100"].classes == STANDING
    assert VARIANTS["oracle"].classes == STANDING + ROLLABLE
    abouts = [json.dumps(v.about(), sort_keys=True) for v in VARIANTS.values()]
    assert len(set(abouts)) == len(abouts)


@pytest.mark.slow
@pytest.mark.parametrize("rollable", [False, True])
def test_with_the_simulator_as_model_hardly_anything_remains(world, rollable):
    task = next(
        t for t in frozen_tasks() if t.mode == "single_partial" and t.thing.rollable == rollable
    )
    planner = VARIANTS["oracle"].make()
    outcome = attempt(world, task, lambda *query: planner(world, *query))
    assert outcome.distance_m < 0.001
    assert isinstance(outcome.plan.steps[0].primitive, Drag) == rollable


def test_the_committed_table_belongs_to_the_shipped_checkpoints():
    assert COMMITTED, "there are no parts; run python -m experiments.planning"
    parts = {name.removesuffix(".json"): part for name, part in COMMITTED.items()}
    for name, part in parts.items():
        assert part["about"] == VARIANTS[name].about(), f"{name} is stale; run it again"
        assert part["goals_sha256"] == tasks_sha256(VARIANTS[name].world)
    rows = read_results("data/results/planning.json")["tables"]["planning"]
    assert {row["variant"] for row in rows} == set(parts)
    for row in rows:
        if row["object_class"] == "all" and row["goals"] == "constructed":
            distances = [
                r["distance_m"]
                for r in parts[row["variant"]]["records"]
                if (r["mode"], r["goals"]) == (row["mode"], row["goals"])
            ]
            assert np.mean(distances) == pytest.approx(row["mean_m"])


def test_parts_of_other_settings_are_refused(monkeypatch):
    monkeypatch.setitem(planners.FORMATS, plan_astar, 99)
    with pytest.raises(ValueError, match=r"part astar\w*\.json is of other goals or settings"):
        planning.assemble()
