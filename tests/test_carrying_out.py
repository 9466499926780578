"""Plans carried out as they are and corrected in the end, and an eye that looks many times."""

import math
from dataclasses import replace

import numpy as np
import pytest

from affordlib.evaluation.tasks import frozen_tasks
from affordlib.planning import execute_plan, plan_astar, plan_continuous, run_closed_loop
from affordlib.primitives import Grasp, Push
from affordlib.types import Goal, Plan, Step, UnreachableError
from affordlib.world import Cuboid, WorldConfig
from experiments.closed_loop import draw_trial
from experiments.planning import attempt
from tests.problems import problem_of

BOX = Cuboid(0.06, 0.05, 0.05)


def test_corrections_bring_it_nearer(world, film):
    """A coarse plan, corrected by a fine planner, at most twice, and never for nothing."""
    world.place(BOX, (0.0, 0.0), 0.3)
    goal = Goal((0.1, 0.04))
    asked = []

    def replan(image, xy, goal):
        asked.append(goal.tolerance_m)
        return plan_continuous(problem_of(film, image, xy, goal, "single_partial"))

    plan = plan_astar(problem_of(film, world.depth_image(), (0.0, 0.0), goal))
    open_loop = execute_plan(world, plan)
    world.place(BOX, (0.0, 0.0), 0.3)
    closed = execute_plan(world, plan, 2, replan)
    assert closed.distance_m < open_loop.distance_m
    assert len(plan.steps) < len(closed.object_paths_xy_m) <= len(plan.steps) + 2
    assert set(asked) == {0.0003}
    again = execute_plan(world, Plan(goal, goal.xy_m, (), "none", True, 0, 0.0), 2, replan, 0.05)
    assert again.object_paths_xy_m == ()
    with pytest.raises(ValueError, match="need a planner"):
        execute_plan(world, plan, 1)


@pytest.mark.slow
def test_many_looks_see_better(world):
    """Of eight looks the mean scatters by a factor of √8 less; the image is one of them."""
    scatter = []
    for world.n_averaged_images in (1, 8):
        world.place(BOX, (0.1, 0.1), 0.4, config=WorldConfig(camera="kinect"))
        scatter.append(np.std([world.observe().xy_m for _ in range(40)], axis=0).mean())
    assert 2 < scatter[0] / scatter[1] < 4


def test_an_attempt_leaves_the_eye_as_it_was(world, film):
    task = next(t for t in frozen_tasks("perturbed") if t.mode == "single_full")
    seen = []

    def planner(image, xy, goal, mode):
        seen.append(world.n_averaged_images)
        return plan_continuous(problem_of(film, image, xy, goal, mode))

    attempt(world, task, planner, n_averaged_images=3)
    assert (seen, world.n_averaged_images) == ([3], 1)


def test_what_is_held_is_not_corrected(world, skills):
    world.place(Cuboid(0.06, 0.05, 0.05))
    planner = skills.planner(plan_continuous)
    plan = planner(world.depth_image(), (0.0, 0.0), Goal((0.05, 0.0), height_m=0.12))
    assert plan.steps[-1].primitive.holds
    done = execute_plan(world, plan, 2, planner)
    assert len(done.object_paths_xy_m) == len(plan.steps)
    assert done.lifted_m == pytest.approx(0.12, abs=0.01)


def test_where_nothing_brings_it_nearer_it_stays(film, cuboid_image):
    near = Goal((0.015, 0.0), tolerance_m=0.02)
    plan = plan_continuous(problem_of(film, cuboid_image, (0.0, 0.0), near, "single_full"))
    assert (plan.steps, plan.reaches_goal) == ((), True)
    far = plan_continuous(
        problem_of(film, cuboid_image, (0.0, 0.0), Goal((0.08, 0.0)), "single_full")
    )
    assert len(far.steps) == 1


def test_settings_of_a_planner_are_passed_on(skills, cuboid_image):
    asked = []

    def spy(problem, seed):
        asked.append((seed, problem.mode.max_steps))
        return plan_continuous(problem, seed)

    planner = skills.planner(spy, seed=7, mode="single_partial")
    planner(cuboid_image, (0.0, 0.0), Goal((0.05, 0.0)))
    assert asked == [(7, 1)]


def test_what_a_lift_has_shifted_is_put_down_and_lifted_again(world, skills, monkeypatch):
    """The closing fingers turn the box, and shift it by some 5 mm; the second time they do not."""
    monkeypatch.setattr("affordlib.planning.closed_loop.SHIFTED_M", 0.003)
    trial = draw_trial("height", 12, seed=3)
    world.place(trial.obj, trial.start_xy_m, trial.yaw_rad)
    went = run_closed_loop(world, replace(trial.goal, tolerance_m=0.002), skills)
    kinds = [type(step.primitive) for step in went.steps]
    assert went.reached, went.message
    assert kinds.count(Grasp) == 2
    assert kinds[kinds.index(Grasp) + 1] is Push


def test_what_was_done_before_the_arm_refused_is_kept(world, monkeypatch):
    world.place(BOX, (0.0, 0.0))
    can = Step(Push(math.pi), 1.0, (0.05, 0.0), np.zeros((2, 2)))
    cannot = Step(Grasp(), 1.0, (0.05, 0.0), np.zeros((2, 2)))
    plan = Plan(Goal((0.1, 0.0)), (0.0, 0.0), (can, can, cannot), "by hand", True, 0, 0.0)
    follow = world.execute

    def follow_pushes(step):
        if step is can:
            return follow(step)
        raise UnreachableError("out of reach")

    monkeypatch.setattr(world, "execute", follow_pushes)
    with pytest.raises(UnreachableError) as refused:
        execute_plan(world, plan)
    outcome = refused.value.outcome
    assert len(outcome.object_paths_xy_m) == 2
    assert math.hypot(*outcome.end_pose[:2]) > 0.05
    assert outcome.end_pose == world.object_pose()
    assert outcome.distance_m == plan.goal.distance_m(outcome.end_pose[:2])
