import base64
import io
import math
import re
import time
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from affordlib.planning import Skills, execute_plan, plan_astar, plan_continuous
from affordlib.show import GoalPicker
from affordlib.show.table_data import TableView
from affordlib.types import Obstacle
from affordlib.world import Cuboid
from tests.waiting import wait_until

CONTINUOUS = {"continuous": plan_continuous}
picker = pytest.fixture(lambda make_picker: make_picker())
posed = pytest.fixture(lambda make_picker, skills: make_picker(skills=skills, planners=CONTINUOUS))
"""A picker whose plans turn and lift."""


@pytest.fixture
def make_picker(world, trained):
    world.place(Cuboid(0.06, 0.05, 0.05))

    def broken(*_):
        raise ValueError("no <plan> today")

    def make(pace_s=0.0, skills=None, planners=None, **options):
        planners = planners or {"A*": plan_astar, "broken": broken}
        skills = skills or Skills({"push": trained})
        picker = GoalPicker(world, skills, planners, (0.12, 0.0), **options)
        picker.pace_s = pace_s
        return picker

    return make


def carry_out(picker, executor):
    """Replace the function that executes a plan in an open loop."""
    picker._executors["open loop"] = executor


def want(picker, x_m, y_m, number):
    """Move the goal as by hand."""
    picker._view.wanted = [x_m, y_m, number]


def in_time(picker):
    """Wait until all earlier requests are done."""
    picker._queue.submit(int).result(60)
    return picker


def drawn_goal(picker):
    return tuple(picker._view.scene["goal"]["xy"])


def drawn_path(picker):
    """Path (n, 2) [m] of the drawn plan."""
    return np.vstack([step["path"] for step in picker._view.scene["steps"]])[:, :2]


def test_a_picked_goal_is_planned_for_drawn_and_reached(picker, world):
    picker.pick(0.05, 0.12)
    plan = picker.plan
    assert plan.goal.xy_m == drawn_goal(picker) == (0.05, 0.12)
    paths = np.vstack([step.predicted_path_xy_m for step in plan.steps])
    np.testing.assert_allclose(drawn_path(picker), paths, atol=1e-5)
    for drawn, step in zip(picker._view.scene["steps"], plan.steps, strict=True):
        assert drawn["direction"] == step.primitive.direction_rad
        assert (drawn["stop"], drawn["std"]) == (step.stop_phase, step.std_m)
        assert tuple(drawn["end"][:2]) == step.predicted_end_xy_m
    picker.run()
    outcome = picker.outcome
    assert outcome.distance_m == plan.goal.distance_m(world.object_pose()[:2])
    assert "mm</b> from the goal" in picker.controls.words.value
    assert not picker.controls.run.disabled
    np.testing.assert_allclose(picker._view.scene["trail"][-1], world.object_pose()[:2], atol=1e-3)
    picker.start_over()
    assert world.object_pose() == pytest.approx((0, 0, 0), abs=1e-12)
    plain = execute_plan(world, plan)  # has the picker's outcome
    assert outcome.end_pose == pytest.approx(plain.end_pose, abs=1e-12)
    for a, b in zip(outcome.object_paths_xy_m, plain.object_paths_xy_m, strict=True):
        np.testing.assert_array_equal(a, b)


def test_another_plan_and_full_actions_are_shown(make_picker):
    picker = make_picker(planners=CONTINUOUS | {"A*": plan_astar})
    picker.pick(0.08, 0.03)
    assert not picker._view.scene["other"]
    picker.controls.other.value = "A*"
    other = in_time(picker)._view.scene["other"]
    assert math.dist(other[-1]["end"][:2], (0.08, 0.03)) < 0.02
    assert f" By A*, dashed: {len(other)} actions" in picker.controls.said
    picker.controls.early.value = False
    scene = in_time(picker)._view.scene
    assert {step["stop"] for step in scene["steps"] + scene["other"]} == {1.0}
    picker.start_over()
    assert picker.plan.goal.xy_m == drawn_goal(picker) == (0.12, 0.0)


def luminance(colour):
    values = np.array([int(colour[k : k + 2], 16) for k in (1, 3, 5)]) / 255
    values = np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)
    return float(values @ (0.2126, 0.7152, 0.0722))


