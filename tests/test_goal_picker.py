import asyncio
import base64
import io
import math
import time
from dataclasses import replace

import matplotlib.pyplot as plt
import numpy as np
import pytest
from PIL import Image

from affordlib.interactions import open_interactions
from affordlib.plan_files import load_plan
from affordlib.planning import Skills, execute_plan, plan_astar
from affordlib.show import GoalPicker
from affordlib.show.executors import closed_loop, open_loop
from affordlib.show.plots import plot_plan
from affordlib.show.table_view import TableView
from affordlib.world import BASE_X_M, REACH_M, Cuboid
from tests.problems import problem_of


@pytest.fixture
def asked_of_planner():
    return []


@pytest.fixture
def make_picker(world, trained, asked_of_planner, tmp_path):
    world.place(Cuboid(0.06, 0.05, 0.05))

    def astar(*query):
        asked_of_planner.append(query[2].xy_m)
        return plan_astar(problem_of(trained, *query))

    def broken(*_):
        raise ValueError("no <plan> today")

    def make(**options):
        options = {"folder": str(tmp_path), "seconds_per_action": 0.0} | options
        return GoalPicker(world, {"A*": astar, "broken": broken}, goal_xy_m=(0.12, 0.0), **options)

    return make


@pytest.fixture
def picker(make_picker):
    return make_picker()


def wait_until(condition, seconds=20.0):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.005)


def test_a_picked_goal_is_planned_for_drawn_and_reached(picker, world):
    picker.pick(0.05, 0.12)
    assert picker.plan.goal.xy_m == (0.05, 0.12)
    scene = picker._view.scene
    assert scene["goal"]["xy"] == [0.05, 0.12]
    assert len(scene["steps"]) == len(picker.plan.steps) > 0
    for drawn, step in zip(scene["steps"], picker.plan.steps, strict=True):
        np.testing.assert_allclose(drawn["path"], step.predicted_path_xy_m, atol=1e-5)
        assert drawn["direction"] == step.primitive.direction_rad
        assert f"push to {100 * step.stop_phase:.0f} %" in drawn["label"]
    picker.run()
    assert picker.outcome.distance_m == pytest.approx(
        picker.plan.goal.distance_m(world.object_pose()[:2])
    )
    assert "mm</b> from the goal" in picker.controls.words.value
    assert not picker.controls.run.disabled
    truth = np.vstack(picker._view.scene["truth"])
    np.testing.assert_allclose(truth[-1], world.object_pose()[:2], atol=1e-3)
    np.testing.assert_allclose(picker._view.scene["object"]["pose"], world.object_pose(), atol=1e-5)


def test_the_picker_carries_out_what_a_plain_call_would(picker, world):
    plan = picker.plan
    picker.run()
    seen = picker.outcome
    picker.start_over()
    assert world.object_pose() == pytest.approx((0, 0, 0), abs=1e-12)
    plain = execute_plan(world, plan)
    assert seen.end_pose == plain.end_pose
    assert seen.distance_m == plain.distance_m
    for a, b in zip(seen.object_paths_xy_m, plain.object_paths_xy_m, strict=True):
        np.testing.assert_array_equal(a, b)


def test_what_the_view_asks_is_answered_once(picker, asked_of_planner):
    before = len(asked_of_planner)
    for number, xy in enumerate([(0.081, 0.033), (0.081, 0.033), (-0.05, 0.1234)], 1):
        picker._view.asked = [*xy, number]
        assert picker._view.scene["answered"] == number
    wanted = [(0.081, 0.033), (0.081, 0.033), (-0.05, 0.123)]
    assert asked_of_planner[before:] == wanted  # once each: no slider has echoed
    assert (picker.controls.x.value, picker.controls.y.value) == (-5.0, 12.3)
    assert picker.plan.goal.xy_m == (-0.05, 0.123)


