import itertools
import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from affordlib.evaluation.tasks import (
    ROLLABLE,
    STANDING,
    constructed_tasks,
    frozen_tasks,
    uniform_tasks,
)
from affordlib.models import EffectModel, load_checkpoint
from affordlib.planning import (
    EffectMap,
    execute_plan,
    plan_astar,
    plan_continuous,
    plan_gradient,
)
from affordlib.planning.astar import Branches, BranchTable, search
from affordlib.planning.rollout import roll_out
from affordlib.primitives import Drag, Push
from affordlib.types import Goal, Observations, Prediction
from affordlib.world import Cuboid
from experiments.planning import measure, outcome_record, planning_rows
from tests.problems import problem_of

IMAGE = np.zeros((2, 48, 48), dtype=np.float32)
REACH_M = 0.09
STARTS = 0.6


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
        share = ((t_target - STARTS) / (1 - STARTS)).clamp(0, 1).square()[..., None]
        effect = REACH_M * share * direction[:, None]
        action = (-0.2 + 0.25 * t_target[..., None]) * direction[:, None]
        std = torch.full_like(effect, 0.001)
        return Prediction(action, std, effect, std)


MODEL = KnownDynamics()


def test_the_known_dynamics_is_an_effect_model():
    assert isinstance(MODEL, EffectModel)


class RandomTable(BranchTable):
    """A few branches that also turn the object, and then lead elsewhere."""

    def __init__(self, seed: int, n: int = 6) -> None:
        rng = np.random.default_rng(seed)
        self.n, self.xy, self.turn = n, rng.uniform(-0.09, 0.09, (n, 2)), rng.uniform(-1, 1, n)
        self.effects = SimpleNamespace(radius_m=0.0, reach_m=np.hypot(*self.xy.T).max())

    def at(self, turned: float) -> Branches:
        c, s = math.cos(turned), math.sin(turned)
        xy = self.xy @ np.array([[c, s], [-s, c]])
        # The number of a branch stands in for its direction.
        return Branches(np.arange(self.n), np.ones(self.n), xy, self.turn)

    def follow(self, chain) -> tuple[np.ndarray, float]:
        xy, turned, length = np.zeros(2), 0.0, 0.0
        for k in chain:
            here = self.at(turned)
            xy, turned = xy + here.effect_xy_m[k], turned + here.turn_rad[k]
            length += math.hypot(*here.effect_xy_m[k])
        return xy, length


@pytest.mark.parametrize("seed", range(40))
def test_astar_finds_what_exhaustive_search_finds(seed):
    table = RandomTable(seed)
    rng = np.random.default_rng(1000 + seed)
    goal = Goal(tuple(rng.uniform(-0.2, 0.2, 2)), tolerance_m=0.02)
    best, nearest = math.inf, goal.distance_m((0, 0))
    if nearest <= goal.tolerance_m:
        best = 0.0
    for depth in (1, 2, 3):
        for chain in itertools.product(range(6), repeat=depth):
            end, length = table.follow(chain)
            nearest = min(nearest, goal.distance_m(end))
            if goal.distance_m(end) <= goal.tolerance_m:
                best = min(best, length)
    problem = replace(problem_of(MODEL, IMAGE, (0.0, 0.0), Goal((0.0, 0.0))), goal=goal)
    chain, reached, _ = search(problem, table)
    assert reached == math.isfinite(best)
    end, length = table.follow([int(k) for k, _ in chain])
    if reached:
        assert goal.distance_m(end) <= goal.tolerance_m
        assert length == pytest.approx(best, abs=1e-9)
    else:
        assert goal.distance_m(end) == pytest.approx(nearest, abs=1e-9)


def test_branches_are_the_papers_180():
    branches = BranchTable(EffectMap(MODEL, IMAGE)).at(0.0)
    # Those that stop before contact do nothing and are pruned: 36 x {80, 100 %} remain.
    assert len(branches.direction) == 72
    assert set(np.round(branches.stop_phase, 3)) == {0.8, 1.0}
    full = branches.stop_phase == 1.0
    direction = branches.direction[full]
    expected = REACH_M * np.stack([np.cos(direction), np.sin(direction)], axis=1)
    np.testing.assert_allclose(branches.effect_xy_m[full], expected, atol=1e-4)


