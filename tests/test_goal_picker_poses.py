"""The picker where a turn and a height are asked for."""

import math

import pytest

from affordlib.planning import plan_continuous
from affordlib.show import GoalPicker
from affordlib.show.executors import closed_loop, open_loop
from affordlib.types import Goal
from affordlib.world import Cuboid


@pytest.fixture
def posed(world, skills, tmp_path):
    world.place(Cuboid(0.06, 0.05, 0.05))
    return GoalPicker(
        world,
        {"continuous": skills.planner(plan_continuous)},
        executors={"open loop": open_loop, "closed loop": closed_loop(skills)},
        folder=str(tmp_path),
        seconds_per_action=0.0,
    )


@pytest.mark.parametrize(("executor", "within_deg"), [("open loop", 3.0), ("closed loop", 2.0)])
def test_turn_and_lift_are_asked_for_planned_and_done(posed, world, executor, within_deg):
    posed.controls.executor.value = executor
    posed.pick(0.04, 0.03)
    posed.controls.turn.value, posed.controls.height.value = 25.0, 6.0
    goal = posed.plan.goal
    assert (math.degrees(goal.turn_rad), goal.height_m) == pytest.approx((25.0, 0.06))
    assert goal.xy_m == (0.04, 0.03)
    assert "then rotate to" in posed.controls.words.value
    assert "then grasp to" in posed.controls.words.value
    scene = posed._view.scene
    assert scene["goal"]["yaw"] == pytest.approx(math.radians(25.0), abs=1e-4)
    assert scene["steps"][-1]["yaw"] == pytest.approx(math.radians(25.0), abs=0.04)
    assert [step["direction"] for step in scene["steps"][-2:]] == [None, None]
    assert posed.picture()[:4] == b"\x89PNG"
    posed.run()
    said = posed.controls.words.value
    assert "The turn is off by" in said
    assert "The height is off by" in said
    assert posed.outcome.lifted_m == pytest.approx(0.06, abs=0.005), said
    assert world.object_state()[2] == pytest.approx(0.025 + 0.06, abs=0.005), said
    assert math.degrees(world.object_pose()[2]) == pytest.approx(25.0, abs=within_deg), said
    posed.ask_pose()
    assert posed.plan.goal.turn_rad is None
    assert posed.plan.goal.height_m is None
    assert (posed.controls.turn.value, posed.controls.height.value) == (0.0, 0.0)
    assert world.object_state()[2] < 0.05  # let go, to be seen and planned for


def test_what_cannot_be_lifted_so_high_is_said_before_anything_moves(posed):
    posed.pick(0.04, 0.03)
    posed._set_goal(Goal((0.04, 0.03), height_m=0.45))
    posed._make_plan()
    assert "not foreseen to be turned or lifted there" in posed.controls.words.value


def test_a_plan_with_turn_and_lift_is_saved_and_loaded(posed):
    posed.ask_pose(turn_deg=-30, height_cm=4)
    posed.save("posed.json")
    posed.ask_pose()
    posed.load("posed.json")
    assert (posed.controls.turn.value, posed.controls.height.value) == (-30.0, 4.0)


def test_a_loaded_plan_begins_with_an_object_that_stands(posed, world):
    posed.pick(0.05, 0.0)
    posed.save("flat.json")
    posed.ask_pose(height_cm=8)
    posed.run()
    assert world.object_state()[2] > 0.08
    posed.load("flat.json")
    assert world.object_state()[2] < 0.04
