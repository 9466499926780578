"""Planners against exhaustive search, known dynamics and execution; the frozen goals."""

import itertools
import math
import warnings
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from affordlib import planning
from affordlib.geometry import rotated
from affordlib.models import load_checkpoint
from affordlib.planning.astar import HEURISTICS, Branches, BranchTable, search
from affordlib.planning.effect_map import roll_out
from affordlib.planning.gradient import Reading, descend
from affordlib.primitives import Drag, Push
from affordlib.types import Goal, Prediction
from affordlib.world import ROLLABLE, STANDING, Cuboid, UprightCylinder
from experiments.planning import attempt, phases_of_way
from experiments.tasks import constructed_tasks, frozen_tasks, uniform_tasks
from tests.planning.point_robot import REACH_M, STARTS, KnownDynamics, moved_m, problem_of

IMAGE = np.zeros((2, 48, 48), dtype=np.float32)
MODEL = KnownDynamics()
PLANNERS = (planning.plan_astar, planning.plan_continuous, planning.plan_gradient)


class Changed(KnownDynamics):
    """Known dynamics, but for the mean effect: a function of it and of the observations."""

    def __init__(self, change):
        self.change = change

    def predict(self, features, observations, t_target):
        found = super().predict(features, observations, t_target)
        return replace(found, effect_mean=self.change(found.effect_mean, observations))


def known(goal_xy, mode="multi_partial", tolerance_m=0.02, model=MODEL, **more):
    """A problem with known dynamics, from the middle of the table."""
    return problem_of(model, IMAGE, (0.0, 0.0), Goal(goal_xy, tolerance_m), mode, **more)


@pytest.mark.parametrize("kind", [Push, Drag])
def test_an_effect_map_says_what_the_model_says(world, film, kind):
    world.place(Cuboid(0.07, 0.05, 0.05), (0.0, 0.0), 0.4)
    effects = planning.EffectMap(film if kind is Push else MODEL, world.depth_image(), kind)
    assert effects.radius_m == pytest.approx(math.hypot(0.035, 0.025), abs=0.004)
    rng = np.random.default_rng(0)
    direction = torch.from_numpy(rng.uniform(-7, 7, 40))
    phase = torch.from_numpy(rng.uniform(0.3, 1, 40))
    effect, std = effects(direction, phase)
    off = (effect - effects.query_model(direction, phase))[:, :2].norm(dim=-1)
    assert off.median() < 6e-4  # interpolation error: 0.2 mm for the push, less for the drag
    at_first = torch.full_like(phase, kind.acts_from)
    assert effects.query_model(direction, at_first).abs().max() < 1e-6
    assert (std > 0).all()
    torch.testing.assert_close(effects(direction + 2 * math.pi, phase)[0], effect)


def test_sigma_is_that_of_the_push_frame(world, film):
    """A disc looks the same from all directions, so ahead and left have the same σ in all."""
    world.place(UprightCylinder(0.06, 0.06))
    effects = planning.EffectMap(film, world.depth_image())
    std = effects.grid[1][:, -1, :2]
    assert (std.std(dim=0) < 0.015 * std.mean(dim=0)).all()
    assert (std[:, 1] > 1.05 * std[:, 0]).all()  # also at 45°


def test_a_chain_turns_with_the_object(world, film):
    """Rolling out two pushes equals querying the second for the rotated object."""
    world.place(Cuboid(0.07, 0.05, 0.05), (0.0, 0.0), 0.4)
    effects = planning.EffectMap(film, world.depth_image())
    direction, phase = torch.tensor([[0.3, 1.2]]).double(), torch.tensor([[1.0, 0.9]]).double()
    positions, turns, variances = roll_out(effects, direction, phase)
    first, _ = effects(direction[:, 0], phase[:, 0])
    second, _ = effects(direction[:, 1] - first[:, 2], phase[:, 1])
    moved = rotated(second[0, :2].numpy(), 1.2)
    np.testing.assert_allclose(positions[0, 1] - positions[0, 0], moved, atol=1e-12)
    assert float(turns[0, 1]) == pytest.approx(float(first[0, 2] + second[0, 2]))
    assert float(variances[0, 1]) > float(variances[0, 0]) > 0


