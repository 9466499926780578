"""Orientation and height: stop phase, gripper yaw, and their place at the end of plans."""

import math

import numpy as np
import pytest

from affordlib.planning import execute_plan, grasp_rotate, plan_astar, plan_continuous
from affordlib.planning.grasp_rotate import GRIPPER_YAWS_RAD, crossings, predict_trajectories
from affordlib.primitives import Drag, Grasp, Push, Rotate, wrap_angle
from affordlib.types import Goal
from affordlib.world import Cuboid, LyingCylinder, UprightCylinder
from tests.planning.point_robot import problem_of

BOX, TUBE, LOG = Cuboid(0.06, 0.05, 0.05), UprightCylinder(0.05, 0.07), LyingCylinder(0.08, 0.05)
DISC = LyingCylinder(0.05, 0.10)  # as wide as the hand can open: only its faces can be grasped
AT = (0.0, 0.0)


def plan_turn(model, image, turn_rad):
    predicted = predict_trajectories(model, image, Rotate(), "yaw")
    return next(grasp_rotate.candidate_turns(predicted, AT, turn_rad), None)


def plan_lift(model, image, height_m, yaws=GRIPPER_YAWS_RAD):
    predicted = predict_trajectories(model, image, Grasp(), "z", yaws)
    return next(grasp_rotate.candidate_lifts(predicted, AT, height_m), None)


def test_crossings_are_where_the_trajectory_has_the_value():
    phase = np.linspace(0, 1, 5)
    there = crossings(phase, np.array([0, 1, 1, 0, 2]), 0.5)
    np.testing.assert_allclose(there, [0.125, 0.625, 0.8125])
    assert len(crossings(phase, np.zeros(5), 0.5)) == 0
    assert len({round(math.degrees(yaw)) % 180 for yaw in GRIPPER_YAWS_RAD}) == 12


@pytest.mark.parametrize(
    ("obj", "degrees"), [(TUBE, 35), (BOX, -25), (BOX, 30), (BOX, 75)], ids=lambda v: str(v)[:6]
)
def test_a_partial_rotation_turns_by_the_angle_either_way(world, skills, obj, degrees):
    world.place(obj, AT, 0.2)
    step = plan_turn(skills.model(Rotate), world.depth_image(), math.radians(degrees))
    turned = math.degrees(world.execute(step).rest_effect[3])
    assert turned == pytest.approx(degrees, abs=2)
    assert step.predicted_turn_rad == pytest.approx(math.radians(degrees))


def test_the_hand_takes_what_it_can_hold(world, skills):
    world.place(DISC, yaw_rad=0.6)
    image = world.depth_image()
    step = plan_lift(skills.model(Grasp), image, 0.15)
    assert step.primitive.grip_yaw != 0
    assert world.execute(step).rest_effect[2] == pytest.approx(0.15, abs=0.005)
    world.place(DISC, yaw_rad=0.6)
    assert world.execute_primitive(Grasp()).effect[-1, 2] < 0.01
    assert plan_lift(skills.model(Grasp), image, 0.15, [0.0]) is None


@pytest.mark.parametrize(
    ("plan", "obj"), [(plan_astar, BOX), (plan_continuous, TUBE), (plan_continuous, LOG)]
)
def test_one_image_is_enough_for_position_turn_and_height(world, skills, plan, obj):
    world.place(obj, yaw_rad=0.3)
    z = world.object_state()[2]
    goal = Goal((0.07, 0.06), turn_rad=0.8, height_m=0.1)
    found = plan(skills.problem(world.depth_image(), AT, goal))
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
    found = plan_astar(skills.problem(world.depth_image(), AT, Goal(AT, turn_rad=-2.5)))
    assert found.reaches_goal
    assert {type(step.primitive) for step in found.steps} == {Rotate}
    off = wrap_angle(execute_plan(world, found).turned_rad + 2.5)
    assert off == pytest.approx(0.0, abs=math.radians(5))


def test_predictions_turn_with_the_object(world, skills):
    """A push that turns the box, and an image of the box turned, lead to the same final pose."""
    turned = 0.35
    world.place(BOX, yaw_rad=0.2)
    poses = skills.problem(world.depth_image(), AT, Goal(AT)).pose_planner
    before = poses(Goal(AT, turn_rad=1.2, height_m=0.1), AT, turned_rad=turned)
    world.place(BOX, yaw_rad=0.2 + turned)
    rest = Goal(AT, turn_rad=1.2 - turned, height_m=0.1)
    after = skills.problem(world.depth_image(), AT, Goal(AT)).pose_planner(rest, AT)
    assert [type(step.primitive) for step in before] == [Rotate, Grasp]
    for a, b in zip(before, after, strict=True):
        assert a.predicted_turn_rad - turned == pytest.approx(b.predicted_turn_rad, abs=0.04)
    assert max(abs(step.primitive.grip_yaw) for step in before) <= math.pi / 2 + 1e-9
    # The grasp has the gripper yaw of the rotation.
    turn, lift = after
    left_at = turn.primitive.path(turn.stop_phase)[0, 3]
    off = (lift.primitive.grip_yaw - left_at) / (math.pi / 2)
    assert off == pytest.approx(round(off), abs=1e-6)


@pytest.mark.parametrize("plan", [plan_astar, plan_continuous])
def test_a_plan_that_cannot_turn_or_lift_says_so(world, skills, plan):
    world.place(BOX)
    image = world.depth_image()
    assert plan(skills.problem(image, AT, Goal((0.05, 0.0)))).reaches_goal
    high = plan(skills.problem(image, AT, Goal((0.05, 0.0), height_m=0.45)))
    assert not high.reaches_goal
    assert high.steps  # as far as possible
    poses = skills.problem(image, AT, Goal(AT)).pose_planner
    goal = Goal(AT, turn_rad=0.5, height_m=0.05)
    assert poses(goal, AT) is not None
    assert poses(goal, (0.7, 0.7)) is None  # beyond the learned reach
    assert poses(Goal(AT), (0.7, 0.7)) == ()
    assert plan_lift(skills.model(Grasp), image, 0.4) is None
    with pytest.raises(ValueError, match="channel 'yaw' is not among the effects"):
        plan_turn(skills.model(Grasp), image, 0.5)


def test_predictions_are_kept_while_only_the_goal_moves(skills, cuboid_image):
    first = skills.effects(cuboid_image)
    for x in (0.03, 0.06):
        task = cuboid_image, AT, Goal((x, 0.04)), "single_partial"
        plan = plan_continuous(skills.problem(*task), seed=1)
        problem = problem_of(skills.model(Push), *task, reachable=skills.reachable(Push))
        again = plan_continuous(problem, seed=1)
        assert plan.predicted_end_xy_m == again.predicted_end_xy_m
    assert skills.effects(np.array(cuboid_image)) is first
    assert skills.effects(np.roll(cuboid_image, 1)) is not first
    written, before = np.array(cuboid_image), skills.effects(cuboid_image).image.copy()
    kept = skills.effects(written)
    written[0] = 1.0
    np.testing.assert_array_equal(kept.image, before)
