"""Whole plans: the rotations and the grasp with which a plan ends."""

import math
from dataclasses import replace

import numpy as np
import pytest

from affordlib.geometry import wrap_angle
from affordlib.planning import (
    EffectMap,
    PlanMode,
    PlanningProblem,
    execute_plan,
    plan_astar,
    plan_continuous,
    plan_gradient,
)
from affordlib.planning.astar import BranchTable, search
from affordlib.planning.grasp_rotate import GRIPPER_YAWS_RAD
from affordlib.primitives import Drag, Grasp, Push, Rotate
from affordlib.types import Goal
from affordlib.world import Cuboid, LyingCylinder, UprightCylinder
from tests.problems import problem_of

BOX, TUBE, LOG = Cuboid(0.07, 0.05, 0.05), UprightCylinder(0.05, 0.07), LyingCylinder(0.08, 0.05)


def poses_of(skills, image):
    """What turns and lifts the object in an image."""
    return skills.problem(image, (0.0, 0.0), Goal((0.0, 0.0))).pose_planner


BOTH = pytest.mark.parametrize("plan", [plan_astar, plan_continuous])


@BOTH
@pytest.mark.parametrize("obj", [BOX, TUBE, LOG], ids=["box", "tube", "log"])
def test_one_look_is_enough_for_position_turn_and_height(world, skills, plan, obj):
    world.place(obj, yaw_rad=0.3)
    z = world.object_state()[2]
    goal = Goal((0.07, 0.06), turn_rad=0.8, height_m=0.1)
    found = skills.planner(plan)(world.depth_image(), (0.0, 0.0), goal)
    assert found.reaches_goal
    kinds = [type(step.primitive) for step in found.steps]
    assert kinds[0] is (Drag if obj is LOG else Push)
    assert kinds[-2:] == [Rotate, Grasp]
    assert found.steps[-1].predicted_height_m == pytest.approx(0.1)
    assert wrap_angle(found.steps[-1].predicted_turn_rad - 0.8) == pytest.approx(0.0, abs=0.035)
    outcome = execute_plan(world, found)
    assert outcome.distance_m < goal.tolerance_m + 0.002
    assert outcome.turned_rad == pytest.approx(0.8, abs=math.radians(4))
    assert outcome.lifted_m == pytest.approx(0.1, abs=0.005)
    assert outcome.lifted_m == pytest.approx(world.object_state()[2] - z, abs=1e-6)


def test_a_turn_backwards_goes_round_in_several_rotations(world, skills):
    world.place(TUBE)
    goal = Goal((0.0, 0.0), turn_rad=-2.5)
    found = skills.planner(plan_astar)(world.depth_image(), (0.0, 0.0), goal)
    assert found.reaches_goal
    assert found.evaluations == 0  # it stands where it should: nothing is expanded
    assert [type(step.primitive) for step in found.steps] == [Rotate] * len(found.steps)
    assert len(found.steps) >= 3
    turns = np.diff([0.0, *(step.predicted_turn_rad for step in found.steps)])
    assert (turns > 0).all()
    outcome = execute_plan(world, found)
    assert wrap_angle(outcome.turned_rad + 2.5) == pytest.approx(0.0, abs=math.radians(5))


def test_what_is_foreseen_turns_with_the_object(world, skills):
    """A push that turns the box by an angle, or a look at the box turned by it: the same end."""
    goal, turned = Goal((0.0, 0.0), turn_rad=1.2, height_m=0.1), 0.35
    world.place(BOX, yaw_rad=0.2)
    before = poses_of(skills, world.depth_image())(goal, (0.0, 0.0), turned_rad=turned)
    world.place(BOX, yaw_rad=0.2 + turned)
    rest = Goal((0.0, 0.0), turn_rad=1.2 - turned, height_m=0.1)
    after = poses_of(skills, world.depth_image())(rest, (0.0, 0.0))
    assert [type(step.primitive) for step in before] == [Rotate, Grasp]
    for a, b in zip(before, after, strict=True):
        assert a.predicted_turn_rad - turned == pytest.approx(b.predicted_turn_rad, abs=0.04)
    hands = [abs(step.primitive.grip_yaw) for step in before]
    assert max(hands) <= math.pi / 2 + 1e-9