def test_a_draft_until_the_hand_rests(make_picker, asked_of_planner, trained):
    drafts = []

    def draft(*query):
        drafts.append(query[2].xy_m)
        return replace(plan_astar(problem_of(trained, *query)), planner="draft")

    picker = make_picker(draft=draft)
    assert (picker.plan.planner, drafts) == ("astar", [])  # nobody is in a hurry

    async def heard():
        while not picker._queue.last.done():
            await asyncio.sleep(0.005)

    async def hand():
        asked_of_planner.clear()
        for number, xy in enumerate([(0.08, 0.03), (0.09, 0.03), (0.10, 0.03)], 1):
            picker._view.asked = [*xy, number]
            await heard()
            assert picker.plan.planner == "draft"
            assert picker._view.scene["draft"]
            assert picker._view.scene["answered"] == number
        assert asked_of_planner == []
        await asyncio.sleep(0.5)
        assert picker.plan.planner == "astar"
        assert asked_of_planner == [(0.10, 0.03)]  # once, where the hand came to rest
        assert not picker._view.scene["draft"]
        picker.controls.x.value = 7.0
        await heard()
        assert (picker.plan.planner, len(drafts)) == ("draft", 4)
        picker.run()  # what is carried out is the plan
        assert picker.plan.planner == picker.outcome.plan.planner == "astar"
        picker.controls.x.value = 8.0
        picker.save()
        assert load_plan(f"{picker.folder}/plan.json").planner == "astar"
        picker.controls.x.value = 9.0
        picker.load()
        await asyncio.sleep(0.2)
        assert picker._goal.xy_m[0] == 0.08  # no plan for a goal that was left comes late

    asyncio.run(hand())


def test_run_waits_for_the_plan_of_the_goal_that_is_shown(make_picker, trained):
    """Two clicks and Run, faster than the planner: what runs is the plan of the second."""
    began = []

    def slow(*query):
        began.append(query[2].xy_m)
        time.sleep(0.3)
        return plan_astar(problem_of(trained, *query))

    picker = make_picker(draft=lambda *query: plan_astar(problem_of(trained, *query)))
    picker.planners["A*"] = slow

    async def hand():
        picker._view.asked = [0.08, 0.03, 1]
        await asyncio.sleep(0.15)
        picker._view.asked = [-0.09, 0.05, 2]
        assert picker._view.scene["planning"]
        picker.controls.run.click()
        picker.controls.run.click()  # a second press does nothing
        while picker.outcome is None or picker._running:
            await asyncio.sleep(0.02)

    asyncio.run(hand())
    assert began[-1] == picker.plan.goal.xy_m == picker.outcome.plan.goal.xy_m == (-0.09, 0.05)
    assert picker.outcome.distance_m == picker._goal.distance_m(picker.world.object_pose()[:2])
    assert "rests" in picker.controls.words.value
    assert not picker._view.scene["planning"]


@pytest.mark.parametrize("name", ["../x.json", "/tmp/x.json", "sub/y.json", "", ".", "..\\x"])
def test_plans_stay_in_their_folder(picker, tmp_path, name):
    for act in (picker.save, picker.load):
        with pytest.raises(ValueError, match="plain file name"):
            act(name)
    picker.controls.name.value = "nosuch.json"
    picker.controls.load.click()
    assert "there is no plan " in picker.controls.words.value


def test_sliders_pick(picker, asked_of_planner):
    picker.controls.x.value = 7.7
    picker.controls.y.value = -4.0
    assert asked_of_planner[-2:] == [(0.077, 0.0), (0.077, -0.04)]
    assert picker._view.scene["goal"]["xy"] == [0.077, -0.04]


def test_the_picker_shows_its_errors(picker):
    picker.controls.planner.value = "broken"
    assert "did not work:</b> no &lt;plan&gt; today" in picker.controls.words.value
    assert picker._view.scene["steps"] == []
    with pytest.raises(ValueError, match="off the table"):
        picker.pick(5.0, 0.0)
    with pytest.raises(RuntimeError, match="no plan to save"):
        picker.save()
    picker.controls.planner.value = "A*"
    assert picker.controls.words.value.count("Plan: ") == 1
    picker._view.asked = [0.1, 0.0, 1]
    assert picker._view.scene["steps"]


def test_stop_lets_an_action_end_and_begins_no_other(make_picker, world):
    picker = make_picker(seconds_per_action=30.0)
    picker.pick(0.24, 0.0)
    assert len(picker.plan.steps) > 1
    picker.controls.run.click()
    wait_until(lambda: picker.controls.progress.value == 1)
    assert picker.controls.stop.disabled is False
    assert picker.controls.run.disabled
    with pytest.raises(RuntimeError, match="still at work"):
        picker.run()
    picker.controls.stop.click()
    wait_until(lambda: picker._queue.last.done())
    assert "Stopped after 1 action:" in picker.controls.words.value
    first = picker.plan.steps[0].predicted_end_xy_m
    assert math.dist(world.object_pose()[:2], first) < 0.03
    assert not picker.controls.run.disabled