def test_lines_and_words_stand_out_from_the_table():
    styles = str(TableView._css).split("@media (prefers-color-scheme: dark)")
    assert len(styles) == 2
    for style in styles:
        colour = dict(re.findall(r"--([\w-]+): (#\w{6})", style))
        wanted = {"ink": 4.5, "goal": 3, "prediction": 3, "truth": 2.9, "object-rim": 3, "rim": 3}
        for name, least in wanted.items():
            for ground in ("ground", "reach"):
                pair = sorted(luminance(colour[one]) + 0.05 for one in (name, ground))
                assert pair[1] / pair[0] > least, (name, ground)


def test_what_the_hand_wants_is_planned_for_once(picker):
    planned_for = []
    picker.planners["A*"] = lambda p: planned_for.append(p.goal.xy_m) or plan_astar(p)
    for number, xy in enumerate([(0.081, 0.033), (0.081, 0.033), (-0.05, 0.1234)], 1):
        want(picker, *xy, number)
        assert in_time(picker)._view.scene["answered"] == number
    assert planned_for == [(0.081, 0.033), (0.081, 0.033), (-0.05, 0.123)]
    assert picker.plan.goal.xy_m == drawn_goal(picker) == (-0.05, 0.123)


def test_run_waits_for_the_plan_of_the_goal_that_is_shown(picker):
    """Two clicks and Run, faster than the planner: the plan of the second click is executed."""
    began = []

    def slow(problem):
        began.append(problem.goal.xy_m)
        time.sleep(0.3)
        return plan_astar(problem)

    picker.planners["A*"] = slow
    want(picker, 0.08, 0.03, 1)
    wait_until(lambda: began)
    want(picker, -0.09, 0.05, 2)
    assert picker._view.scene["planning"]
    picker.controls.run.click()
    picker.controls.run.click()  # a second press does nothing
    in_time(picker)
    assert began[-1] == picker.plan.goal.xy_m == picker.outcome.plan.goal.xy_m == (-0.09, 0.05)
    assert picker.outcome.distance_m == picker.goal.distance_m(picker.world.object_pose()[:2])
    assert "rests" in picker.controls.words.value
    assert not picker._view.scene["planning"]


def test_the_picker_shows_its_errors(picker):
    picker.controls.planner.value = "broken"
    assert "Error:</b> no &lt;plan&gt; today" in in_time(picker).controls.words.value
    assert picker._view.scene["steps"] == []
    with pytest.raises(ValueError, match="off the table"):
        picker.pick(5.0, 0.0)
    picker.controls.planner.value = "A*"
    assert in_time(picker).controls.words.value.count("Plan: ") == 1
    assert picker._view.scene["steps"]


def test_stop_lets_an_action_end_and_begins_no_other(make_picker, world):
    picker = make_picker(pace_s=1.0)
    picker.pick(0.24, 0.0)
    assert len(picker.plan.steps) > 1
    first = picker.plan.steps[0].predicted_end_xy_m
    picker.controls.run.click()
    wait_until(lambda: picker._n_done == 1)
    assert picker.controls.stop.disabled is False
    assert picker.controls.run.disabled
    with pytest.raises(RuntimeError, match="still moving"):
        picker.run()
    picker.shove_object()
    picker.controls.stop.click()
    said = in_time(picker).controls.said
    assert re.search(r"Stopped after 1 action:.* The object was shoved by \d\d mm. Plan: ", said)
    assert math.dist(world.object_pose()[:2], first) < 0.07
    assert not picker.controls.run.disabled
    picker.pick(*(0.05 + v for v in world.object_pose()[:2]))
    picker.pace_s = 0.0
    picker.run()
    assert picker.outcome.distance_m < 0.03, picker.controls.words.value


def test_a_run_can_be_watched_while_it_is_simulated(make_picker, monkeypatch):
    picker = make_picker(pace_s=0.001)
    sent, said = [], []
    picker.pick(0.24, 0.0)
    monkeypatch.setattr(picker._view, "send", lambda message: sent.append(message))
    picker.controls.words.observe(lambda change: said.append(change["new"]), names="value")
    before = time.monotonic()
    picker._view._handle_custom_msg({"press": "run"}, [])
    in_time(picker)
    n = len(picker.plan.steps)
    assert [f"Push {k} of {n} …" in words for k, words in enumerate(said[:-1], 1)] == [True] * n
    within = "within" if picker.outcome.distance_m <= 0.02 else "outside"
    assert f"<div class='outcome {within}'>Done, {n} actions" in said[-1]
    motions = np.vstack([message["motions"] for message in sent])
    assert [message["first"] for message in sent] == [True] + [False] * (len(sent) - 1)
    assert len(sent) > 10 * n  # as they come
    assert time.monotonic() - before >= 0.001 * len(motions)
    assert np.hypot(*np.diff(motions[:, :2], axis=0).T).max() < 0.03
    np.testing.assert_allclose(motions[-1, :3], picker.outcome.end_pose, atol=2e-3)
    np.testing.assert_allclose(picker._view.scene["trail"], motions[:, :2], atol=1e-4)
    tip = motions[:, 4:7]  # the hand comes from above, to where the object is
    assert tip[:, 2].max() > 0.1
    assert np.hypot(*(tip[:, :2] - motions[:, :2]).T).min() < 0.05
    assert picker.world.on_step is None


