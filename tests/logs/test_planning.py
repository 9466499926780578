"""Off-centre pushes of an object that is only seen, and the T of the field."""

import itertools
import math
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
import torch

from affordlib.geometry import centroid, cross, rotated, wrap_angle
from affordlib.logs import Log, PushedObject, PushPlanner
from affordlib.logs.cross_validate import errors_of
from affordlib.logs.fit import in_object_frame, known_feet, push_rows
from affordlib.logs.log import _nearest
from affordlib.logs.neural_process import load_neural_process
from affordlib.logs.planning import primitive_of
from affordlib.results import repo_root
from affordlib.types import Goal, UnreachableError
from affordlib.world import Cuboid
from affordlib.world.robot import ROD_WIDTH_M
from experiments import push_t, t_on_arm
from tests.planning.point_robot import Still

OUTLINE_M = np.array([[0.03, -0.02], [0.03, 0.02], [-0.03, 0.02], [-0.03, -0.02]])
TOOL_M = 0.0015
T_M = 1e-3 * np.array(push_t.T_PX)


def test_the_middle_of_the_tool_stays_its_radius_outside_and_what_no_object_has_is_refused():
    pushes = PushedObject(OUTLINE_M + 0.01, TOOL_M).draw(50)
    np.testing.assert_allclose(pushes.outline_m, OUTLINE_M, atol=1e-12)
    for k in range(50):
        primitive = primitive_of(pushes, k, 0.0)
        x, y = np.abs(primitive.contact)
        assert max(x - 0.03, y - 0.02) == pytest.approx(TOOL_M)
        ahead = np.array([math.cos(primitive.direction), math.sin(primitive.direction)])
        assert abs(cross(ahead, pushes.direction[k])) < 1e-9
        assert math.acos(ahead @ pushes.normal[k]) <= math.radians(50) + 1e-9
    with pytest.raises(ValueError, match="tool_radius_m must be a finite"):
        PushedObject(OUTLINE_M, tool_radius_m=math.nan)
    with pytest.raises(ValueError, match="lengths_m must be a range"):
        PushedObject(OUTLINE_M, lengths_m=(0.02, 0.01))
    with pytest.raises(ValueError, match="n must be a whole number in"):
        PushedObject(OUTLINE_M).draw(10**9)


class Pretrained:
    """The neural process before it has seen any push of the object."""

    network = load_neural_process()

    def predict(self, pushes):
        feet, none = known_feet(pushes)[0], torch.zeros(0, 10)
        predicted = self.network.predict(push_rows(pushes)[:, :7], none, feet)
        return in_object_frame(pushes, *predicted)


def test_pursuit_knows_only_what_it_observes(world, monkeypatch):
    """If the simulator reports a wrong yaw, the object still reaches its goal."""
    box = Cuboid(0.06, 0.05, 0.05)
    world.place(box, (0.02, 0.0), 0.4, tool="rod")
    outline = PushedObject(rotated(box.footprint_m, 0.4), ROD_WIDTH_M / 2)
    truth = world.object_pose
    monkeypatch.setattr(world, "object_pose", lambda: tuple(np.add(truth(), (0.0, 0.0, 1.0))))
    planner = PushPlanner(Pretrained(), outline, turn_m=t_on_arm.TURN_M)
    assert t_on_arm.bring(world, planner, (0.04, -0.01, 0.2)) <= 10
    x, y, yaw = truth()
    assert math.dist((x, y), (0.04, -0.01)) < 0.003
    assert abs(yaw - 0.6) < math.radians(3)


def test_a_plan_that_does_not_turn_misses_a_turn():
    planner = PushPlanner(Still(), PushedObject(OUTLINE_M))
    for turn_rad, reaches in ((None, True), (1.5, False)):
        goal = Goal((0.3, 0.3), turn_rad=turn_rad)
        assert planner.plan((0.3, 0.3, 0.0), goal, 1).reaches_goal == reaches