def test_astar_expands_nothing_out_of_reach():
    def only_left(xy_m, direction_rad):
        return xy_m[:, 0] < 0.05

    goal = Goal((0.18, 0.06))
    barred = plan_astar(problem_of(MODEL, IMAGE, (0.0, 0.0), goal, reachable=only_left))
    assert plan_astar(problem_of(MODEL, IMAGE, (0.0, 0.0), goal)).reaches_goal
    assert not barred.reaches_goal
    starts = [(0.0, 0.0), *(step.predicted_end_xy_m for step in barred.steps[:-1])]
    assert all(x < 0.05 for x, _ in starts)


@pytest.mark.parametrize("kind", [Push, Drag])
def test_an_effect_map_says_what_the_model_says(world, film, kind):
    world.place(Cuboid(0.07, 0.05, 0.05), (0.0, 0.0), 0.4)
    model = film if kind is Push else MODEL
    effects = EffectMap(model, world.depth_image(), kind)
    rng = np.random.default_rng(0)
    direction = torch.from_numpy(rng.uniform(-7, 7, 40))
    phase = torch.from_numpy(rng.uniform(0.3, 1, 40))
    told, std = effects(direction, phase)
    asked = effects.query_model(direction, phase)
    off = (told - asked)[:, :2].norm(dim=-1)
    assert off.median() < 6e-4  # what the splines leave: 0.2 mm of the push, less of the drag
    at_first = torch.full_like(phase, kind.acts_from)
    assert effects.query_model(direction, at_first).abs().max() < 1e-6
    assert (std > 0).all()
    # It is smooth: its slopes are those of finite differences.
    direction.requires_grad_(), phase.requires_grad_()
    slopes = torch.autograd.grad(effects(direction, phase)[0][:, 0].sum(), [direction, phase])
    for slope, (du, dv) in zip(slopes, [(1e-6, 0), (0, -1e-6)], strict=True):
        with torch.no_grad():
            there = effects(direction + du, phase + dv)[0][:, 0]
            here = effects(direction, phase)[0][:, 0]
        torch.testing.assert_close((there - here) / (du + dv), slope, atol=1e-5, rtol=1e-4)


def test_a_chain_turns_with_the_object(world, film):
    """Rolling out two pushes at once is asking for the second of the turned object."""
    world.place(Cuboid(0.07, 0.05, 0.05), (0.0, 0.0), 0.4)
    effects = EffectMap(film, world.depth_image())
    direction, phase = torch.tensor([[0.3, 1.2]]).double(), torch.tensor([[1.0, 0.9]]).double()
    positions, turns, variances = roll_out(effects, direction, phase)
    first, _ = effects(direction[:, 0], phase[:, 0])
    second, _ = effects(direction[:, 1] - first[:, 2], phase[:, 1])
    c, s = math.cos(1.2), math.sin(1.2)
    moved = second[0, :2].numpy() @ np.array([[c, s], [-s, c]])
    np.testing.assert_allclose(positions[0, 1] - positions[0, 0], moved, atol=1e-12)
    assert float(turns[0, 1]) == pytest.approx(float(first[0, 2] + second[0, 2]))
    assert float(variances[0, 1]) > float(variances[0, 0]) > 0


@pytest.mark.parametrize("goal_xy", [(0.05, 0.02), (-0.03, 0.06), (0.13, -0.11), (0.2, 0.05)])
def test_the_continuous_planner_ends_at_the_goal(goal_xy):
    plan = plan_continuous(problem_of(MODEL, IMAGE, (0.0, 0.0), Goal(goal_xy)))
    assert len(plan.steps) >= math.ceil(math.hypot(*goal_xy) / REACH_M)
    assert plan.predicted_distance_m < 5e-5
    xy = np.zeros(2)
    for step in plan.steps:
        np.testing.assert_allclose(step.predicted_path_xy_m[0], xy, atol=5e-4)
        xy = np.array(step.predicted_end_xy_m)
        direction = step.primitive.direction_rad
        assert step.stop_phase > STARTS
    share = (step.stop_phase - STARTS) / (1 - STARTS)
    assert REACH_M * share**2 * math.cos(direction) == pytest.approx(
        xy[0] - (plan.steps[-2].predicted_end_xy_m[0] if len(plan.steps) > 1 else 0), abs=1e-3
    )
    assert plan_continuous(problem_of(MODEL, IMAGE, goal_xy, Goal(goal_xy))).steps == ()
    full = plan_continuous(problem_of(MODEL, IMAGE, (0, 0), Goal(goal_xy), "single_full"))
    assert [s.stop_phase for s in full.steps] == [1.0]