class RandomTable(BranchTable):
    """A few branches that also turn the object, which changes the later branches."""

    def __init__(self, seed: int, n: int = 6) -> None:
        rng = np.random.default_rng(seed)
        self.n, self.xy, self.turn = n, rng.uniform(-0.09, 0.09, (n, 2)), rng.uniform(-1, 1, n)
        self.effects = SimpleNamespace(radius_m=0.0, reach_m=np.hypot(*self.xy.T).max())

    def at(self, turned: float) -> Branches:
        # The index of a branch is used as its direction.
        return np.arange(self.n), np.ones(self.n), rotated(self.xy, turned).T, self.turn

    def follow(self, chain) -> tuple[np.ndarray, float]:
        xy, turned, length = np.zeros(2), 0.0, 0.0
        for k in chain:
            step = self.at(turned)[2][:, k]
            xy, turned, length = xy + step, turned + self.turn[k], length + math.hypot(*step)
        return xy, length


@pytest.mark.parametrize("heuristic", HEURISTICS)
@pytest.mark.parametrize("seed", range(40))
def test_astar_finds_what_exhaustive_search_finds(seed, heuristic):
    table, rng = RandomTable(seed), np.random.default_rng(1000 + seed)
    problem = known(tuple(rng.uniform(-0.2, 0.2, 2)))
    goal, best, nearest = problem.goal, math.inf, math.inf

    def way_to(end, length):  # to the goal itself, or only into its disc
        return length + (goal.distance_m(end) if heuristic == "goal" else 0.0)

    for depth in (0, 1, 2, 3):
        for chain in itertools.product(range(6), repeat=depth):
            end, length = table.follow(chain)
            nearest = min(nearest, goal.distance_m(end))
            if goal.distance_m(end) <= goal.tolerance_m:
                best = min(best, way_to(end, length))
    chain, reached = search(problem, table, heuristic=heuristic)
    end, length = table.follow([int(k) for k, _ in chain])
    assert reached == math.isfinite(best)
    if reached:
        assert goal.distance_m(end) <= goal.tolerance_m
        assert way_to(end, length) == pytest.approx(best, abs=1e-9)
    else:
        assert goal.distance_m(end) == pytest.approx(nearest, abs=1e-9)


def test_branches_are_the_papers_180_of_the_action_or_of_its_recorded_part():
    effects, shares = planning.EffectMap(MODEL, IMAGE), np.array([0.2, 0.4, 0.6, 0.8, 1.0])
    stops = phases_of_way(effects, shares)
    np.testing.assert_allclose(stops, STARTS + (1 - STARTS) * np.sqrt(shares), atol=0.005)
    # Actions that stop before contact are pruned: 36 x {80, 100 %} remain.
    for given, kept, off_m in (({}, [0.8, 1.0], 1e-4), ({"stop_phases": stops}, stops, 1e-3)):
        direction, stop_phase, effect_m, _ = BranchTable(effects, **given).at(0.0)
        assert len(direction) == 36 * len(kept)
        assert set(np.round(stop_phase, 3)) == set(np.round(kept, 3))
        expected = moved_m(stop_phase) * np.stack([np.cos(direction), np.sin(direction)])
        np.testing.assert_allclose(effect_m, expected, atol=off_m)
    np.testing.assert_allclose(np.hypot(*effect_m), np.tile(REACH_M * shares, 36), atol=1e-3)


def test_numbers_of_few_bits_plan_as_others_and_numbers_without_end_are_refused():
    effects = planning.EffectMap(MODEL, IMAGE)
    for few in (np.uint8(200), np.int8(36)):
        branches, others = (BranchTable(effects, n).at(0.3) for n in (few, int(few)))
        np.testing.assert_array_equal(branches[0], others[0])
    with pytest.raises(ValueError, match="stop_phases must be at most 100, got 101"):
        BranchTable(effects, stop_phases=np.linspace(0.01, 1, 101))
    with pytest.raises(ValueError, match=r"Reading\.rate must be a finite number"):
        Reading(rate=math.nan)


