"""How a plan is executed while somebody watches, who may stop it, disturb it, or move its goal."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from affordlib.planning import (
    ClosedLoopConfig,
    Skills,
    execute_plan,
    plan_continuous,
    run_closed_loop,
)
from affordlib.planning.skills import SkillPlanner
from affordlib.types import Goal, Outcome, Plan
from affordlib.world import Tabletop

Planner = Callable[[np.ndarray, tuple[float, float], Goal], Plan]
"""From an image, the position (x, y) [m] of the object, and a goal to a plan."""

Report = Callable[..., Goal]
"""`report()` after an action, `report(plan)` when a new plan is followed from now on.

After an action it lets the disturbances that are waiting happen. Returns the goal as it is by then,
and raises `Stopped` when nothing more shall be executed.
"""

Executor = Callable[[Tabletop, Plan, Planner, Report], Outcome]
"""How far the object was turned and lifted is measured by the caller."""


class Stopped(Exception):
    """The reader has pressed Stop."""


def open_loop(world: Tabletop, plan: Plan, planner: Planner, report: Report) -> Outcome:
    """Execute a plan as it was made, action by action, and measure where the object rests."""
    paths: tuple[np.ndarray, ...] = ()
    for step in plan.steps:
        paths += execute_plan(world, replace(plan, steps=(step,))).object_paths_xy_m
        report()
    return measured(world, plan, paths)


def measured(
    world: Tabletop, plan: Plan, paths_xy_m: tuple[np.ndarray, ...] = (), words: str = ""
) -> Outcome:
    """The outcome of a plan by where the object really is now."""
    pose = world.object_pose()
    return Outcome(plan, plan.goal.distance_m(pose[:2]), pose, paths_xy_m, words=words)


def closed_loop(skills: Skills, tolerance_m: float = 0.002) -> Executor:
    """An executor that observes after every action and replans until the goal is this near [m].

    It replans with the chosen planner where that is of `Skills.planner`. Any other does not know
    where the arm can act; then it replans with `plan_continuous` and these skills, and says so.
    """

    def execute(world, plan, planner, report):
        goal = plan.goal

        def exact_goal():
            return replace(goal, tolerance_m=tolerance_m)

        def on_action(*_):
            nonlocal goal
            goal = report()

        known = isinstance(planner, SkillPlanner)
        search = (planner.skills, planner.plan) if known else (skills, plan_continuous)
        config = ClosedLoopConfig(on_action=on_action, on_plan=report)
        done = run_closed_loop(world, exact_goal, *search, config)
        words = "" if done.reached else f"The loop ended as {done.status}: {done.message}."
        if not known:
            words += " It replanned by continuous search."
        return measured(world, plan, done.object_paths_xy_m, words.strip()).with_goal(goal)

    return execute
