"""The T of the field: its log, its picture, and a run in the environment where it is installed."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from affordlib.geometry import cross, wrap_angle
from affordlib.logs.cross_validate import errors_of
from affordlib.results import repo_root
from experiments import push_t


@pytest.fixture(scope="module")
def environment():
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SDL_VIDEODRIVER", "dummy")
        pytest.importorskip("gym_pusht", reason="make setup PUSHT=1 installs it")
        yield


def stored():
    """The shipped pushes, as arguments of `Log.add`."""
    for _, rows in pd.read_csv(repo_root() / "data" / "push_t" / "pushes.csv.xz").groupby("push"):
        poses, path = rows[["x", "y", "yaw"]].dropna(), rows[["tool_x", "tool_y"]]
        yield {"tool_t": rows["t"], "tool_xy": path, "poses": poses}


def test_the_shipped_pushes_are_read_and_predicted():
    data = push_t.logged(stored())
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


def test_the_model_of_the_agent_is_that_of_the_environment(environment):
    table = push_t.Table()
    table.reset(push_t.FIRST_CHOICE)
    agent, _ = table.look()
    table.go(np.stack([agent + np.array([30, -20]), agent]))
    np.testing.assert_allclose(table.look()[0], agent, atol=0.05)


def test_a_picture_gives_the_pose_of_the_t_and_the_agent(environment):
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