def test_a_goal_picked_while_an_open_loop_runs_is_planned_for_when_it_ends(make_picker, world):
    picker = make_picker()
    carry_out(picker, lambda plan: want(picker, -0.05, 0.1, 1) or picker._open_loop(plan))
    picker._view._handle_custom_msg({"press": "run"}, [])
    in_time(in_time(picker))
    assert picker.plan.goal.xy_m == drawn_goal(picker) == (-0.05, 0.1)
    assert picker.plan.start_xy_m == world.object_pose()[:2]
    assert "mm** from the goal" in picker.controls.said
    assert "Plan: push" in picker.controls.said
    assert not picker._view.scene["planning"]


def test_a_disturbance_waits_for_the_end_of_the_action(make_picker, world):
    """After the last action it is one of what rests."""
    seen = []

    def executor(plan):
        for when in ("before", "after"):
            at = world.object_pose()
            picker.shove_object()
            picker.move_goal()
            assert world.object_pose() == at
            if when == "before":
                picker._end_action()
                seen.extend((at, goal := picker.goal, world.object_pose()))
                problem = picker.skills.problem(world.depth_image(), seen[2][:2], goal)
                seen.append(picker._open_loop(picker._planned(problem)))
        return seen[3]

    picker = make_picker(seed=3)
    carry_out(picker, executor)
    first_goal = picker.plan.goal
    picker.run()
    before, goal, after, (paths, _) = seen
    assert 0.019 < math.dist(before[:2], after[:2]) < 0.041
    assert 0.039 < math.dist(first_goal.xy_m, goal.xy_m) < 0.081
    assert f"**{1000 * goal.distance_m(paths[-1][-1]):.1f} mm** from" in picker.controls.said
    assert math.dist(world.object_pose()[:2], paths[-1][-1]) > 0.015
    assert re.search("Done, .* was shoved by .* was moved by .* Plan: ", picker.controls.said)
    assert picker.plan.start_xy_m == world.object_pose()[:2]
    assert picker.plan.goal.xy_m == drawn_goal(picker) != goal.xy_m


@pytest.mark.slow
def test_a_closed_loop_replans_with_the_chosen_planner_for_a_goal_that_moves(make_picker):
    shown, picker = [], make_picker(seed=5)
    picker.controls.executor.value = "closed loop"
    picker.pick(0.2, 0.0)
    picker._view.observe(lambda change: shown.append(change["new"]), names="scene")
    picker._disturbances += [picker._move_goal, picker._shove]  # as if requested meanwhile
    picker.run()
    goal = picker.goal
    assert goal.xy_m in [scene["goal"]["xy"] for scene in shown]
    assert any(len(scene["marks"]) == 2 for scene in shown)
    assert picker.plan.goal.xy_m == goal.xy_m != (0.2, 0.0)
    assert picker.plan.planner == "astar"
    assert math.dist(drawn_path(picker)[-1], goal.xy_m) < 0.005
    assert picker.outcome.distance_m == goal.distance_m(picker.world.object_pose()[:2]) < 0.01


def test_after_a_failed_run_the_next_plan_is_from_where_it_ended(make_picker):
    def fails(plan):
        execute_plan(picker.world, replace(plan, steps=plan.steps[:1]))
        raise ValueError("the arm is stuck")

    picker = make_picker()
    carry_out(picker, fails)
    picker.pick(0.2, 0.0)
    with pytest.raises(ValueError, match="stuck"):
        picker.run()
    assert picker.plan is None
    carry_out(picker, picker._open_loop)
    picker.run()
    assert picker.outcome.distance_m < 0.03, picker.controls.words.value


