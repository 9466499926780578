"""Orientation and height: where to stop, and at which angle to take hold."""

import math

import numpy as np
import pytest

from affordlib.planning import plan_lift, plan_turn, run_closed_loop
from affordlib.planning.grasp_rotate import GRIPPER_YAWS_RAD, crossings, predict_trajectories
from affordlib.primitives import Grasp, Push, Rotate
from affordlib.types import Goal
from affordlib.world import Cuboid, LyingCylinder, Tabletop, UprightCylinder

EXACT_M = 0.002
BOX, TUBE = Cuboid(0.06, 0.05, 0.05), UprightCylinder(0.05, 0.07)
DISC = LyingCylinder(0.05, 0.10)
"""On its rim, and as wide as the hand can open: only its faces can be taken."""


def test_crossings_are_where_the_course_has_the_value():
    phase = np.linspace(0, 1, 5)
    np.testing.assert_allclose(
        crossings(phase, np.array([0, 1, 1, 0, 2]), 0.5), [0.125, 0.625, 0.8125]
    )
    assert len(crossings(phase, np.zeros(5), 0.5)) == 0


@pytest.mark.parametrize("height", [0.03, 0.12])
def test_a_partial_grasp_ends_holding_at_the_height(world, skills, height):
    world.place(BOX, (0.02, 0.01), 0.0)
    went = run_closed_loop(world, Goal((0.02, 0.01), EXACT_M, height_m=height), skills)
    assert went.reached, went.message
    assert [type(s.primitive) for s in went.steps] == [Grasp]
    assert 0 < went.steps[0].stop_phase < 1
    z = world.object_state()[2]
    assert z - BOX.height_m / 2 == pytest.approx(height, abs=0.003)


def test_a_turn_is_a_partial_rotation(world, skills):
    world.place(TUBE, (0.0, 0.0), 0.0)
    went = run_closed_loop(world, Goal((0.0, 0.0), EXACT_M, turn_rad=0.6), skills)
    assert went.reached, went.message
    assert world.object_pose()[2] == pytest.approx(0.6, abs=math.radians(3))
    assert [type(s.primitive) for s in went.steps] == [Rotate]
    # What one sweep of 60° does not reach takes another.
    world.place(TUBE, (0.0, 0.0), 0.0)
    went = run_closed_loop(world, Goal((0.0, 0.0), EXACT_M, turn_rad=1.9), skills)
    assert went.reached, went.message
    assert sum(isinstance(s.primitive, Rotate) for s in went.steps) >= 2


@pytest.mark.parametrize("obj", [TUBE, BOX], ids=["round", "with flanks"])
def test_position_orientation_and_height_are_chained(world, skills, obj):
    world.place(obj, (0.0, 0.0), 0.0)
    goal = Goal((0.07, 0.03), 0.004, turn_rad=0.5, height_m=0.08)
    went = run_closed_loop(world, goal, skills)
    assert went.reached, went.message
    kinds = [type(s.primitive) for s in went.steps]
    assert kinds[0] is Push
    assert kinds[-2:] == [Rotate, Grasp]
    turn = world.object_pose()[2]
    assert turn == pytest.approx(0.5, abs=math.radians(3))  # not turned back by the grasp
    assert went.turn_error_rad == pytest.approx(0.5 - turn)
    assert abs(went.height_error_m) < 0.005


def test_the_part_that_cannot_be_had_is_named(world, skills):
    world.place(BOX, (0.0, 0.0), 0.0)
    went = run_closed_loop(world, Goal((0.0, 0.0), EXACT_M, height_m=0.4), skills)
    assert (went.status, went.steps) == ("unreachable", ())
    assert "the height: 40.0 cm" in went.message
    image = world.depth_image()
    assert plan_lift(skills.model(Grasp), image, (0, 0), 0.4) is None
    step = plan_turn(skills.model(Rotate), image, (0, 0), 0.5)
    assert step.predicted_turn_rad == pytest.approx(0.5)
    with pytest.raises(ValueError, match="channel 'yaw' is not among the effects"):
        plan_turn(skills.model(Grasp), image, (0, 0), 0.5)


def test_a_rotated_hand_before_a_rotated_object_predicts_the_same(world, skills):
    predicted = []
    for turn in (0.0, math.pi / 2):
        world.place(BOX, yaw_rad=0.3 + turn)
        angles = [turn + 0.2]
        predicted.append(
            predict_trajectories(
                skills.model(Rotate), world.depth_image(), Rotate(), "yaw", angles
            ).mean
        )
    np.testing.assert_allclose(*predicted, atol=math.radians(1.5))


def test_the_hand_takes_what_it_can_hold(world, skills):
    world.place(DISC, yaw_rad=0.6)
    step = plan_lift(skills.model(Grasp), world.depth_image(), (0.0, 0.0), 0.15)
    assert world.execute_primitive(Grasp(), record_unreachable=True).effect[-1, 2] < 0.01
    world.place(DISC, yaw_rad=0.6)
    assert world.execute(step).rest_effect[2] == pytest.approx(0.15, abs=0.005)
    assert step.primitive.grip_yaw != 0
    world.place(DISC, yaw_rad=0.6)
    assert plan_lift(skills.model(Grasp), world.depth_image(), (0.0, 0.0), 0.15, [0.0]) is None


@pytest.mark.parametrize("degrees", [-25, 30, 75])
def test_a_box_is_turned_either_way_in_one_rotation(world, skills, degrees):
    world.place(BOX, (0.0, 0.0), 0.2)
    went = run_closed_loop(world, Goal((0.0, 0.0), EXACT_M, turn_rad=math.radians(degrees)), skills)
    assert went.reached, went.message
    assert [type(s.primitive) for s in went.steps] == [Rotate]
    turned = math.degrees(world.object_pose()[2] - 0.2)
    assert turned == pytest.approx(degrees, abs=2)


def test_an_angle_that_the_arm_refuses_is_not_taken(world, skills, monkeypatch):
    asked = []

    def can_reach(self, primitive, stop_phase=1.0, at_xy_m=None):
        asked.append(primitive.grip_yaw)
        return len(asked) == 3

    world.place(DISC, yaw_rad=0.6)
    monkeypatch.setattr(Tabletop, "can_reach", can_reach)
    goal = Goal((0.0, 0.0), EXACT_M, height_m=0.1)
    went = run_closed_loop(world, goal, skills)
    assert went.reached, went.message
    assert went.steps[0].primitive.grip_yaw == asked[-1]
    assert went.vetoes == 2
    assert len({round(yaw, 6) for yaw in asked}) == 3
    monkeypatch.setattr(Tabletop, "can_reach", lambda *_: False)
    world.place(BOX)
    went = run_closed_loop(world, goal, skills)
    assert (went.status, went.steps, went.vetoes) == ("unreachable", (), len(GRIPPER_YAWS_RAD))
    assert "the height: 10.0 cm: the arm cannot grasp at (0.000, 0.000) m" in went.message