def test_of_two_plans_the_surer_is_taken():
    class SureUpwards(KnownDynamics):
        """σ is small for pushes along y, and ten times as large along x."""

        def predict(self, features, observations, t_target):
            told = super().predict(features, observations, t_target)
            along = told.effect_mean / told.effect_mean.norm(dim=-1, keepdim=True).clamp_min(1e-9)
            std = 0.001 + 0.02 * along[..., :1].square().expand_as(told.effect_std)
            return Prediction(told.action_mean, std, told.effect_mean, std)

    plan = plan_continuous(problem_of(SureUpwards(), IMAGE, (0, 0), Goal((0.0, 0.12))))
    assert plan.predicted_distance_m < 1e-4
    assert all(abs(math.sin(s.primitive.direction_rad)) > 0.95 for s in plan.steps)
    assert plan.steps[-1].std_m < 0.004


def test_the_continuous_planner_keeps_to_where_the_arm_reaches():
    def only_left(xy_m, direction_rad):
        return xy_m[:, 0] < 0.05

    plan = plan_continuous(problem_of(MODEL, IMAGE, (0, 0), Goal((0.2, 0.0)), reachable=only_left))
    assert not plan.reaches_goal
    starts = [(0.0, 0.0), *(s.predicted_end_xy_m for s in plan.steps[:-1])]
    assert all(x < 0.05 for x, _ in starts)
    nowhere = plan_continuous(
        problem_of(
            MODEL, IMAGE, (0, 0), Goal((0.2, 0.0)), reachable=lambda xy, d: np.zeros(len(xy), bool)
        )
    )
    assert nowhere.steps == ()
    assert not nowhere.reaches_goal


def test_astar_plans():
    goal = Goal((0.18, 0.06))
    plan = plan_astar(problem_of(MODEL, IMAGE, (0.0, 0.0), goal))
    assert plan.reaches_goal
    assert 2 <= len(plan.steps) <= 3
    assert plan.predicted_distance_m <= goal.tolerance_m
    xy = np.zeros(2)
    for step in plan.steps:
        np.testing.assert_allclose(step.predicted_path_xy_m[0], xy, atol=1e-4)
        xy = step.predicted_path_xy_m[-1]
        np.testing.assert_allclose(xy, step.predicted_end_xy_m, atol=1e-9)
    assert plan_astar(problem_of(MODEL, IMAGE, (0, 0), Goal((0.01, 0.0)))).steps == ()
    full = plan_astar(problem_of(MODEL, IMAGE, (0, 0), Goal((0.07, 0.03)), mode="single_full"))
    assert [s.stop_phase for s in full.steps] == [1.0]
    far = plan_astar(problem_of(MODEL, IMAGE, (0, 0), Goal((0.45, 0.0))))
    assert not far.reaches_goal
    assert far.predicted_distance_m == pytest.approx(0.45 - 3 * REACH_M, abs=1e-6)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("goal_xy", [(0.05, 0.02), (-0.03, 0.06), (0.13, -0.11)])
def test_the_gradient_planner_finds_direction_and_phase(goal_xy, seed):
    goal = Goal(goal_xy)
    plan = plan_gradient(problem_of(MODEL, IMAGE, (0.0, 0.0), goal), samples=300, seed=seed)
    assert len(plan.steps) == math.ceil(math.hypot(*goal_xy) / REACH_M)
    # Between two of 300 samples the object moves 0.75 mm; the direction converges.
    assert plan.predicted_distance_m < 0.001
    decoded = plan.steps[0].path_xy_m
    heading = math.atan2(*(decoded[-1] - decoded[0])[::-1])
    assert heading == pytest.approx(math.atan2(goal_xy[1], goal_xy[0]), abs=0.02)