class Carried:
    """The object moves as the tool does after contact, and turns a little."""

    def predict(self, pushes):
        moved = pushes.length_m[:, None] * pushes.direction
        turn = 300 * cross(pushes.contact_m, moved)
        return np.column_stack([moved, turn]), np.full((len(pushes), 3), 1e-4)


def test_the_tool_retreats_and_goes_around_a_concave_object_without_contact():
    obj, rng = PushedObject(T_M, 0.015), np.random.default_rng(0)
    planner = PushPlanner(Carried(), obj, price=0.3, rounds=2)
    for _ in range(20):
        pose = (*rng.uniform(-0.1, 0.1, 2), rng.uniform(-3, 3))
        angle = rng.uniform(-3, 3)
        tool = tuple(np.add(pose[:2], 0.12 * np.array([math.cos(angle), math.sin(angle)])))
        goal = Goal((0.0, 0.0), turn_rad=wrap_angle(-pose[2]))
        push = planner.plan(pose, goal, 3, tool).steps[0].primitive
        way = planner.way(pose, tool, push)
        lines = itertools.pairwise([tool, *way[:-1]])
        fine = np.vstack([np.linspace(a, b, 60) for a, b in lines])
        assert _nearest(obj.outline_m, rotated(fine - pose[:2], -pose[2]))[0].min() > 0.015
        at_contact = rotated(np.array([push.contact]), -pose[2])
        assert _nearest(obj.outline_m, at_contact)[0] == pytest.approx(0.015, abs=1e-5)
    planner = PushPlanner(Carried(), obj)
    pose, touching = (0.0, 0.0, 0.0), (0.02, obj.outline_m[:, 1].min() - 0.015)
    push = planner.plan(pose, Goal((0.0, 0.1)), 1, touching).steps[0].primitive
    first = planner.way(pose, touching, push)[0]
    assert first[1] < touching[1] - 0.0039
    assert abs(first[0] - touching[0]) < 1e-3


def test_no_candidate_overlaps_the_object_and_walls_shut_pushes():
    obj = PushedObject(T_M, 0.015)
    pushes = obj.draw(400)
    assert 300 < len(pushes) < 400
    middle = pushes.contact_m - 0.015 * pushes.normal
    assert _nearest(obj.outline_m, middle)[0].min() > 0.015 - 1e-6
    room = (-0.2, -0.055), (0.2, 0.2)  # the bar lies along the wall
    planner = PushPlanner(Carried(), obj, room_m=room)
    shut = planner.shut((0.0, 0.0, 0.0), (0.15, 0.0))
    from_below = planner.library.normal[:, 1] > 0.9
    below = planner.library.contact_m[:, 1] < -0.04
    assert shut[from_below & below].all()
    assert not shut.all()
    walled = PushPlanner(Carried(), obj, room_m=((-0.01, -0.01), (0.01, 0.01)))
    with pytest.raises(UnreachableError, match="finds no way"):
        walled.plan((0.0, 0.0, 0.0), Goal((0.1, 0.0)), 1, (0.15, 0.0))


def test_refinement_reaches_the_goal_and_a_price_saves_pushes():
    obj, goal = PushedObject(OUTLINE_M, TOOL_M), Goal((0.05, 0.02), turn_rad=0.2)
    off, steps = [], []
    for price, rounds in ((0.0, 0), (0.0, 4), (0.9, 4)):
        planner = PushPlanner(Carried(), obj, price=price, rounds=rounds)
        plan = planner.plan((0.0, 0.0, 0.0), goal)
        end = plan.steps[-1]
        off.append(math.hypot(plan.predicted_distance_m, 0.02 * (end.predicted_turn_rad - 0.2)))
        steps.append(len(plan.steps))
    assert off[1] < 2e-4
    assert off[1] <= off[0] + 1e-6
    assert steps[2] < steps[1]