def test_a_search_goes_on_where_the_end_cannot_be_had(film, cuboid_image):
    """A node within the tolerance does not count if the goal's turn is unreachable there."""
    goal, tried = Goal((0.08, 0.0), turn_rad=0.1), []

    def only_beyond(goal, xy_m, turned_rad):
        tried.append(xy_m)
        return () if xy_m[0] > 0.085 else None

    two = planning.PlanMode(2, partial=True)
    problem = problem_of(film, cuboid_image, (0.0, 0.0), goal, two, pose_planner=only_beyond)
    table = BranchTable(problem.effects)
    assert search(problem, table)[1]
    assert len(tried) > 1
    assert tried[-1][0] > 0.085
    assert all(goal.distance_m(xy) <= goal.tolerance_m for xy in tried)
    one = planning.PlanMode(1, partial=True)
    assert not search(replace(problem, mode=one, pose_planner=lambda *_: None), table)[1]


def test_a_plan_reaches_the_goal_only_where_it_says_that_it_ends_there(film, cuboid_image):
    """The search, which rounds turns to a degree, has a small error."""
    for angle in range(8):
        xy = 0.15 * math.cos(angle), 0.15 * math.sin(angle)
        ends = planning.plan_astar(problem_of(film, cuboid_image, (0.0, 0.0), Goal(xy)))
        at = ends.steps[-1]
        np.testing.assert_allclose(at.predicted_path_xy_m[-1], at.predicted_end_xy_m, atol=1e-9)
        near = Goal(xy, ends.predicted_distance_m - 1e-6)
        plan = planning.plan_astar(problem_of(film, cuboid_image, (0.0, 0.0), near))
        assert plan.reaches_goal == (plan.predicted_distance_m <= near.tolerance_m)


@pytest.mark.parametrize("goal_xy", [(0.05, 0.02), (-0.03, 0.06), (0.13, -0.11), (0.2, 0.05)])
def test_the_continuous_planner_ends_at_the_goal(goal_xy):
    plan = planning.plan_continuous(known(goal_xy))
    assert len(plan.steps) >= math.ceil(math.hypot(*goal_xy) / REACH_M)
    assert plan.predicted_distance_m < 5e-5
    xy = np.zeros(2)
    for step in plan.steps:
        np.testing.assert_allclose(step.predicted_path_xy_m[0], xy, atol=5e-4)
        angle, far = step.primitive.direction_rad, moved_m(step.stop_phase)
        end = xy + far * np.array([math.cos(angle), math.sin(angle)])
        np.testing.assert_allclose(step.predicted_end_xy_m, end, atol=1e-5)
        xy = np.array(step.predicted_end_xy_m)
    here = problem_of(MODEL, IMAGE, goal_xy, Goal(goal_xy))
    assert planning.plan_continuous(here).steps == ()


def test_where_nothing_brings_it_nearer_it_stays(film, cuboid_image):
    near, far = (Goal((x, 0.0), tolerance_m=0.02) for x in (0.015, 0.08))
    plan = planning.plan_continuous(problem_of(film, cuboid_image, (0.0, 0.0), near, "single_full"))
    assert (plan.steps, plan.reaches_goal) == ((), True)
    plan = planning.plan_continuous(problem_of(film, cuboid_image, (0.0, 0.0), far, "single_full"))
    assert len(plan.steps) == 1


def test_of_two_plans_that_of_lower_variance_is_taken():
    class SureUpwards(KnownDynamics):
        """σ is small for pushes along y, and ten times as large along x."""

        def predict(self, features, observations, t_target):
            known = super().predict(features, observations, t_target)
            along = known.effect_mean / known.effect_mean.norm(dim=-1, keepdim=True).clamp_min(1e-9)
            std = 0.001 + 0.02 * along[..., :1].square().expand_as(known.effect_std)
            return Prediction(known.action_mean, std, known.effect_mean, std)

    plan = planning.plan_continuous(known((0.0, 0.12), model=SureUpwards()))
    assert plan.predicted_distance_m < 1e-4
    assert all(abs(math.sin(s.primitive.direction_rad)) > 0.95 for s in plan.steps)
    assert plan.steps[-1].std_m < 0.004


TURN = torch.tensor([[math.cos(0.4), math.sin(0.4)], [-math.sin(0.4), math.cos(0.4)]])


def turned(mean, observations):
    """An effect that is turned by 0.4 rad from the observed one."""
    return mean @ TURN if observations.effect_mask.any() else mean


