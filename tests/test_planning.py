import itertools
import math

import numpy as np
import pytest
import torch

from affordlib.evaluation import constructed_tasks, measure, planning_rows, uniform_tasks
from affordlib.models import EffectModel
from affordlib.planning import carry_out, plan_astar, plan_gradient
from affordlib.planning.astar import Branches, predict_branches, search
from affordlib.primitives import Push
from affordlib.types import Goal, Observations, Prediction
from affordlib.world import Cuboid

IMAGE = np.zeros((2, 48, 48), dtype=np.float32)
REACH_M = 0.09


class KnownDynamics:
    """An `EffectModel` of which everything is known.

    The object moves away from where the gripper starts, from t = 0.6 on, by 9 cm in all; asked by
    a final effect, it answers with the nearest push.
    """

    action_channels = effect_channels = ("x", "y")

    def encode(self, image: torch.Tensor) -> torch.Tensor:
        return torch.zeros(len(image), 1)

    def predict(self, features: torch.Tensor, observations: Observations, t_target: torch.Tensor):
        start = observations.action[:, 0] + 1e-9
        wanted = observations.effect[:, 0]
        by_effect = observations.effect_mask.any(1, keepdim=True)
        direction = torch.where(by_effect, wanted, -start)
        direction = direction / direction.norm(dim=-1, keepdim=True)
        share = ((t_target - 0.6) / 0.4).clamp(0, 1)[..., None]
        effect = REACH_M * share * direction[:, None]
        action = (-0.2 + 0.25 * t_target[..., None]) * direction[:, None]
        std = torch.full_like(effect, 0.001)
        return Prediction(action, std, effect, std)


MODEL = KnownDynamics()


def test_the_known_dynamics_is_an_effect_model():
    assert isinstance(MODEL, EffectModel)


def random_branches(seed: int, n: int = 6) -> Branches:
    rng = np.random.default_rng(seed)
    effects = rng.uniform(-0.09, 0.09, size=(n, 2))
    path = np.repeat(effects[:, None], 25, axis=1)
    return Branches(np.zeros(n), np.ones(n), effects, np.zeros(n), path)


@pytest.mark.parametrize("seed", range(40))
def test_astar_finds_what_exhaustive_search_finds(seed):
    branches = random_branches(seed)
    rng = np.random.default_rng(1000 + seed)
    goal = Goal(tuple(rng.uniform(-0.2, 0.2, 2)), tolerance_m=0.02)
    lengths = np.hypot(*branches.effect_xy_m.T)
    best, nearest = math.inf, goal.distance_m((0, 0))
    if nearest <= goal.tolerance_m:
        best = 0.0
    for depth in (1, 2, 3):
        for chain in itertools.product(range(6), repeat=depth):
            end = branches.effect_xy_m[list(chain)].sum(axis=0)
            nearest = min(nearest, goal.distance_m(end))
            if goal.distance_m(end) <= goal.tolerance_m:
                best = min(best, lengths[list(chain)].sum())
    chain, reached, _ = search(branches, (0.0, 0.0), goal, max_steps=3)
    assert reached == math.isfinite(best)
    end = branches.effect_xy_m[chain].sum(axis=0) if chain else np.zeros(2)
    if reached:
        assert goal.distance_m(end) <= goal.tolerance_m
        assert lengths[chain].sum() == pytest.approx(best, abs=1e-9)
    else:
        assert goal.distance_m(end) == pytest.approx(nearest, abs=1e-9)


def test_branches_are_the_papers_180():
    branches = predict_branches(MODEL, IMAGE)
    # Those that stop before contact do nothing and are pruned: 36 x {80, 100 %} remain.
    assert len(branches.theta) == 72
    assert set(np.round(branches.stop_phase, 3)) == {0.8, 1.0}
    full = branches.stop_phase == 1.0
    direction = branches.theta[full] + math.pi
    expected = REACH_M * np.stack([np.cos(direction), np.sin(direction)], axis=1)
    np.testing.assert_allclose(branches.effect_xy_m[full], expected, atol=1e-6)


def test_astar_plans():
    goal = Goal((0.18, 0.06))
    plan = plan_astar(MODEL, IMAGE, (0.0, 0.0), goal)
    assert plan.reaches_goal
    assert 2 <= len(plan.steps) <= 3
    assert plan.predicted_distance_m <= goal.tolerance_m
    xy = np.zeros(2)
    for step in plan.steps:
        np.testing.assert_allclose(step.predicted_path_xy_m[0], xy, atol=1e-6)
        xy = step.predicted_path_xy_m[-1]
        np.testing.assert_allclose(xy, step.predicted_end_xy_m, atol=1e-9)
    assert plan_astar(MODEL, IMAGE, (0, 0), Goal((0.01, 0.0))).steps == ()
    full = plan_astar(MODEL, IMAGE, (0, 0), Goal((0.07, 0.03)), mode="single_full")
    assert [s.stop_phase for s in full.steps] == [1.0]
    far = plan_astar(MODEL, IMAGE, (0, 0), Goal((0.45, 0.0)))
    assert not far.reaches_goal
    assert far.predicted_distance_m == pytest.approx(0.45 - 3 * REACH_M, abs=1e-6)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("goal_xy", [(0.05, 0.02), (-0.03, 0.06), (0.13, -0.11)])
