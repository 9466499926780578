"""Tables of planning and of the closed loop: rows, planners, trials, and models of the reach."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from affordlib import primitives
from affordlib.interactions import open_interactions
from affordlib.planning import MODES, Skills
from affordlib.planning.skills import Reachability
from affordlib.primitives import Drag, Grasp, Push, Rotate
from affordlib.results import repo_root
from affordlib.world import ROLLABLE, STANDING, Cuboid, UprightCylinder, WorldConfig
from experiments import closed_loop, obstacles, planning, shipped, speed, tasks
from experiments.closed_loop import N_TRIALS, run_trial, sample_trial
from experiments.feasibility import is_feasible, on_the_rim, possible
from experiments.field_baselines import FRONT_M, MechanicsMap
from experiments.planning import CONFIGS, attempt
from experiments.shipped import learn_reachability
from experiments.tasks import FROZEN, PlanningTask, frozen_tasks, tasks_sha256

KINDS = {"push": Push.towards, "drag": Drag.towards}
KINDS |= {"grasp": lambda _: Grasp(), "rotate": lambda _: Rotate()}
learned = pytest.fixture(lambda: learn_reachability(open_interactions("reach")), scope="module")


def test_mechanics_push_a_disc_ahead_and_turn_a_box_until_both_fingers_lie_on_a_face(world, film):
    for obj, turn_deg in ((UprightCylinder(0.06, 0.06), 0.0), (Cuboid(0.06, 0.06, 0.05), -20.0)):
        world.place(obj, (0.0, 0.0), math.radians(-turn_deg))
        effects = MechanicsMap(film, world.depth_image())
        ahead, left, turn = effects.query(np.zeros(1), torch.ones(1, 1))[0][0, 0].tolist()
        behind = math.sqrt(0.03**2 - 0.015**2) if turn_deg == 0 else 0.03
        assert ahead == pytest.approx(0.05 + FRONT_M + behind, abs=0.0025)
        assert math.degrees(turn) == pytest.approx(turn_deg, abs=1)
        assert (abs(left) < 0.0003) == (turn_deg == 0)


@pytest.mark.slow
def test_the_benchmarks_run():
    assert [row["median_ms"] > 0 for row in speed.planning(1)] == [True] * 8


def test_goals_survive_the_file_which_is_never_written_over(capsys):
    drawn, before = frozen_tasks("perturbed"), [tasks_sha256(which) for which in FROZEN]
    for task in frozen_tasks()[:4] + drawn[:4]:
        assert PlanningTask.from_json(json.loads(json.dumps(task.to_json()))) == task
    assert len({t.config.table_friction for t in drawn}) == len(drawn)
    assert all(t.config.camera == "kinect" for t in drawn)
    inside = [t.config.com_offset_m for t in frozen_tasks("perturbed_rollable")]
    assert all(y == 0 >= z for _, y, z in inside)  # round objects lie on their heavy side
    with pytest.raises(ValueError, match=r"world must be one of .*'noisy'"):
        frozen_tasks("noisy")
    assert shipped.main(["goals"]) == 0
    assert "all files exist" in capsys.readouterr().out
    assert [tasks_sha256(which) for which in FROZEN] == before


def test_goals_that_are_damaged_or_of_another_world_are_named(tmp_path, monkeypatch):
    content = (repo_root() / FROZEN["clean"]).read_bytes()
    monkeypatch.setattr(tasks, "FROZEN", {"clean": str(tmp_path / "planning.json")})
    other = (repo_root() / FROZEN["outside"]).read_bytes()
    for wrong in (b"", content[:-2], content.replace(b"7", b"8", 1), b"\xff" + content, other):
        (tmp_path / "planning.json").write_bytes(wrong)
        with pytest.raises(ValueError, match=r"planning\.json is damaged, or is not"):
            frozen_tasks()


def test_a_shipped_checkpoint_can_be_trained_again(monkeypatch, capsys):
    spec, saved = shipped.CHECKPOINT_SPECS["cnp_500"], []
    short = replace(spec, training=replace(spec.training, steps=2, batch_size=4, augment=False))
    monkeypatch.setitem(shipped.CHECKPOINT_SPECS, "cnp_500", short)
    monkeypatch.setattr(shipped, "save_checkpoint", lambda _, path, about: saved.append(path.name))
    shipped.train_checkpoint("cnp_500")
    assert saved == ["cnp_500.safetensors"]
    assert "2 steps" in capsys.readouterr().out


def test_planners_differ_and_are_asked_about_all_their_categories_alike():
    assert CONFIGS["continuous"].classes == STANDING + ROLLABLE
    assert CONFIGS["gradient_100_pushes"].classes == CONFIGS["outside"].classes == STANDING
    assert len({repr(config) for config in CONFIGS.values()}) == len(CONFIGS)
    for name, config in CONFIGS.items():
        tasks = frozen_tasks(config.world)
        chosen = [t for t in map(tasks.__getitem__, config.chosen(tasks)) if t.goals != "uniform"]
        for mode in MODES if "constructed" in config.sources else ():
            of_mode = [t.obj.category for t in chosen if t.mode == mode]
            counts = [of_mode.count(category) for category in config.classes]
            assert sum(counts) == len(of_mode), name
            assert of_mode or config.world == "validation" or mode not in config.modes, name
            assert max(counts) - min(counts) <= 1, name


def test_actions_are_placed_by_the_plan(world):
    task = next(t for t in frozen_tasks() if t.mode == "multi_partial" and not t.obj.rollable)
    pose, seen = CONFIGS["continuous"].pose(), []

    def watched(*query):
        seen.append(query)
        return CONFIGS["continuous"].planner(pose(*query))

    again, once = (attempt(world, task, watched, by_plan=by_plan) for by_plan in (False, True))
    assert len(seen) == 2
    assert again.distance_m != once.distance_m
    # Only the object's position in the plan matters, not that in the world.
    assert once.distance_m < 0.003


def test_the_cross_entropy_method_keeps_to_its_actions_and_reaches_goals(world):
    tasks = [t for t in frozen_tasks() if t.goals == "constructed" and not t.obj.rollable]
    config, ends = CONFIGS["cem"], []
    pose = config.pose()
    for task in tasks[::24]:
        world.place(task.obj, (0.0, 0.0), task.yaw_rad, config=task.config)
        plan = config.planner(pose(world.depth_image(), (0.0, 0.0), task.goal, task.mode))
        assert len(plan.steps) <= MODES[task.mode].max_steps
        assert MODES[task.mode].partial or all(s.stop_phase == 1 for s in plan.steps)
        ends.append(plan.predicted_distance_m)
    assert np.median(ends) < 0.001


@pytest.mark.parametrize(("name", "kind"), [("cnp_500", Push), ("drag_film_500", Drag)])
def test_a_network_decodes_the_kind_of_action_that_it_was_trained_on(world, name, kind):
    for task in frozen_tasks()[:4]:
        world.place(task.obj, (0.0, 0.0), task.yaw_rad)
        assert planning.decoded_kind(planning.network(name), world.depth_image()) is kind


def test_another_version_of_a_planner_makes_its_results_stale(monkeypatch):
    monkeypatch.setitem(planning.VERSIONS, planning.plan_astar, 99)
    with pytest.raises(ValueError, match=r"'astar\w*'} was made of another version"):
        planning.tables()


def test_a_row_has_the_statistics_of_its_goals():
    about = {"goals": "constructed", "mode": "single_full", "predicted_m": 0.0}
    about["prediction_error_m"] = 0.002
    ends = ("cuboid", 0.001), ("upright_cylinder", 0.003), ("sphere", 1.0)
    records = [about | {"object_class": name, "distance_m": end_m} for name, end_m in ends]
    standing, rollable = planning.summary_rows(planning.distances({"continuous": records}))
    assert (standing["n"], rollable["n"], standing["world"]) == ("2", "1", "clean")
    found = [standing[f"single_full_{name}_m"] for name in ("mean", "sem", "median")]
    assert found == pytest.approx([0.002, 0.001, 0.002])
    assert rollable["single_full_sem_m"] is None


def test_a_task_is_feasible_if_something_has_solved_it_in_the_clean_world():
    names, more = ("index", "row", "distance_m", "object_touched"), {"arm_touched": False}
    rows = [(0, "astar", 0.004, False), (1, "astar", 0.001, True), (1, "perturbed", 0.001, False)]
    rows += [(2, "search", 0.003, False), (2, "astar", 0.02, False)]
    rows = [more | {"family": "gate", "seed": 1} | dict(zip(names, r, strict=True)) for r in rows]
    table = obstacles.judged([*rows, rows[0] | {"index": 2, "seed": 2}, rows[1] | {"seed": 2}])
    assert "".join("ny"[yes] for yes in table.feasible) == "ynnyyyn"
    assert "".join("ny"[yes] for yes in table.success) == "ynyynyn"


def test_the_kinematic_oracle_is_the_kinematics(world):
    """Its circles around the base agree with the inverse kinematics of whole actions."""
    rng = np.random.default_rng(11)
    world.place(Cuboid(0.06, 0.05, 0.05), (0.0, 0.0))
    no = 0
    for _ in range(80):
        xy, angle = rng.uniform([-0.45, -0.65], [0.65, 0.65]), rng.uniform(-math.pi, math.pi)
        for kind, half in ((Push, 0.02), (Drag, 0.0)):
            action = kind.towards(angle)
            query = xy[None], np.array([angle]), np.array([action.length + half])
            said, near, far = (possible(kind, half, s, *query)[0] for s in (0.0, 0.004, -0.004))
            truth = world.can_reach(action, 1.0, tuple(xy))
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
        assert sample_trial(name, 5, 3) == sample_trial(name, 5, 3)
        assert sample_trial(name, 5, 3) != sample_trial(name, 5, 4)
        perturbed = sample_trial(name, 5, 3, "perturbed")
        assert perturbed.config.camera == "kinect"
        assert replace(perturbed, config=WorldConfig()) == sample_trial(name, 5, 3)
    with pytest.raises(ValueError, match="table must be one of"):
        sample_trial("speed", 0)


def test_an_open_loop_trial_measures_what_is_missing(monkeypatch):
    found, trial = run_trial("height", 0, world="open_loop"), sample_trial("height", 0)
    assert max(abs(found["height_error_m"]), found["distance_m"]) < 0.005
    # An empty plan has the whole height as its error, and does not move the object.
    monkeypatch.setattr(closed_loop, "execute_plan", lambda *_: None)
    idle = run_trial("height", 0, world="open_loop")
    assert abs(idle["height_error_m"]) == pytest.approx(trial.goal.height_m, abs=1e-4)
    assert idle["distance_m"] == pytest.approx(np.hypot(*trial.goal.xy_m), abs=1e-4)


def test_it_agrees_with_kinematics_on_places_it_has_not_seen(learned, world):
    rng = np.random.default_rng(5)
    right = {True: [], False: []}
    for name, make in KINDS.items():
        for _ in range(250):
            xy, angle = rng.uniform([-0.42, -0.62], [0.62, 0.62]), rng.uniform(-math.pi, math.pi)
            truth = world.can_reach(make(angle), 1.0, xy)
            direction = angle if name in ("push", "drag") else None
            said = learned.probability(name, xy, direction)[0] > 0.5
            right[truth].append(said == truth)
    assert np.mean(right[True] + right[False]) >= 0.97
    assert 1 - np.mean(right[False]) < 0.15  # false 'reachable'
    assert len(right[False]) > 60


def test_the_shipped_one_was_learned_so(learned, tmp_path):
    """Rounding differs between processors, without consequences."""
    shipped = Reachability.load()
    rng = np.random.default_rng(6)
    places = rng.uniform([-0.42, -0.62], [0.62, 0.62], (4000, 2))
    angles = rng.uniform(-math.pi, math.pi, 4000)
    for name in KINDS:
        turn = angles if name in ("push", "drag") else None
        old, new = (m.probability(name, places, turn) for m in (shipped, learned))
        assert np.mean((old > 0.2) == (new > 0.2)) > 0.99
    learned.save(tmp_path / "mine.safetensors")
    mine = Reachability.load(tmp_path / "mine.safetensors").probability("push", places, angles)
    np.testing.assert_array_equal(mine, learned.probability("push", places, angles))
    assert [path.name for path in tmp_path.iterdir()] == ["mine.safetensors"]


def test_a_primitive_that_was_not_learned_is_left_to_the_kinematics(learned, film, monkeypatch):
    monkeypatch.setitem(primitives.PRIMITIVES, "tap", type("Tap", (Push,), {"name": "tap"}))
    assert (Reachability.load().probability("tap", np.zeros((2, 2))) == 1.0).all()
    # An unknown one, and other shapes, are named.
    with pytest.raises(ValueError, match=r"one of .*'push'.* got 'pusch'"):
        Skills({"pusch": film})
    with pytest.raises(ValueError, match=r"primitive must be one of .*, got 'kick'"):
        learned.probability("kick", np.zeros((1, 2)))
    with pytest.raises(ValueError, match=r"xy_m must be finite numbers of shape"):
        learned.probability("push", np.zeros((2, 3)), 0.0)
    with pytest.raises(ValueError, match=r"direction_rad must be finite numbers of shape"):
        learned.probability("push", np.zeros((2, 2)), np.zeros(3))