READINGS = [Reading(), Reading(starts=4), Reading(finds="point")]
READINGS += [Reading("gradient", "circle", finds, rate=1.0) for finds in ("direction", "point")]
READINGS += [Reading("adam", "circle", finds, rate=0.005) for finds in ("direction", "point")]


@pytest.mark.parametrize("reading", READINGS, ids=str)
@pytest.mark.parametrize("goal_xy", [(0.05, 0.02), (-0.03, 0.06), (0.13, -0.11)])
def test_each_reading_finds_the_direction_whose_effect_points_at_the_goal(goal_xy, reading):
    """Every input is predicted at 9 cm, 0.4 rad to its left: the best points 0.4 rad to the right.

    For a goal g and an input of angle a, the loss is (r² + |g|² - 2 r |g| cos(a + 0.4 - φ)) / 2.
    """
    problem = known(goal_xy, model=Changed(turned))
    expected = math.atan2(goal_xy[1], goal_xy[0]) - 0.4
    for seed in range(3):
        rng = np.random.default_rng(seed)
        found = descend(problem.effects, np.array(goal_xy), rng, reading)[0]
        off = math.remainder(math.atan2(found[1], found[0]) - expected, 2 * math.pi)
        assert abs(off) < math.radians(2)
        if reading.finds == "direction":
            assert float(found.norm()) == pytest.approx(REACH_M, abs=1e-3)


@pytest.mark.parametrize("reading", [READINGS[0], READINGS[-1]], ids=str)
@pytest.mark.parametrize("goal_xy", [(0.05, 0.02), (-0.03, 0.06), (0.13, -0.11)])
def test_the_gradient_planner_finds_direction_and_phase(goal_xy, reading):
    plan, again = (planning.plan_gradient(known(goal_xy), 300, reading=reading) for _ in range(2))
    assert np.array_equal(again.steps[0].path_xy_m, plan.steps[0].path_xy_m)
    assert len(plan.steps) == math.ceil(math.hypot(*goal_xy) / REACH_M)
    # Between two of 300 samples the object moves 0.75 mm; the direction converges.
    assert plan.predicted_distance_m < 0.001
    decoded = plan.steps[0].path_xy_m
    heading = math.atan2(*(decoded[-1] - decoded[0])[::-1])
    assert heading == pytest.approx(math.atan2(goal_xy[1], goal_xy[0]), abs=0.02)
    (drag,) = planning.plan_gradient(known((0.04, 0.0), kind=Drag), reading=reading).steps
    assert drag.path_xy_m is None
    assert drag.primitive.direction_rad == pytest.approx(0.0, abs=0.02)


def deaf(mean, observations):
    """An effect through which no gradient flows, so that a descent stays at its start."""
    return mean.detach() + 0 * observations.effect.sum()


def test_a_start_that_leads_away_is_drawn_again_and_the_planner_says_if_all_do():
    ends_m = []
    for seed in range(12):
        with warnings.catch_warnings(record=True, action="always") as said:
            plan = planning.plan_gradient(known((0.05, 0.0), model=Changed(deaf)), seed=seed)
        assert bool(plan.steps) != any("none of 5 random starts" in str(w.message) for w in said)
        ends_m += [plan.predicted_distance_m] * bool(plan.steps)
    assert len(ends_m) >= 10
    assert max(ends_m) < 0.05
    nowhere = known((0.05, 0.0), reachable=lambda xy, *_: np.zeros(len(xy), bool))
    with pytest.warns(UserWarning, match="none of 10 random starts led nearer to the goal"):
        planning.plan_gradient(nowhere, reading=Reading(starts=2))


def test_a_push_that_would_stop_before_it_begins_is_none():
    """A network predicts a few millimetres of effect at t = 0, where nothing has happened."""
    model = Changed(lambda *given: deaf(*given) + torch.tensor([0.01, 0.0]))
    with warnings.catch_warnings(action="ignore", category=UserWarning):
        plans = [planning.plan_gradient(known((0.03, 0.0), model=model), seed=k) for k in range(6)]
    steps = [step for plan in plans for step in plan.steps]
    assert steps
    assert all(step.stop_phase > 0 for step in steps)


