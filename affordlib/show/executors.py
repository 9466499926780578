"""Execution of a plan in a widget, where a user can stop it, disturb it, or move its goal."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from affordlib.planning import ClosedLoopConfig, Planner, Skills, execute_plan, run_closed_loop
from affordlib.types import Goal, Outcome, Plan
from affordlib.world import Tabletop

Report = Callable[..., Goal]
"""`report()` after an action applies pending disturbances, and raises `Stopped` when execution must
end; `report(plan)` when a new plan replaces the current one. Both return the current goal."""

Executor = Callable[[Tabletop, Plan, Planner, Report], Outcome]
"""Function that executes a plan; the caller measures the object's rotation and height."""


class Stopped(Exception):
    """The user has pressed Stop."""


def open_loop(world: Tabletop, plan: Plan, planner: Planner, report: Report) -> Outcome:
    """Execute a plan as it is, action by action, and measure where the object comes to rest."""
    paths: tuple[np.ndarray, ...] = ()
    for step in plan.steps:
        paths += execute_plan(world, replace(plan, steps=(step,))).object_paths_xy_m
        report()
    return measured(world, plan, paths)


def measured(
    world: Tabletop, plan: Plan, paths_xy_m: tuple[np.ndarray, ...] = (), words: str = ""
) -> Outcome:
    """The outcome of a plan, measured from the object's true pose."""
    pose = world.object_pose()
    return Outcome(plan, plan.goal.distance_m(pose[:2]), pose, paths_xy_m, words=words)


def closed_loop(skills: Skills, tolerance_m: float = 0.002) -> Executor:
    """Make an executor that observes after every action and replans to this tolerance [m]."""

    def execute(world, plan, planner, report):
        goal = plan.goal

        def on_action(*_):
            nonlocal goal
            goal = report()

        config = ClosedLoopConfig(on_action=on_action, on_plan=report)
        done = run_closed_loop(
            world, lambda: replace(goal, tolerance_m=tolerance_m), skills, planner, config
        )
        words = "" if done.reached else f"The loop ended as {done.status}: {done.message}."
        return measured(world, plan, done.object_paths_xy_m, words).with_goal(goal)

    return execute