def test_a_saved_picker_leaves_its_picture(picker):
    bundle, about = picker._repr_mimebundle_()
    picture = Image.open(io.BytesIO(base64.b64decode(bundle["image/png"])))
    assert picture.size[0] == 2 * about["image/png"]["width"]
    picker.pick(-0.1, 0.05)
    assert picker._repr_mimebundle_()[0]["image/png"] != bundle["image/png"]


@pytest.mark.parametrize(("executor", "within_deg"), [("open loop", 3.0), ("closed loop", 2.0)])
def test_turn_and_lift_are_planned_and_done(posed, world, executor, within_deg):
    posed.controls.executor.value = executor
    posed.pick(0.04, 0.03)
    posed.controls.turn.value, posed.controls.height.value = 25.0, 6.0
    goal = in_time(posed).plan.goal
    assert (math.degrees(goal.turn_rad), goal.height_m) == pytest.approx((25.0, 0.06))
    assert goal.xy_m == (0.04, 0.03)
    assert re.search("(?s)then rotate to .*then grasp to ", posed.controls.words.value)
    scene = posed._view.scene
    assert math.degrees(scene["goal"]["yaw"]) == pytest.approx(25.0)
    assert math.degrees(scene["steps"][-1]["end"][2]) == pytest.approx(25.0, abs=2.3)
    assert [step["name"] for step in scene["steps"]][-2:] == ["rotate", "grasp"]
    posed.run()
    said = posed.controls.words.value
    assert re.search("The orientation has an error of .* The height has an error of ", said)
    assert posed.outcome.lifted_m == pytest.approx(0.06, abs=0.005), said
    assert world.object_state()[2] == pytest.approx(0.025 + 0.06, abs=0.005), said
    assert math.degrees(world.object_pose()[2]) == pytest.approx(25.0, abs=within_deg), said
    posed.controls.turn.value = posed.controls.height.value = 0.0
    goal = in_time(posed).plan.goal
    assert (goal.turn_rad, goal.height_m, goal.xy_m) == (None, None, (0.04, 0.03))
    assert world.object_state()[2] < 0.05  # released, to be observed and planned for


def test_obstacles_of_the_page_are_planned_around_and_stand_on_the_table(posed, world):
    posed.pick(0.16, 0.0)
    straight = drawn_path(posed)
    block = {"corners": [[0.08, -0.02]], "radius": 0.02, "height": 0.06}
    posed._view.obstacles = [block]
    plan = in_time(posed).plan
    assert world.obstacles.all == (Obstacle.disc((0.08, -0.02), 0.02),)
    assert np.hypot(*(straight - (0.08, -0.02)).T).min() < 0.03
    assert np.hypot(*(drawn_path(posed) - (0.08, -0.02)).T).min() > 0.045
    assert plan.predicted_distance_m < 0.02
    posed.run()
    assert not world.obstacles.touched
    posed.start_over()
    assert len(world.obstacles.all) == 1
    posed._view.obstacles = [block | {"corners": [[0.0, 0.0]]}]  # on the object: refused
    assert "Error:</b> obstacles[0] lies on the object" in in_time(posed).controls.words.value
    assert posed._view.obstacles == [block]
    posed._view.obstacles = []
    assert in_time(posed).world.obstacles.all == ()


def test_the_robot_is_shown_in_3d_as_it_moved(make_picker, world):
    picker = make_picker()
    picker.pick(0.1, 0.06)
    scene, bodies = picker.scene, [*picker.scene.plot.objects]
    picker.run()
    assert scene.plot.objects == bodies, "drawn again, bodies stop the page for a second"
    shown = [list(body.model_matrix.values()) for body in scene.bodies]
    frames = np.swapaxes(shown, 0, 1)
    assert scene.player.max == 2 * (len(frames) - 1) > 100
    np.testing.assert_allclose(frames[-1, -1, :3, 3], world.object_state()[:3], atol=1e-3)
    assert np.ptp(frames[:, -1, :2, 3], axis=0).max() > 0.05  # the object
    assert np.ptp(frames[:, 5, :3, 3], axis=0).min() > 0.02  # the wrist
    tip = frames[:, 6, :3] @ (0, 0, 0.2, 1)  # between the fingers
    assert np.linalg.norm(tip - frames[:, -1, :3, 3], axis=1).min() < 0.06
    html = scene._repr_mimebundle_()["text/html"]
    assert len(html) < 600_000
    assert "<img alt=" in html
    picker.start_over()
    assert scene.player.max == 0
    assert type(scene.player).__mro__[1]().trait_metadata("value", "echo_update") is None