@pytest.mark.slow
def test_finer_samples_cut_finer():
    goals = [
        Goal((r * math.cos(r * 99), r * math.sin(r * 99))) for r in np.linspace(0.03, 0.08, 20)
    ]
    errors = []
    for samples in (25, 100, 300):
        plans = [
            plan_gradient(problem_of(MODEL, IMAGE, (0, 0), goal), samples=samples) for goal in goals
        ]
        errors.append(np.mean([plan.predicted_distance_m for plan in plans]))
    assert errors[0] > 2 * errors[1] > 4 * errors[2]


def test_modes_bind_the_gradient_planner():
    goal = Goal((0.04, 0.0))
    full = plan_gradient(problem_of(MODEL, IMAGE, (0, 0), goal, mode="single_full"))
    assert [s.stop_phase for s in full.steps] == [1.0]
    partial = plan_gradient(problem_of(MODEL, IMAGE, (0, 0), goal, mode="single_partial"))
    expected = STARTS + (1 - STARTS) * math.sqrt(0.04 / REACH_M)
    assert partial.steps[0].stop_phase == pytest.approx(expected, abs=0.01)
    again = plan_gradient(problem_of(MODEL, IMAGE, (0, 0), goal, mode="single_partial"))
    assert np.array_equal(again.steps[0].path_xy_m, partial.steps[0].path_xy_m)
    snapped = plan_gradient(problem_of(MODEL, IMAGE, (0, 0), goal), snap=True)
    assert snapped.steps[0].path_xy_m is None
    assert snapped.steps[0].primitive.direction_rad == pytest.approx(0.0, abs=0.01)


def test_a_plan_is_carried_out(world, trained):
    world.place(Cuboid(0.06, 0.05, 0.05), (0.0, 0.0), 0.0)
    start = world.object_pose()[:2]
    goal = Goal((0.15, 0.0))
    outcome = execute_plan(world, plan_astar(problem_of(trained, world.depth_image(), start, goal)))
    assert outcome.distance_m == pytest.approx(goal.distance_m(world.object_pose()[:2]))
    assert outcome.distance_m < goal.tolerance_m + 0.005  # 15 mm: A* is content within 2 cm
    assert len(outcome.object_paths_xy_m) == len(outcome.plan.steps) == 2
    np.testing.assert_allclose(
        outcome.object_paths_xy_m[0][-1], outcome.object_paths_xy_m[1][0], atol=1e-4
    )
    assert outcome.with_goal(Goal((0.0, 0.0))).distance_m > 0.1


def test_a_decoded_path_is_followed(world):
    """A decoded path that is the push's own gives what the push gives."""
    obj, push, stop = Cuboid(0.06, 0.05, 0.05), Push(2.2), 0.85
    world.place(obj, (0.0, 0.0), 0.3)
    own = world.execute_primitive(push, stop, approach=True)
    plan = plan_astar(problem_of(MODEL, IMAGE, (0, 0), Goal((0.08, 0.0))))
    from dataclasses import replace

    phase = np.linspace(0, stop, 60)
    step = replace(
        plan.steps[0], primitive=push, stop_phase=stop, path_xy_m=push.path(phase)[:, :2]
    )
    world.place(obj, (0.0, 0.0), 0.3)
    decoded = world.execute(step)
    np.testing.assert_allclose(decoded.rest_effect[:2], own.rest_effect[:2], atol=0.001)


