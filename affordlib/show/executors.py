"""How a plan is carried out while somebody watches: stops it, disturbs it, moves its goal."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Protocol, runtime_checkable

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
"""From an image, where the object is [m] and a goal to a plan."""


@runtime_checkable
class Tell(Protocol):
    """How an executor tells what it does, and hears what the reader wants."""

    def __call__(self, plan: Plan | None = None) -> Goal:
        """Show the last action, or, if there is one, the new plan that is followed from now on.

        After an action it lets what was waiting happen. Returns the goal as it is by then; raises
        `Stopped` when the reader wants no more.
        """


Executor = Callable[["Tabletop", Plan, Planner, Tell], Outcome]
"""How far it turned and lifted the object, whoever watches it measures."""


class Stopped(Exception):
    """The reader has pressed Stop: nothing more is carried out."""


def open_loop(world: Tabletop, plan: Plan, planner: Planner, tell: Tell) -> Outcome:
    """Carry out a plan as it was made, action by action, and measure where the object rests."""
    paths: tuple[np.ndarray, ...] = ()
    for step in plan.steps:
        paths += execute_plan(world, replace(plan, steps=(step,))).object_paths_xy_m
        tell()
    at_rest = execute_plan(world, replace(plan, steps=()))
    return replace(at_rest, plan=plan, object_paths_xy_m=paths)


def closed_loop(skills: Skills, tolerance_m: float = 0.002) -> Executor:
    """An executor that looks after every action and plans anew until the goal is this near [m].

    It plans from what it sees, as the planner does where that is of `Skills.planner`. Any other
    cannot be told where the arm can act; then it plans with `plan_continuous` and these skills, and
    says so.
    """

    def execute(world, plan, planner, tell):
        def exactly(goal):
            return replace(goal, tolerance_m=tolerance_m)

        known = isinstance(planner, SkillPlanner)
        search = (planner.skills, planner.plan) if known else (skills, plan_continuous)
        config = ClosedLoopConfig(on_action=lambda *_: exactly(tell()), on_plan=tell)
        done = run_closed_loop(world, exactly(plan.goal), *search, config)
        words = "" if done.reached else f"The loop ended as {done.status}: {done.message}."
        if not known:
            words += " It was planned anew by continuous search."
        tilt, paths = world.object_tilt_rad(), done.object_paths_xy_m
        return Outcome(plan, done.distance_m, done.end_pose, tilt, paths, words=words.strip())

    return execute
