"""Plans carried out as they are, corrected in the end, and an eye that touch calibrates."""

import math

import numpy as np
import pytest

from affordlib.models import load_checkpoint
from affordlib.planning import PlanMode, carry_out, plan_astar, plan_continuous
from affordlib.planning.touch import Touch
from affordlib.primitives import Push
from affordlib.types import Goal, Plan, Step
from affordlib.world import Cuboid, WorldConfig

BOX = Cuboid(0.06, 0.05, 0.05)


def test_corrections_bring_it_nearer(world, film):
    """A coarse plan, corrected by a fine planner, at most twice, and never for nothing."""
    world.place(BOX, (0.0, 0.0), 0.3)
    goal = Goal((0.1, 0.04))
    asked = []

    def replan(image, xy, goal):
        asked.append(goal.tolerance_m)
        return plan_continuous(film, image, xy, goal, "single_partial")

    plan = plan_astar(film, world.look(), (0.0, 0.0), goal)
    open_loop = carry_out(world, plan)
    world.place(BOX, (0.0, 0.0), 0.3)
    closed = carry_out(world, plan, 2, replan)
    assert closed.distance_m < open_loop.distance_m
    assert len(plan.steps) < len(closed.object_paths_xy_m) <= len(plan.steps) + 2
    assert set(asked) == {0.0003}
    again = carry_out(world, Plan(goal, goal.xy_m, (), "none", True, 0, 0.0), 2, replan, 0.05)
    assert again.object_paths_xy_m == ()
    with pytest.raises(ValueError, match="need a planner"):
        carry_out(world, plan, 1)


def _step(direction_rad, length_m=0.05):
    """A push foreseen to take its object so far."""
    ahead = length_m * np.array([math.cos(direction_rad), math.sin(direction_rad)])
    return Step(Push.towards(direction_rad), 1.0, tuple(ahead), np.array([(0.0, 0.0), ahead]))


def test_touch_learns_the_bias_along_each_push():
    """What ends, along the push, where it was foreseen is seen beside that by the bias."""
    bias, touch = np.array([0.0015, -0.001]), Touch(felt_m=1e-6)
    for direction in (0.4, 0.4 + math.pi / 2):
        before = touch.covariance_m2.copy()
        along = np.array([math.cos(direction), math.sin(direction)])
        left = bias - touch.mean_m
        step = _step(direction)
        touch.feel(step, (0.0, 0.0), step.predicted_end_xy_m + (along @ left) * along)
        assert along @ touch.mean_m == pytest.approx(along @ bias, abs=1e-6)
        assert along @ touch.covariance_m2 @ along < 1e-6 * (along @ before @ along)
    np.testing.assert_allclose(touch.mean_m, bias, atol=1e-6)


def test_doubt_leaves_touch_unmoved():
    touch = Touch(felt_m=1.0)
    touch.feel(_step(0.0), (0.0, 0.0), (0.06, 0.0))
    assert np.abs(touch.mean_m).max() < 1e-7


def test_pushed_objects_tell_how_far_off_the_eye_is(world):
    """The bias along a push is felt, the one across it is not; each episode starts anew."""
    model, rng = load_checkpoint("push_film_varied")[0], np.random.default_rng(0)
    told = []
    for k in range(8):
        bias = rng.normal(0, 0.002, size=2)
        config = WorldConfig(camera="kinect", bias_m=tuple(bias), noise_seed=k)
        world.place(Cuboid(*rng.uniform(0.04, 0.08, 3)), yaw_rad=rng.uniform(-3, 3), config=config)
        assert world.eye_off_m == (0.0, 0.0)
        seen, angle = world.perceive(), rng.uniform(-math.pi, math.pi)
        goal = Goal(tuple(seen.xy_m + 0.06 * np.array([math.cos(angle), math.sin(angle)])))
        plan = plan_continuous(model, seen.image, seen.xy_m, goal, PlanMode(1, partial=True))
        touch = Touch(bias_m=1.0)
        carry_out(world, plan, touch=touch)
        assert world.eye_off_m == tuple(touch.mean_m)
        angle = plan.steps[0].primitive.direction_rad
        along = np.array([math.cos(angle), math.sin(angle)])
        told.append((along @ bias, along @ touch.mean_m))
        assert abs(along[0] * touch.mean_m[1] - along[1] * touch.mean_m[0]) < 1e-9
    world.place(BOX, config=WorldConfig())
    assert np.corrcoef(np.transpose(told))[0, 1] > 0.8


def test_many_looks_see_better(world):
    """Of eight looks the mean scatters by a factor of √8 less; the image is one of them."""
    scatter = []
    try:
        for world.looks in (1, 8):
            world.place(BOX, (0.1, 0.1), 0.4, config=WorldConfig(camera="kinect"))
            scatter.append(np.std([world.perceive().xy_m for _ in range(40)], axis=0).mean())
    finally:
        world.looks = 1
        world.place(BOX, config=WorldConfig())
    assert 2 < scatter[0] / scatter[1] < 4
