import base64
import io

import matplotlib.pyplot as plt
import numpy as np
import pytest
from PIL import Image

from affordlib.planning import plan_astar
from affordlib.primitives import Push
from affordlib.show import (
    Film,
    GoalPicker,
    plot_footprint,
    plot_outcome,
    plot_table,
    show_animation,
)
from affordlib.world import Cuboid


@pytest.fixture
def picker(world, trained):
    world.place(Cuboid(0.06, 0.05, 0.05))

    def broken(*_):
        raise ValueError("no <plan> today")

    planners = {"A*": lambda *query: plan_astar(trained, *query), "broken": broken}
    return GoalPicker(world, planners, goal_xy_m=(0.12, 0.0))


def test_a_picked_goal_is_planned_for_and_reached(picker, world):
    first = picker._picture.value
    picker.pick(0.05, 0.12)
    assert picker.plan.goal.xy_m == (0.05, 0.12)
    assert picker._picture.value != first
    picker.run()
    assert picker.outcome.distance_m == pytest.approx(
        picker.plan.goal.distance_m(world.object_pose()[:2])
    )
    assert "mm</b> from the goal" in picker._words.value
    assert not picker._run.disabled


def test_the_picker_shows_its_errors(picker):
    picker._planner.value = "broken"
    assert "<b>ValueError</b>: no &lt;plan&gt; today" in picker._words.value
    with pytest.raises(ValueError, match="off the table"):
        picker.pick(5.0, 0.0)


def test_a_saved_picker_leaves_its_picture(picker):
    data = base64.b64decode(picker._repr_mimebundle_()["image/png"])
    assert Image.open(io.BytesIO(data)).size[0] > 300


def test_a_film_shows_the_robot_move(world, tmp_path):
    world.place(Cuboid(0.06, 0.05, 0.05))
    film = Film(every=240, width=80, height=60)
    with pytest.raises(RuntimeError, match="the film is empty"):
        film.gif()
    world.film = film
    try:
        world.interact(Push(1.0))
    finally:
        world.film = None
    assert len(film.frames) == 5
    assert np.abs(film.frames[0].astype(int) - film.frames[-1]).max() > 50
    figure, _ = plt.subplots(figsize=(2, 2))
    show_animation(film, tmp_path / "push.gif", beside=figure)
    plt.close(figure)
    saved = Image.open(tmp_path / "push.gif")
    assert saved.n_frames >= 4
    assert saved.size == (60 + 80, 60)


def test_a_footprint_is_drawn_where_the_object_is(picker):
    figure, ax = plt.subplots()
    plot_footprint(plot_table(ax), Cuboid(0.06, 0.04, 0.05), (0.1, -0.05), np.pi / 2)
    outline = ax.lines[-1].get_xydata()
    np.testing.assert_allclose(np.ptp(outline, axis=0), [4.0, 6.0], atol=1e-9)
    np.testing.assert_allclose(outline[:-1].mean(axis=0), [10.0, -5.0], atol=1e-9)
    picker.run()
    assert "mm from the goal" in plot_outcome(ax, picker.outcome).get_title(loc="left")
    plt.close(figure)