def test_the_gradient_planner_finds_direction_and_phase(goal_xy, seed):
    goal = Goal(goal_xy)
    plan = plan_gradient(MODEL, IMAGE, (0.0, 0.0), goal, samples=300, seed=seed)
    assert len(plan.steps) == math.ceil(math.hypot(*goal_xy) / REACH_M)
    # Between two of 300 samples the object moves 0.75 mm; the direction converges.
    assert plan.predicted_distance_m < 0.001
    decoded = plan.steps[0].path_xy_m
    heading = math.atan2(*(decoded[-1] - decoded[0])[::-1])
    assert heading == pytest.approx(math.atan2(goal_xy[1], goal_xy[0]), abs=0.02)


def test_finer_samples_cut_finer():
    goals = [
        Goal((r * math.cos(r * 99), r * math.sin(r * 99))) for r in np.linspace(0.03, 0.08, 20)
    ]
    errors = []
    for samples in (25, 100, 300):
        plans = [plan_gradient(MODEL, IMAGE, (0, 0), goal, samples=samples) for goal in goals]
        errors.append(np.mean([plan.predicted_distance_m for plan in plans]))
    assert errors[0] > 2 * errors[1] > 4 * errors[2]


def test_modes_bind_the_gradient_planner():
    goal = Goal((0.04, 0.0))
    full = plan_gradient(MODEL, IMAGE, (0, 0), goal, mode="single_full")
    assert [s.stop_phase for s in full.steps] == [1.0]
    partial = plan_gradient(MODEL, IMAGE, (0, 0), goal, mode="single_partial")
    assert partial.steps[0].stop_phase == pytest.approx(0.6 + 0.4 * 0.04 / REACH_M, abs=0.01)
    again = plan_gradient(MODEL, IMAGE, (0, 0), goal, mode="single_partial")
    assert np.array_equal(again.steps[0].path_xy_m, partial.steps[0].path_xy_m)
    snapped = plan_gradient(MODEL, IMAGE, (0, 0), goal, snap=True)
    assert snapped.steps[0].path_xy_m is None
    assert snapped.steps[0].primitive.direction_rad == pytest.approx(0.0, abs=0.01)


def test_a_plan_is_carried_out(world, trained):
    world.place(Cuboid(0.06, 0.05, 0.05), (0.0, 0.0), 0.0)
    start = world.object_pose()[:2]
    goal = Goal((0.15, 0.0))
    outcome = carry_out(world, plan_astar(trained, world.look(), start, goal))
    assert outcome.distance_m == pytest.approx(goal.distance_m(world.object_pose()[:2]))
    assert outcome.distance_m < 0.03
    assert len(outcome.object_paths_xy_m) == len(outcome.plan.steps) == 2
    np.testing.assert_allclose(
        outcome.object_paths_xy_m[0][-1], outcome.object_paths_xy_m[1][0], atol=1e-4
    )
    assert outcome.with_goal(Goal((0.0, 0.0))).distance_m > 0.1


def test_a_decoded_path_is_followed(world):
    """A decoded path that is the push's own gives what the push gives."""
    thing, push, stop = Cuboid(0.06, 0.05, 0.05), Push(2.2), 0.85
    world.place(thing, (0.0, 0.0), 0.3)
    own = world.interact(push, stop, approach=True)
    plan = plan_astar(MODEL, IMAGE, (0, 0), Goal((0.08, 0.0)))
    from dataclasses import replace

    phase = np.linspace(0, stop, 60)
    step = replace(
        plan.steps[0], primitive=push, stop_phase=stop, path_xy_m=push.path(phase)[:, :2]
    )
    world.place(thing, (0.0, 0.0), 0.3)
    decoded = world.follow(step)
    np.testing.assert_allclose(decoded.rest_effect[:2], own.rest_effect[:2], atol=0.001)


def test_the_shipped_model_reaches_goals(world, trained):
    """A floor, not the table: the mean distance over a few goals of each kind stays small."""
    tasks = constructed_tasks(world, "single_partial", 6, seed=7)
    tasks += uniform_tasks("multi_partial", 6, seed=7)

    def astar(image, start, goal, mode):
        return plan_astar(trained, image, start, goal, mode)

    outcomes = measure(world, tasks, astar)
    rows = planning_rows(tasks, outcomes, planner="astar", model="paper")
    assert [r["n"] for r in rows if r["object_class"] == "all"] == [6, 6]
    assert all(r["mean_m"] < 0.03 for r in rows if r["object_class"] == "all")
    assert {r["object_class"] for r in rows} == {"all", "cuboid", "upright_cylinder"}
    for task in tasks:
        assert math.hypot(*task.goal.xy_m) > 0.02
    assert constructed_tasks(world, "single_partial", 2, seed=7) == tasks[:2]


@pytest.mark.parametrize(
    ("plan", "words"),
    [
        (lambda: plan_astar(MODEL, IMAGE, (0, 9), Goal((0, 0.1))), r"start_xy_m = \(0, 9\)"),
        (lambda: plan_astar(MODEL, IMAGE[0], (0, 0), Goal((0, 0.1))), r"image .* \(48, 48\)"),
        (lambda: plan_astar(MODEL, IMAGE / 0, (0, 0), Goal((0, 0.1))), "image .* not finite"),
        (lambda: plan_astar(MODEL, IMAGE, (0, 0), Goal((0, 0.1)), "two"), "mode 'two' is unknown"),
        (lambda: plan_gradient(MODEL, IMAGE, (0, 0), Goal((0, 0.1)), samples=1), "samples .* 1"),
        (lambda: uniform_tasks("two", 1), "mode 'two' is unknown"),
    ],
)
@pytest.mark.filterwarnings("ignore:invalid value encountered")
def test_bad_input_is_named(plan, words):
    with pytest.raises(ValueError, match=words):
        plan()
