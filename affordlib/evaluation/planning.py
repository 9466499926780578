"""Table 3: plan to goals, carry the plans out, measure the distance that remains.

Goals are drawn before planning, by seed, on objects no model has seen, more than 2 cm from the
start and off the 10° grid of A*. Two families: *constructed* goals are where an executed full or
partial push really ended; *uniform* ones are drawn evenly over the area in reach.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from tqdm.auto import tqdm

from affordlib.evaluation.effect_prediction import error_row
from affordlib.planning import MODES, carry_out
from affordlib.primitives import Push
from affordlib.types import Goal, Outcome, Plan
from affordlib.world import Cuboid, Tabletop, UnreachableError, UprightCylinder, family_named

MIN_DISTANCE_M = 0.02
EARLIEST_STOP = 0.55
"""Before this phase hardly any push has touched its object."""

UNIFORM_REACH_M = {"single_full": 0.09, "single_partial": 0.09, "multi_partial": 0.25}
OBJECT_CLASSES = ("cuboid", "upright_cylinder")

Planner = Callable[[np.ndarray, tuple[float, float], Goal, str], Plan]
"""A planner as (image, start_xy_m, goal, mode) → Plan."""


@dataclass(frozen=True)
class PlanningTask:
    """An object at the table's centre, turned by a yaw [rad], and where it should go."""

    thing: Cuboid | UprightCylinder
    yaw_rad: float
    goal: Goal
    mode: str
    goals: str


def _objects(mode: str, goals: str, seed: int, index: int) -> tuple:
    if mode not in MODES:
        raise ValueError(f"mode {mode!r} is unknown; choose one of {sorted(MODES)}")
    key = (list(MODES).index(mode), ("constructed", "uniform").index(goals), index)
    rng = np.random.default_rng(np.random.SeedSequence(2_000_003 + seed, spawn_key=key))
    thing = family_named(OBJECT_CLASSES[index % len(OBJECT_CLASSES)]).sample(rng)
    return thing, float(rng.uniform(-math.pi, math.pi)), rng


def _off_grid(rng: np.random.Generator, around: float, spread: float) -> float:
    """An angle within `spread` of `around`, at least 1° off the 10° grid."""
    while True:
        angle = around + rng.uniform(-spread, spread)
        off = math.degrees(angle) % 10
        if 1 <= off <= 9:
            return angle


def constructed_tasks(world: Tabletop, mode: str, n: int, seed: int = 0) -> list[PlanningTask]:
    """Tasks whose goal is where random pushes of the mode's kind really took the object."""
    tasks = []
    for index in range(n):
        thing, yaw, rng = _objects(mode, "constructed", seed, index)
        while True:
            direction = rng.uniform(-math.pi, math.pi)
            world.place(thing, (0.0, 0.0), yaw)
            for _ in range(rng.integers(2, MODES[mode].max_steps + 1) if mode[0] == "m" else 1):
                stop = rng.uniform(EARLIEST_STOP, 1.0) if MODES[mode].partial else 1.0
                world.interact(Push(_off_grid(rng, direction, math.pi / 4)), stop, approach=True)
            x, y, _ = world.object_pose()
            if math.hypot(x, y) > MIN_DISTANCE_M and world.object_tilt_rad() < 0.1:
                break
        tasks.append(PlanningTask(thing, yaw, Goal((x, y)), mode, "constructed"))
    return tasks


def uniform_tasks(mode: str, n: int, seed: int = 0) -> list[PlanningTask]:
    """Tasks whose goal is drawn evenly from the ring between 2 cm and the mode's reach."""
    tasks = []
    for index in range(n):
        thing, yaw, rng = _objects(mode, "uniform", seed, index)
        r = math.sqrt(rng.uniform(MIN_DISTANCE_M**2, UNIFORM_REACH_M[mode] ** 2))
        angle = _off_grid(rng, 0.0, math.pi)
        goal = Goal((r * math.cos(angle), r * math.sin(angle)))
        tasks.append(PlanningTask(thing, yaw, goal, mode, "uniform"))
    return tasks


def attempt(world: Tabletop, task: PlanningTask, planner: Planner) -> Outcome:
    """Plan and carry out one task.

    A plan that the arm cannot follow counts with the distance at which it left the object.
    """
    world.place(task.thing, (0.0, 0.0), task.yaw_rad)
    start = world.object_pose()[:2]
    plan = planner(world.look(), start, task.goal, task.mode)
    try:
        return carry_out(world, plan)
    except UnreachableError:
        pose = world.object_pose()
        return Outcome(plan, task.goal.distance_m(pose[:2]), pose, world.object_tilt_rad())


def measure(
    world: Tabletop, tasks: list[PlanningTask], planner: Planner, progress: str = ""
) -> list[Outcome]:
    """Outcomes of all tasks with one planner, in order."""
    bar = tqdm(tasks, desc=progress, unit=" goals", disable=not progress, leave=False)
    return [attempt(world, task, planner) for task in bar]


def planning_rows(
    tasks: list[PlanningTask], outcomes: list[Outcome], **columns: Any
) -> list[dict[str, Any]]:
    """Rows of the table `planning`: one per mode and object class, and one for all classes.

    columns: `planner`, `model`, `world`, `samples`, `closed_loop`, as they describe the outcomes.
    """
    rows = []
    pairs = list(zip(tasks, outcomes, strict=True))
    for goals in dict.fromkeys(task.goals for task in tasks):
        for mode in dict.fromkeys(task.mode for task in tasks if task.goals == goals):
            for object_class in ("all", *OBJECT_CLASSES):
                chosen = [
                    o
                    for t, o in pairs
                    if (t.goals, t.mode) == (goals, mode)
                    and object_class in ("all", t.thing.family)
                ]
                if not chosen:
                    continue
                about = {"goals": goals, "object_class": object_class, "mode": mode}
                row = error_row(np.array([o.distance_m for o in chosen]), **columns, **about)
                row["plan_ms_median"] = float(np.median([1000 * o.plan.plan_s for o in chosen]))
                row["predicted_mean_m"] = float(
                    np.mean([o.plan.predicted_distance_m for o in chosen])
                )
                row["steps_mean"] = float(np.mean([len(o.plan.steps) for o in chosen]))
                rows.append(row)
    return rows