def test_a_decoded_path_is_followed(world):
    obj, push, stop = Cuboid(0.06, 0.05, 0.05), Push(2.2), 0.85
    world.place(obj, (0.0, 0.0), 0.3)
    own = world.execute_primitive(push, stop, approach=True)
    path = push.path(np.linspace(0, stop, 60))[:, :2]
    step = planning.plan_astar(known((0.08, 0.0))).steps[0]
    world.place(obj, (0.0, 0.0), 0.3)
    done = world.execute(replace(step, primitive=push, stop_phase=stop, path_xy_m=path))
    np.testing.assert_allclose(done.rest_effect[:2], own.rest_effect[:2], atol=0.001)


@pytest.mark.filterwarnings("ignore:none of 5 random starts")
@pytest.mark.parametrize("plan", PLANNERS)
def test_planners_keep_to_mode_reach_and_table(plan):
    full = plan(known((0.07, 0.03), "single_full"))
    assert [step.stop_phase for step in full.steps] == [1.0]
    assert len(plan(known((0.2, 0.1), "single_partial")).steps) == 1
    barred = plan(known((0.2, 0.0), reachable=lambda xy_m, _: xy_m[:, 0] < 0.05))
    assert not barred.reaches_goal
    assert plan(known((0.2, 0.0))).reaches_goal
    assert all(x < 0.05 for x, _ in (step.predicted_end_xy_m for step in barred.steps[:-1]))
    nowhere = plan(known((0.2, 0.0), reachable=lambda xy_m, _: xy_m[:, 0] > 9))
    assert (nowhere.steps, nowhere.reaches_goal) == ((), False)
    posed = replace(known((0.05, 0.05)), goal=Goal((0.05, 0.05), height_m=0.1))
    assert not plan(posed).reaches_goal  # there is no model for lifting


@pytest.mark.parametrize("xy", [(0.0, 0.7), (-0.5, 0.0), (-0.48, -0.68), (0.68, 0.0)])
def test_a_goal_without_room_for_the_object_is_refused(film, cuboid_image, xy):
    with pytest.raises(ValueError, match="too near the rim of the table"):
        problem_of(film, cuboid_image, (0.0, 0.0), Goal(xy))


@pytest.mark.parametrize("name", ["grasp_film_1000", "rotate_film_1000", "drag_film_500"])
@pytest.mark.parametrize("plan", PLANNERS)
def test_a_model_of_other_actions_plans_no_pushes(cuboid_image, name, plan):
    with pytest.raises(ValueError, match=r"model must have x|train on such actions"):
        plan(problem_of(load_checkpoint(name)[0], cuboid_image, (0.0, 0.0), Goal((0.1, 0.05))))


@pytest.mark.slow
def test_plans_come_within_what_their_planner_promises(world, trained, film):
    """A lower bound, not the table: A* stops within 2 cm, the continuous planner does not."""
    tasks = constructed_tasks(world, "single_partial", 4, seed=7)
    tasks += uniform_tasks("multi_partial", 4, seed=7)

    def distances(plan, model, tasks, **how):
        runs = (attempt(world, t, lambda *q: plan(problem_of(model, *q)), **how) for t in tasks)
        return [run.distance_m for run in runs]

    assert np.mean(distances(planning.plan_astar, trained, tasks)) < 0.03
    hard = [t for t in frozen_tasks() if (t.goals, t.mode) == ("constructed", "multi_partial")]
    hard = [t for t in hard if not t.obj.rollable][:5]
    open_loop = distances(planning.plan_continuous, film, hard)
    corrected = distances(planning.plan_continuous, film, hard, corrections=2)
    assert np.mean(open_loop) < 0.003  # 1.1 mm
    assert np.mean(corrected) < min(0.002, np.mean(open_loop))


def test_the_frozen_goals_are_those_that_are_drawn(world):
    frozen = frozen_tasks()
    assert len(frozen) == 460
    drawn = constructed_tasks(world, "single_partial", 4, 0, STANDING + ROLLABLE)
    for task, again in zip([t for t in frozen if t.mode == "single_partial"], drawn, strict=False):
        assert task.obj == again.obj
        assert task.goal.distance_m(again.goal.xy_m) < 0.002
    assert all(math.hypot(*task.goal.xy_m) > 0.02 for task in frozen)