@pytest.mark.slow
def test_the_shipped_model_reaches_goals(world, trained):
    """A floor, not the table: the mean distance over a few goals of each kind stays small."""
    tasks = constructed_tasks(world, "single_partial", 6, seed=7)
    tasks += uniform_tasks("multi_partial", 6, seed=7)

    def astar(image, start, goal, mode):
        return plan_astar(problem_of(trained, image, start, goal, mode))

    outcomes = measure(world, tasks, astar)
    records = [outcome_record(t, o) for t, o in zip(tasks, outcomes, strict=True)]
    rows = planning_rows(records, planner="astar", model="paper")
    assert [r["n"] for r in rows if r["object_class"] == "all"] == [6, 6]
    # 20 and 19 mm of goals that A* counts as reached within 20 mm.
    assert all(r["mean_m"] < 0.03 for r in rows if r["object_class"] == "all")
    assert {r["object_class"] for r in rows} == {"all", "standing", "cuboid", "upright_cylinder"}
    for task in tasks:
        assert math.hypot(*task.goal.xy_m) > 0.02
    assert constructed_tasks(world, "single_partial", 2, seed=7) == tasks[:2]


@pytest.mark.slow
def test_the_continuous_planner_comes_within_millimetres(world, film):
    """A floor again; open loop, and nearer still with corrections."""
    tasks = [t for t in frozen_tasks() if t.goals == "constructed" and t.mode == "multi_partial"]
    tasks = [t for t in tasks if not t.obj.rollable][:6]

    def continuous(image, start, goal, mode):
        return plan_continuous(problem_of(film, image, start, goal, mode))

    open_loop = [o.distance_m for o in measure(world, tasks, continuous)]
    closed = [o.distance_m for o in measure(world, tasks, continuous, corrections=2)]
    assert np.mean(open_loop) < 0.003  # 1.1 mm
    assert np.mean(closed) < min(0.002, np.mean(open_loop))


def test_the_frozen_goals_are_those_that_are_drawn(world):
    frozen = frozen_tasks()
    assert len(frozen) == 460
    drawn = constructed_tasks(world, "single_partial", 4, 0, STANDING + ROLLABLE)
    for task, again in zip([t for t in frozen if t.mode == "single_partial"], drawn, strict=False):
        assert task.obj == again.obj
        assert task.goal.distance_m(again.goal.xy_m) < 0.002
    for task in frozen:
        assert math.hypot(*task.goal.xy_m) > 0.02


@pytest.mark.parametrize(
    ("plan", "words"),
    [
        (
            lambda: plan_astar(problem_of(MODEL, IMAGE, (0, 9), Goal((0, 0.1)))),
            r"start_xy_m = \(0, 9\)",
        ),
        (
            lambda: plan_astar(problem_of(MODEL, IMAGE[0], (0, 0), Goal((0, 0.1)))),
            r"image .* \(48, 48\)",
        ),
        (
            lambda: plan_astar(problem_of(MODEL, IMAGE / 0, (0, 0), Goal((0, 0.1)))),
            "image must be finite numbers",
        ),
        (
            lambda: plan_astar(problem_of(MODEL, IMAGE, (0, 0), Goal((0, 0.1)), "two")),
            "mode 'two' is unknown",
        ),
        (
            lambda: plan_gradient(problem_of(MODEL, IMAGE, (0, 0), Goal((0, 0.1))), samples=1),
            "samples .* 1",
        ),
        (lambda: uniform_tasks("two", 1), "mode 'two' is unknown"),
    ],
)
@pytest.mark.filterwarnings("ignore:invalid value encountered")
def test_bad_input_is_named(plan, words):
    with pytest.raises(ValueError, match=words):
        plan()


def test_a_grid_of_nothing_is_refused():
    for settings, says in (({"n_directions": 0}, "n_directions"), ({"stop_phases": ()}, "phase")):
        with pytest.raises(ValueError, match=says):
            plan_astar(problem_of(MODEL, IMAGE, (0.0, 0.0), Goal((0.1, 0.0))), **settings)


@pytest.mark.parametrize(
    "name", ["lever_up_last_pose_1800", "grasp_film_1000", "rotate_film_1000", "drag_film_500"]
)
@pytest.mark.parametrize("plan", [plan_astar, plan_continuous, plan_gradient])
def test_a_model_of_other_actions_plans_no_pushes(cuboid_image, name, plan):
    with pytest.raises(ValueError, match=r"model: a planner|train on such actions"):
        plan(problem_of(load_checkpoint(name)[0], cuboid_image, (0.0, 0.0), Goal((0.1, 0.05))))