def test_a_run_is_filmed_at_the_pace_of_the_eye(make_picker):
    picker = make_picker(seconds_per_action=0.2)
    films = []
    picker._view.observe(lambda change: films.append(change["new"]), names="film")
    picker._view._handle_custom_msg({"press": "run"}, [])
    wait_until(lambda: picker._queue.last.done())
    assert [film["seconds"] for film in films] == [0.2] * len(picker.plan.steps)
    poses = np.vstack([film["poses"] for film in films])
    assert len(poses) > 20
    assert np.hypot(*np.diff(poses[:, :2], axis=0).T).max() < 0.03
    np.testing.assert_allclose(poses[-1, :2], picker.outcome.end_pose[:2], atol=1e-3)
    assert picker.world.on_step is None


def test_a_disturbance_waits_for_the_end_of_the_action(make_picker, world):
    seen = []

    def executor(world, plan, planner, tell):
        before = world.object_pose()
        picker.shove_object()
        picker.move_goal()
        assert world.object_pose() == before
        goal = tell()
        seen.append((before, world.object_pose(), goal))
        return open_loop(
            world, planner(world.depth_image(), world.object_pose()[:2], goal), planner, tell
        )

    picker = make_picker(executors={"mine": executor}, seed=3)
    first_goal = picker.plan.goal
    picker.run()
    (before, after, goal) = seen[0]
    assert 0.019 < math.dist(before[:2], after[:2]) < 0.041
    assert 0.039 < math.dist(first_goal.xy_m, goal.xy_m) < 0.081
    assert picker._view.scene["goal"]["xy"] == list(goal.xy_m)
    assert picker.outcome.distance_m == pytest.approx(goal.distance_m(world.object_pose()[:2]))


@pytest.mark.slow
def test_a_closed_loop_notices_what_an_open_loop_does_not(make_picker, trained):
    executors = {"open loop": open_loop, "closed loop": closed_loop(Skills({"push": trained}))}
    off_m = {}
    for name in executors:
        picker = make_picker(executors=executors, seconds_per_action=1.0, seed=5)
        picker.controls.executor.value = name
        picker.pick(0.2, 0.0)
        picker.controls.run.click()
        wait_until(lambda picker=picker: picker.controls.progress.value == 1)
        picker.controls.move_goal.click()
        picker.controls.shove.click()
        wait_until(lambda picker=picker: picker._queue.last.done())
        assert picker.outcome.distance_m == pytest.approx(
            picker._goal.distance_m(picker.world.object_pose()[:2])
        )
        off_m[name] = picker.outcome.distance_m
        picker.start_over()
    assert off_m["closed loop"] < 0.01 < 0.03 < off_m["open loop"]


def test_disturbances_are_seeded_and_planned_for(make_picker, world):
    ends = []
    for seed in (1, 1, 2):
        picker = make_picker(seed=seed)
        picker.controls.shove.click()
        ends.append(world.object_pose())
        assert picker.plan.start_xy_m == ends[-1][:2]
        picker.controls.move_goal.click()
        assert picker.plan.goal.xy_m != (0.12, 0.0)
        picker.controls.start_over.click()
        assert picker.plan.start_xy_m == pytest.approx((0.0, 0.0), abs=1e-12)
    assert ends[0] == ends[1] != ends[2]


def test_a_saved_picker_leaves_its_picture(picker):
    data = base64.b64decode(picker._repr_mimebundle_()["image/png"])
    assert Image.open(io.BytesIO(data)).size[0] > 300


def test_the_view_carries_all_it_draws_with():
    source = TableView._esm if isinstance(TableView._esm, str) else str(TableView._esm)
    style = TableView._css if isinstance(TableView._css, str) else str(TableView._css)
    assert "export default { render }" in source
    assert "://" not in source.replace('"http://www.w3.org/2000/svg"', "") + style


# Plans as files


def test_a_plan_comes_back_from_its_file(picker, world, tmp_path):
    picker.pick(0.1, 0.15)
    plan = picker.plan
    picker.save("mine.json")
    picker.pick(0.0, -0.1)
    picker.load("mine.json")
    assert picker._goal == plan.goal
    assert picker.controls.x.value == 10.0
    back = picker.plan
    assert replace(back, steps=()) == replace(plan, steps=())
    for a, b in zip(back.steps, plan.steps, strict=True):
        assert (a.primitive, a.stop_phase, a.std_m) == (b.primitive, b.stop_phase, b.std_m)
        np.testing.assert_array_equal(a.predicted_path_xy_m, b.predicted_path_xy_m)
    picker.run()
    assert "mm</b> from the goal" in picker.controls.words.value
    picker.load("mine.json")
    assert "from where this plan starts" in picker.controls.words.value


def test_a_file_without_a_plan_is_refused(picker, tmp_path):
    (tmp_path / "bad.json").write_text("{")
    with pytest.raises(ValueError, match="holds no plan"):
        picker.load("bad.json")


