"""Carrying out: every ending provoked, no endless loop, a veto before any motion."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from affordlib.planning import (
    ClosedLoopConfig,
    Disturbance,
    Skills,
    action_limit,
    plan_astar,
    plan_continuous,
    plan_gradient,
    run_closed_loop,
    sample_disturbances,
)
from affordlib.planning.closed_loop import DISPLACED_M, _ClosedLoop
from affordlib.planning.problem import is_on_table
from affordlib.planning.routes import RouteMap, find_route
from affordlib.primitives import Drag, Grasp, Push, Rotate
from affordlib.types import Goal, Plan, Prediction
from affordlib.world import (
    Cuboid,
    Sphere,
    Tabletop,
    UnreachableError,
    UprightCylinder,
    WorldConfig,
)
from experiments.closed_loop import Trial, _stays_feasible
from tests.problems import problem_of


class FollowsTheHand:
    """An `EffectModel` of a held object: from closing to opening it goes where the hand goes."""

    def __init__(self, kind, *channels):
        self.kind, self.action_channels, self.effect_channels = kind, channels, channels

    def encode(self, image):
        return torch.zeros(len(image), 1)

    def predict(self, features, observations, t_target):
        path = self.kind(0.0).path if self.kind is Drag else self.kind().path
        columns = [("x", "y", "z", "yaw").index(name) for name in self.effect_channels]
        held = (
            self.kind(0.0).segment_phases[2] if self.kind is Drag else self.kind().segment_phases[2]
        )
        t = t_target.numpy().ravel()
        way = path(np.maximum(t, held)) - path(held)
        if self.kind is Drag:
            share = torch.from_numpy(way[:, 0] / 0.05).reshape(t_target.shape).float()
            effect = share[..., None] * observations.action[:, -1:, :2]
        else:
            effect = torch.from_numpy(way[:, columns]).reshape(*t_target.shape, -1).float()
        std = torch.full_like(effect, 0.001)
        return Prediction(effect, std, effect, std)


@pytest.fixture(scope="module")
def table():
    with Tabletop() as world:
        yield world


@pytest.fixture(scope="module")
def skills(film):
    return Skills(
        {
            "push": film,
            "drag": FollowsTheHand(Drag, "x", "y"),
            "grasp": FollowsTheHand(Grasp, "z"),
            "rotate": FollowsTheHand(Rotate, "yaw"),
        }
    )


EXACT_M = 0.002
BOX, TUBE, BALL = Cuboid(0.06, 0.05, 0.05), UprightCylinder(0.05, 0.07), Sphere(0.06)


# Endings


@pytest.mark.parametrize("obj", [BOX, BALL], ids=["pushed", "dragged"])
def test_a_goal_is_reached(table, skills, obj):
    table.place(obj, (0.0, 0.0), 0.3)
    goal = Goal((0.11, -0.06), EXACT_M)
    went = run_closed_loop(table, goal, skills)
    assert went.status == "reached", went.message
    assert went.distance_m == goal.distance_m(table.object_pose()[:2]) <= 0.002
    assert "mm from the goal after" in went.message
    assert {type(step.primitive) for step in went.steps} == {Drag if obj is BALL else Push}
    assert len(went.steps) == len(went.object_paths_xy_m) <= action_limit(math.hypot(0.11, 0.06))
    # Where the goal already is, nothing moves.
    again = run_closed_loop(table, Goal(table.object_pose()[:2], EXACT_M), skills)
    assert again.reached
    assert again.steps == ()


def test_the_loop_goes_as_near_as_the_goal_asks(table, skills):
    table.place(BOX, (0.0, 0.0), 0.3)
    went = run_closed_loop(table, Goal((0.07, 0.0), tolerance_m=0.05), skills)
    assert went.reached
    assert went.steps
    near = run_closed_loop(table, Goal(table.object_pose()[:2], tolerance_m=0.0005), skills)
    assert near.reached
    assert near.steps == ()


@pytest.mark.parametrize("xy", [(0.0, 0.7), (-0.5, 0.0), (-0.48, -0.68), (0.68, 0.0)])
def test_a_goal_without_room_for_the_object_is_refused(table, skills, xy):
    table.place(BOX, (0.0, 0.0), 0.3)
    image, pose, moved = table.depth_image(), table.object_pose(), []
    for plan in (plan_astar, plan_continuous, plan_gradient):
        with pytest.raises(ValueError, match="too near the rim of the table"):
            plan(problem_of(skills.model(Push), image, (0.0, 0.0), Goal(xy)))
    table.on_step = moved.append
    went = run_closed_loop(table, Goal(xy), skills)
    table.on_step = None
    assert went.status == "unreachable"
    assert "too near the rim" in went.message
    assert moved == []
    assert table.object_pose() == pose


def test_ways_and_plans_keep_the_whole_object_on_the_table(table, skills):
    table.place(BOX, (0.5, 0.66), 0.3)
    effects = skills.effects(table.depth_image())
    assert effects.radius_m == pytest.approx(math.hypot(0.03, 0.025), abs=0.004)

    def anywhere(xy, *_):
        return np.ones(len(xy), bool)

    routes = RouteMap.of(0.075, anywhere)
    way = find_route(routes, (0.2, 0.69), (0.65, 0.65), anywhere, radius_m=0.045)
    assert is_on_table(np.array(way), 0.045).all()
    beside = np.array(find_route(routes, (0.2, 0.69), (0.65, 0.69), anywhere))
    assert not is_on_table(beside, 0.045).all()


@pytest.mark.slow
def test_an_unreachable_goal_is_refused_before_any_motion(table, skills):
    table.place(BOX, (0.5, 0.3), 0.0)
    pose, moved = table.object_pose(), []
    table.on_step = moved.append
    went = run_closed_loop(table, Goal((0.65, 0.65), EXACT_M), skills)
    table.on_step = None
    assert went.status == "unreachable"
    assert "the position (0.650, 0.650) m" in went.message
    assert moved == []
    assert table.object_pose() == pose
    assert went.vetoes > 0


def test_the_kinematics_agrees_with_what_execution_refuses(table):
    rng = np.random.default_rng(4)
    refused = 0
    for _ in range(60):
        xy, angle = rng.uniform([-0.45, -0.65], [0.65, 0.65]), rng.uniform(-math.pi, math.pi)
        action = (Push.towards(angle), Drag.towards(angle), Grasp(), Rotate())[rng.integers(4)]
        stop = rng.uniform(0.3, 1.0)
        table.place(BOX, tuple(xy))
        steps = []
        table.on_step = steps.append
        said = table.can_reach(action, stop)
        assert steps == []
        if not said:
            with pytest.raises(UnreachableError):
                table.execute_primitive(action, stop, approach=True)
            assert steps == []
            refused += 1
        elif rng.random() < 0.3:
            table.execute_primitive(action, stop, approach=True)
    table.on_step = None
    assert refused > 10


def test_a_veto_bars_and_plans_anew(table, skills, monkeypatch):
    """The arm refuses what was planned first; another way to the goal is taken."""
    refused = []

    def can_reach(self, primitive, stop_phase=1.0, at_xy_m=None):
        if not refused or abs(primitive.direction_rad - refused[0]) < 0.05:
            refused.append(primitive.direction_rad)
            return False
        return True

    table.place(BOX, (0.0, 0.0), 0.3)
    monkeypatch.setattr(Tabletop, "can_reach", can_reach)
    went = run_closed_loop(table, Goal((0.1, 0.05), EXACT_M), skills)
    assert went.reached, went.message
    assert went.vetoes == len(refused) >= 1
    assert abs(went.steps[0].primitive.direction_rad - refused[0]) > 0.05


def test_what_somebody_has_set_rolling_is_waited_for(table, skills):
    table.place(BALL, (0.0, 0.0))
    goal, config = Goal((0.1, 0.0), EXACT_M), ClosedLoopConfig()
    chase = _ClosedLoop(table, goal, skills, plan_continuous, config, ())
    chase.expected = (0.0, 0.0)
    table.knock(0.0, 0.25)
    table.settle(0.3)
    rolling = math.dist(table.object_pose()[:2], (0.0, 0.0))
    assert rolling > DISPLACED_M
    chase._look()
    (seen,) = chase.places
    assert math.dist(seen, (0.0, 0.0)) > rolling + 0.01
    table.settle(1.0)
    assert math.dist(table.object_pose()[:2], seen) < 0.01


def test_the_disturbance_and_not_the_robot_makes_a_goal_infeasible(table):
    """Judged where the object was first seen after it."""
    goal, off_table = Goal((0.1, 0.0), EXACT_M), (0.9, 0.0)
    knock = Disturbance("knock", 0, 0.1, 0.3, at_s=2.0)
    moved = Disturbance("goal", 1, 0.05, 0.0)
    table.place(BOX)

    def feasible(ending, seen, happened):
        trial = Trial(BOX, (0.0, 0.0), 0.0, goal, (happened,))
        went = SimpleNamespace(status=ending, seen_xy_m=seen, happened=(happened,), goal=goal)
        return _stays_feasible(table, trial, went)

    at, near = (0.0, 0.0), (0.05, 0.0)
    assert feasible("reached", (at, near), knock)
    assert not feasible("lost", (at, off_table), knock)
    assert feasible("lost", (at, near, off_table), knock)  # it was there to be had
    assert feasible("lost", (at, off_table), moved)  # nobody has touched it but the robot


def test_it_gives_up_at_the_limit_of_actions(table, skills):
    table.place(BOX, (0.0, 0.0), 0.3)
    went = run_closed_loop(
        table, Goal((0.25, 0.0), EXACT_M), skills, config=ClosedLoopConfig(max_actions=1)
    )
    assert went.status == "gave_up"
    assert "after 1 action:" in went.message
    assert len(went.steps) == 1
    assert (
        run_closed_loop(
            table, Goal((0.0, 0.3), EXACT_M), skills, config=ClosedLoopConfig(max_actions=0)
        ).steps
        == ()
    )


@pytest.mark.parametrize(
    ("distance", "limit"), [(0.0, 3), (0.01, 4), (0.05, 4), (0.051, 5), (0.25, 8)]
)
def test_the_limit_is_the_distance_over_5_cm_rounded_up_and_3(distance, limit):
    assert action_limit(distance) == limit


def test_an_object_that_always_escapes_ends_the_pursuit(table, skills):
    """Somebody takes it away after every action: no endless loop."""
    table.place(BOX, (0.0, 0.0), 0.3)

    def take_away(plan, n):
        x, y, _ = table.object_pose()
        table.shove(-x, -y, 0.1)

    went = run_closed_loop(
        table, Goal((0.06, 0.0), EXACT_M), skills, config=ClosedLoopConfig(on_action=take_away)
    )
    assert went.status == "gave_up"
    assert len(went.steps) <= 4 * action_limit(0.06)


def test_a_planner_that_does_nothing_is_given_up(table, skills):
    def lazy(problem):
        return Plan(problem.goal, problem.start_xy_m, (), "lazy", False, 0, 0.0)

    table.place(BOX, (0.0, 0.0), 0.3)
    went = run_closed_loop(table, Goal((0.1, 0.0), EXACT_M), skills, planner=lazy)
    assert went.status == "gave_up"
    assert went.steps == ()


def test_an_object_off_the_table_is_lost(table, skills):
    table.place(BALL, (0.5, 0.0), 0.0)
    blow = Disturbance("knock", 1, 1.5, 0.0, at_s=None)
    went = run_closed_loop(table, Goal((0.4, 0.1), EXACT_M), skills, disturbances=[blow])
    assert went.status == "lost"
    assert "no longer on the table" in went.message


# Surprises


def test_a_goal_that_moves_is_followed(table, skills):
    table.place(BOX, (0.0, 0.0), 0.3)
    moves = Disturbance("goal", 0, 0.0, 0.08, at_s=3.0)
    went = run_closed_loop(table, Goal((0.1, 0.0), EXACT_M), skills, disturbances=[moves])
    assert went.happened == (moves,)
    assert went.goal.xy_m == pytest.approx((0.1, 0.08))
    assert went.reached, went.message
    assert went.distance_m < 0.005
    assert Goal((0.1, 0.0), EXACT_M).distance_m(went.end_pose[:2]) > 0.07


def test_a_shoved_object_is_looked_for_again(table, skills):
    table.place(BOX, (0.0, 0.0), 0.3)
    shove = Disturbance("shove", 1, -0.02, 0.07, turn=1.0)
    went = run_closed_loop(table, Goal((0.16, 0.0), EXACT_M), skills, disturbances=[shove])
    assert went.reached, went.message
    assert len(went.plans) >= 2


def test_a_toppled_cylinder_is_dragged(table, skills):
    """Pushed while it stands; lying it would roll away, so it is caged: told from the image."""
    table.place(TUBE, (0.0, 0.0), 0.0)
    falls = Disturbance("topple", 1, 0.0, 1.0)
    went = run_closed_loop(table, Goal((0.2, 0.0), EXACT_M), skills, disturbances=[falls])
    assert table.object_fell()
    assert [type(s.primitive) for s in went.steps][:2] == [Push, Drag]
    assert went.reached, went.message


def test_a_knock_in_the_middle_of_an_action_follows_mechanics(table):
    """It slides v²/(2 μ g) and stops; under the fingers it stays on the table."""
    table.place(BOX, (0.0, 0.0), 0.0)
    table.knock(0.5, 0.0)
    table.settle(1.0)
    assert table.object_pose()[0] == pytest.approx(0.5**2 / (2 * 0.25 * 9.81), rel=0.05)
    # The clock counts from where the arm sets out; the push touches after 4 s.
    from affordlib.planning.disturbances import DisturbanceSchedule

    table.place(BOX, (0.0, 0.0), 0.0)
    script = DisturbanceSchedule(
        Goal((0.1, 0.0), EXACT_M), [Disturbance("knock", 0, 0.0, 0.4, at_s=2.0)]
    )
    with script.during(table, 0):
        table.execute_primitive(Push.towards(0.0), 0.8, approach=True)
    assert len(script.happened) == 1
    assert table.object_pose()[1] > 0.02
    assert table.on_step is None


def test_disturbances_are_a_function_of_the_seed():
    assert sample_disturbances(3, n=20) == sample_disturbances(3, n=20)
    assert sample_disturbances(3, n=20) != sample_disturbances(4, n=20)
    drawn = sample_disturbances(0, n=300, n_actions=3)
    assert {d.kind for d in drawn} == {"shove", "knock", "topple", "goal"}
    assert all(d.at_s is None for d in drawn if d.kind == "shove")
    assert all(d.action >= 1 for d in drawn if d.at_s is None)
    with pytest.raises(ValueError, match="a shove happens between actions"):
        Disturbance("shove", 1, 0.1, 0.0, at_s=1.0)
    with pytest.raises(ValueError, match="kind must be one of"):
        Disturbance("kick", 1, 0.1, 0.0)


def test_a_disturbed_pursuit_is_the_same_again(table, skills):
    ends = []
    for _ in range(2):
        table.place(TUBE, (0.0, 0.0), 0.0)
        script = sample_disturbances(7, n=2)
        ends.append(
            run_closed_loop(table, Goal((0.1, 0.1), EXACT_M), skills, disturbances=script).end_pose
        )
    assert ends[0] == ends[1]


@pytest.mark.slow
def test_a_goal_across_the_table_is_reached_in_the_limit(table, skills):
    table.place(BALL, (0.2, -0.4), 0.0)
    goal = Goal((0.2, 0.25), EXACT_M)
    went = run_closed_loop(table, goal, skills)
    assert went.reached, went.message
    assert len(went.steps) <= action_limit(0.65)


@pytest.mark.parametrize(
    ("shifts_m", "lifts", "ending"),
    [((0.0,), 1, "reached"), ((0.02,), 2, "reached"), ((0.02, 0.02), 2, "gave_up")],
)
def test_what_is_held_aside_of_its_goal_is_put_down_and_lifted_there(
    table, skills, shifts_m, lifts, ending
):
    """The goal moves by so much after each lift."""
    goal = Goal((0.06, 0.0), EXACT_M, height_m=0.1)
    left = list(shifts_m)

    def move_goal(plan, n):
        nonlocal goal
        if plan.steps[-1].primitive.name == "grasp" and left:
            goal = replace(goal, xy_m=(goal.xy_m[0] + left.pop(0), 0.0))
            return goal
        return None

    table.place(TUBE)
    went = run_closed_loop(table, goal, skills, config=ClosedLoopConfig(on_action=move_goal))
    assert went.status == ending, went.message
    assert sum(isinstance(step.primitive, Grasp) for step in went.steps) == lifts
    aside_m = 0.0 if ending == "reached" else shifts_m[-1]
    assert went.distance_m == pytest.approx(aside_m, abs=0.005)
    assert abs(went.height_error_m) < 0.003


def test_an_object_that_no_camera_sees_is_lost(table, skills):
    table.place(BALL, (0.6, 0.0), config=WorldConfig(camera="kinect"))
    off = Disturbance("knock", 0, 1.5, 0.0)
    went = run_closed_loop(table, Goal((0.3, 0.0), EXACT_M), skills, disturbances=[off])
    assert went.status == "lost", went.message
    table.place(BOX, (0.0, 0.0), config=WorldConfig())


@pytest.mark.parametrize("goal", [{"turn_rad": -0.5}, {"height_m": 0.1}])
def test_no_more_actions_than_were_allowed(table, skills, goal):
    table.place(BOX, (0.0, 0.0), 0.3)
    went = run_closed_loop(
        table, Goal((0.0, 0.0), EXACT_M, **goal), skills, config=ClosedLoopConfig(max_actions=0)
    )
    assert (went.status, went.steps) == ("gave_up", ())
    with pytest.raises(TypeError, match=r"max_actions=1\.5"):
        run_closed_loop(
            table, Goal((0.0, 0.0), EXACT_M), skills, config=ClosedLoopConfig(max_actions=1.5)
        )


def test_a_goal_that_turns_on_the_way_is_followed(table, skills):
    table.place(TUBE, (0.0, 0.0))
    turns = [-0.4, -0.8]

    def again(plan, n):
        at = abs(turns[0] - table.object_pose()[2]) if turns else 1.0
        return Goal((0.0, 0.0), EXACT_M, turn_rad=turns.pop(0) - 0.4) if at < 0.05 else None

    went = run_closed_loop(
        table,
        Goal((0.0, 0.0), EXACT_M, turn_rad=-0.4),
        skills,
        config=ClosedLoopConfig(on_action=again),
    )
    assert went.reached, went.message
    assert not turns
    assert went.goal.turn_rad == pytest.approx(-1.2)


def test_the_arm_is_asked_about_the_grasp_that_it_will_carry_out(table, skills):
    """At the rim of its reach a hand's height decides, and that goes by the object's."""
    for x in (0.52, 0.523, 0.526, 0.529):
        table.place(Cuboid(0.05, 0.05, 0.08), (x, 0.0))
        went = run_closed_loop(table, Goal((x, 0.0), EXACT_M, height_m=0.24), skills)
        assert went.status == ("reached" if x == 0.52 else "unreachable"), went.message
        assert x == 0.52 or went.steps == ()