def test_a_grasp_takes_an_object_as_the_rotation_left_it(world, skills):
    world.place(BOX, yaw_rad=0.3)
    turn, lift = poses_of(skills, world.depth_image())(
        Goal((0.0, 0.0), turn_rad=0.9, height_m=0.1), (0.0, 0.0)
    )
    left_at = turn.primitive.path(turn.stop_phase)[0, 3]
    off = (lift.primitive.grip_yaw - left_at) / (math.pi / 2)
    assert off == pytest.approx(round(off), abs=1e-6)


@BOTH
def test_a_plan_that_cannot_turn_or_lift_says_so(world, skills, plan):
    world.place(BOX)
    planner = skills.planner(plan)
    assert planner(world.depth_image(), (0.0, 0.0), Goal((0.05, 0.0))).reaches_goal
    high = planner(world.depth_image(), (0.0, 0.0), Goal((0.05, 0.0), height_m=0.45))
    assert not high.reaches_goal
    assert high.steps  # as far as it goes
    goal = Goal((0.05, 0.0), height_m=0.1)
    alone = plan(problem_of(skills.model(Push), world.depth_image(), (0.0, 0.0), goal))
    assert not alone.reaches_goal  # nobody has told this planner how to lift
    assert alone.predicted_distance_m <= 0.02


def test_the_paper_s_gradient_planner_brings_things_to_a_place_only(trained, cuboid_image):
    goal = Goal((0.05, 0.05), tolerance_m=0.1)
    assert plan_gradient(problem_of(trained, cuboid_image, (0.0, 0.0), goal)).reaches_goal
    posed = Goal((0.05, 0.05), tolerance_m=0.1, height_m=0.1)
    assert not plan_gradient(problem_of(trained, cuboid_image, (0.0, 0.0), posed)).reaches_goal


def test_a_search_goes_on_where_the_end_cannot_be_had(film, cuboid_image):
    """A node within the tolerance from which the turn cannot be had is none of the goal's."""
    table, goal = BranchTable(EffectMap(film, cuboid_image)), Goal((0.08, 0.0), turn_rad=0.1)
    asked = []

    def only_beyond(goal, xy_m, turned_rad):
        asked.append(xy_m)
        return () if xy_m[0] > 0.085 else None

    two = PlanMode(2, partial=True)
    problem = PlanningProblem((0.0, 0.0), goal, table.effects, two, None, only_beyond)
    chain, reached, _ = search(problem, table)
    assert reached
    assert len(asked) > 1
    assert asked[-1][0] > 0.085
    assert all(goal.distance_m(xy) <= goal.tolerance_m for xy in asked)
    one = PlanMode(1, partial=True)
    never = search(replace(problem, mode=one, pose_planner=lambda *_: None), table)
    assert not never[1]
    assert len(chain) >= 1


def test_an_arm_that_cannot_turn_there_is_not_planned_with(world, skills):
    world.place(BOX)
    finish = poses_of(skills, world.depth_image())
    goal = Goal((0.0, 0.0), turn_rad=0.5, height_m=0.05)
    assert finish(goal, (0.0, 0.0)) is not None
    assert finish(goal, (0.7, 0.7)) is None  # beyond the arm's reach, as it has learned
    assert finish(Goal((0.0, 0.0)), (0.7, 0.7)) == ()


def test_what_models_say_is_kept_while_only_the_goal_moves(skills, cuboid_image):
    planner = skills.planner(plan_continuous, seed=1)
    first = skills.effects(cuboid_image)
    for x in (0.03, 0.06, 0.1):
        goal = Goal((x, 0.04))
        plan = planner(cuboid_image, (0.0, 0.0), goal)
        problem = problem_of(skills.model(Push), cuboid_image, (0.0, 0.0), goal)
        problem = replace(problem, reachable=skills.reachable(Push))
        afresh = plan_continuous(problem, seed=1)
        assert plan.predicted_end_xy_m == afresh.predicted_end_xy_m
    assert skills.effects(np.array(cuboid_image)) is first
    assert skills.effects(np.roll(cuboid_image, 1)) is not first


def test_the_hands_that_are_weighed_are_all_there_are():
    assert len({round(math.degrees(yaw)) % 180 for yaw in GRIPPER_YAWS_RAD}) == 12