def test_the_arms_t_is_its_outline_and_its_pushes_are_read_by_the_log():
    block = t_on_arm.TBlock()
    corners = block.footprint_m
    area_m2 = cross(corners, np.roll(corners, -1, axis=0)).sum() / 2
    assert block.volume_m3 == pytest.approx(area_m2 * block.height)
    np.testing.assert_allclose(centroid(corners), 0.0, atol=1e-9)
    log = Log("m", corners, tool_radius=ROD_WIDTH_M / 2)
    assert (log.add_all(t_on_arm.collect(6, seed=3)), len(log.pushes())) == ({}, 6)


@pytest.fixture(scope="module")
def environment():
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SDL_VIDEODRIVER", "dummy")
        pytest.importorskip("gym_pusht", reason="make setup PUSHT=1 installs it")
        yield


def test_the_shipped_pushes_are_read_and_predicted():
    stored = []
    for _, rows in pd.read_csv(repo_root() / "data" / "push_t" / "pushes.csv.xz").groupby("push"):
        poses, path = rows[["x", "y", "yaw"]].dropna(), rows[["tool_x", "tool_y"]]
        stored.append({"tool_t": rows["t"], "tool_xy": path, "poses": poses})
    data = push_t.logged(stored)
    assert len(data) == 200
    trained = np.arange(200) < 150
    errors = errors_of(data, trained, ~trained, ("nearest", "rate_gp")).groupby("model")
    median = 1e3 * errors["position_m"].median()
    assert median["rate_gp"] < 0.3 < 1 < median["nearest"]


def test_the_agent_comes_to_rest_at_its_target_on_a_line():
    a, b = push_t.motion()
    for point, at, within in (((300, 200), (250, 260), 1e-6), ((400, 420), (60, 55), 2.0)):
        point, at = np.array(point, dtype=float), np.array(at, dtype=float)
        state = np.stack([at, np.zeros(2)])
        for target in push_t.targets_to(point, at):
            assert (target >= 0).all()
            assert (target <= 512).all()
            state = a @ state + np.outer(b, target)
        np.testing.assert_allclose(state[0], point, atol=within)
        np.testing.assert_allclose(state[1], 0, atol=10 * within)
        assert abs(cross(state[0] - at, point - at)) < 1e-6


def test_the_model_of_the_agent_and_what_a_picture_gives_are_those_of_the_environment(environment):
    table = push_t.Table()
    table.reset(push_t.FIRST_CHOICE)
    agent, _ = table.look()
    table.go(np.stack([agent + np.array([30, -20]), agent]))
    np.testing.assert_allclose(table.look()[0], agent, atol=0.05)
    table = push_t.Table("picture")
    for seed in range(push_t.FIRST_CHOICE, push_t.FIRST_CHOICE + 5):
        table.reset(seed)
        agent, (x, y, yaw) = push_t.read_picture(table.seen)
        assert np.hypot(*np.subtract((x, y), table.truth[:2])) < 2
        assert abs(wrap_angle(yaw - table.truth[2])) < np.radians(1.5)
        assert np.hypot(*np.subtract(agent, table.history[-1][0])) < 1.5


def test_pushes_are_the_same_for_a_seed_and_move_the_t(environment):
    one, again = (push_t.logged(push_t.collect(6, 1)) for _ in range(2))
    np.testing.assert_array_equal(one.displacement_m, again.displacement_m)
    assert np.linalg.norm(one.displacement_m, axis=1).max() > 0.002


@pytest.mark.slow
def test_forty_pushes_solve_the_t(environment):
    row, took = replace(push_t.ROWS["gp_50"], n=40), []
    for seed in range(push_t.FIRST_CHOICE, push_t.FIRST_CHOICE + 3):
        run = push_t.attempt(push_t.Table(), push_t.planner_of(row, 0), 3, seed)
        took += [] if run["steps_a"] is None else [run["steps_a"]]
    assert len(took) >= 2
    assert max(took) <= push_t.MOST_STEPS