# What is drawn as being in reach


def test_the_ring_is_where_the_arm_can_push_from(world):
    data = open_interactions("reach")
    pushes = data["primitive"].values == 0
    xy = data["believed_xy"].values[pushes]
    theta = data["theta"].values[pushes]
    along = np.linspace(0.2, -0.05, 6)[:, None, None]
    places = xy + along * np.column_stack([np.cos(theta), np.sin(theta)])
    far = np.hypot(places[..., 0] - BASE_X_M, places[..., 1])
    inside = ((REACH_M[0] <= far) & (far <= REACH_M[1])).all(axis=0)
    reached = data["reached"].values[pushes].astype(bool)
    assert (inside == reached).mean() > 0.93
    assert reached[inside].mean() > 0.97


def test_a_closed_loop_shows_the_plans_it_makes_on_the_way(make_picker, trained):
    skills, shown = Skills({"push": trained}), []
    picker = make_picker(executors={"closed loop": closed_loop(skills)}, seed=3)
    picker.planners["A*"] = skills.planner(plan_astar)
    picker.pick(0.2, 0.0)
    first = picker._view.scene["steps"]
    picker._view.observe(lambda change: shown.append(change["new"]), names="scene")
    picker._waiting.append(picker._move_goal)  # as if asked for while it works
    picker.run()
    goal = picker._goal
    planned_for = {tuple(scene["goal"]["xy"]) for scene in shown if scene["steps"] != first}
    assert goal.xy_m in planned_for
    assert picker.plan.goal.xy_m == goal.xy_m != (0.2, 0.0)
    assert picker.plan.planner == "astar"  # as the reader chose
    end = np.array(picker._view.scene["steps"][-1]["end"])
    assert np.hypot(*(end - goal.xy_m)) < 0.005  # what is drawn leads to where the goal is now
    assert picker.outcome.distance_m < 0.01


def test_a_planner_that_cannot_be_told_of_the_arm_gives_way_and_it_is_said(make_picker, trained):
    picker = make_picker(executors={"closed loop": closed_loop(Skills({"push": trained}))})
    picker.run()
    assert picker.plan.planner == "continuous"
    assert "planned anew by continuous search" in picker.controls.words.value


def test_sigma_is_drawn_so_that_it_can_be_seen(picker):
    for drawn, step in zip(picker._view.scene["steps"], picker.plan.steps, strict=True):
        assert drawn["disc"] == pytest.approx(20 * step.std_m, abs=1e-5)
    figure, ax = plt.subplots()
    plot_plan(ax, picker.plan)
    discs = [p.get_radius() for p in ax.patches if p.get_facecolor()[3] not in (0, 1)]
    assert discs == pytest.approx([100 * 20 * step.std_m for step in picker.plan.steps])
    plt.close(figure)


def test_after_a_failed_run_the_next_plan_is_from_where_it_broke_off(make_picker, world):
    def fails(world, plan, planner, tell):
        execute_plan(world, replace(plan, steps=plan.steps[:1]))
        raise ValueError("the arm is stuck")

    picker = make_picker(executors={"fails": fails, "open loop": open_loop})
    picker.pick(0.2, 0.0)
    with pytest.raises(ValueError, match="stuck"):
        picker.run()
    assert picker.plan is None
    picker.controls.executor.value = "open loop"
    picker.run()
    assert picker.outcome.distance_m < 0.03, picker.controls.words.value


def test_what_waits_when_the_robot_stops_does_not_wait_for_the_next_run(make_picker, world):
    picker = make_picker(seconds_per_action=30.0)
    picker.controls.run.click()
    wait_until(lambda: picker.controls.progress.value == 1)
    picker.shove_object()
    picker.stop()
    wait_until(lambda: picker._queue.last.done())
    picker.seconds_per_action = 0.0
    picker.pick(*(0.05 + v for v in world.object_pose()[:2]))
    picker.run()
    assert picker.outcome.distance_m < 0.03, picker.controls.words.value


def test_a_slider_moves_what_it_is_for_and_nothing_else(make_picker):
    picker = make_picker()
    picker.pick(0.45, 0.1)
    picker.controls.y.value = 12.0
    assert picker._goal.xy_m == (0.45, 0.12)
    picker._set_goal(replace(picker._goal, turn_rad=math.radians(120)))
    assert picker.controls.turn.value == 90  # all that it can show
    picker._posed({"owner": picker.controls.height, "new": 3.0})
    assert math.degrees(picker._goal.turn_rad) == pytest.approx(120)
    assert picker._goal.height_m == pytest.approx(0.03)
