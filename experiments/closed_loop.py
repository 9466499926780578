"""The closed loop, measured: height, orientation, disturbances, reachability of random goals.

    python -m experiments.closed_loop --tables height,orientation

Trial i of a table is a function of the seed and i: object, start, goal and disturbances are drawn
before anything plans, on objects that no model has seen. Whether a goal is feasible is judged by
the arm's kinematics (position) and by whole grasps (height), never by the planner under test. The
goals of `height` and `orientation` are also planned open loop: each from one image, executed
without observing again (`open_loop_pose_goals`).
"""

from __future__ import annotations

import argparse
import hashlib
import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from affordlib.commands import command, count_type, names_type, seed_type
from affordlib.geometry import wrap_angle
from affordlib.models.checkpoint import weights_bytes
from affordlib.paths import repo_root
from affordlib.planning import (
    ClosedLoopResult,
    Disturbance,
    DisturbanceSchedule,
    Skills,
    execute_plan,
    plan_astar,
    plan_continuous,
    run_closed_loop,
    sample_disturbances,
)
from affordlib.planning.disturbances import KINDS
from affordlib.planning.grasp_rotate import GRIPPER_YAWS_RAD
from affordlib.planning.reachability import SHIPPED as REACHABILITY
from affordlib.planning.skills import CHECKPOINTS
from affordlib.primitives import Drag, Grasp, Push
from affordlib.results import write_results
from affordlib.types import TABLE_X_M, TABLE_Y_M, Goal
from affordlib.workers import dask_client
from affordlib.world import Tabletop, TabletopObject, UnreachableError, category_named
from experiments.closed_loop_tables import OPEN_LOOP_ROWS, ROWS, WITHIN_HEIGHT_M
from experiments.feasibility import half_width_m, is_feasible, on_the_rim
from experiments.runner import Job, read, run

N_TRIALS = {"height": 50, "orientation": 50, "disturbances": 200, "reachability": 1000}
VERSIONS = dict.fromkeys((*N_TRIALS, "open_loop_pose_goals"), 1)
"""Raise one when the code changes and the table's numbers do."""

POSE_PRIMITIVES = {"height": "grasp", "orientation": "rotate"}
CATEGORIES = ("cuboid", "upright_cylinder", "lying_cylinder", "sphere")
PLANNERS = {"astar": plan_astar, "continuous": plan_continuous}
TOLERANCE_M = {"height": 0.004, "orientation": 0.004, "disturbances": 0.002, "reachability": 0.002}
"""Of the position; gripping shifts objects."""

EDGE_M = 0.05
"""Goals of `reachability` are at least this far from the table's edge."""


@dataclass(frozen=True)
class Trial:
    """An object at a place, turned by a yaw [rad], where it should go, and what will go wrong."""

    obj: TabletopObject
    start_xy_m: tuple[float, float]
    yaw_rad: float
    goal: Goal
    disturbances: tuple[Disturbance, ...] = ()

    @property
    def kind(self) -> type[Push] | type[Drag]:
        """How its object is moved."""
        return Drag if self.obj.rollable else Push


def sample_trial(table: str, index: int, seed: int = 0) -> Trial:
    """Trial number `index` of a table, a function of the seed and the number alone."""
    if table not in N_TRIALS:
        raise ValueError(f"table must be one of {sorted(N_TRIALS)}, got {table!r}")
    key = (100 + list(N_TRIALS).index(table), index)
    rng = np.random.default_rng(np.random.SeedSequence(2_000_003 + seed, spawn_key=key))
    obj = category_named(CATEGORIES[index % len(CATEGORIES)]).sample(rng)
    about: dict[str, Any] = {"obj": obj, "start_xy_m": (0.0, 0.0)}
    about["yaw_rad"] = float(rng.uniform(-math.pi, math.pi))
    tolerance_m = TOLERANCE_M[table]
    if table == "reachability":
        low, high = (np.array([TABLE_X_M[k], TABLE_Y_M[k]]) for k in (0, 1))
        end = rng.uniform(low + EDGE_M, high - EDGE_M).tolist()
        return Trial(**about, goal=Goal(tuple(end), tolerance_m))
    farthest = 0.25 if table == "disturbances" else 0.12
    r, angle = math.sqrt(rng.uniform(0.02**2, farthest**2)), rng.uniform(-math.pi, math.pi)
    xy = (r * math.cos(angle), r * math.sin(angle))
    if table == "height":
        height_m = float(rng.uniform(0.02, 0.2))
        return Trial(**about, goal=Goal(xy, tolerance_m, height_m=height_m))
    if table == "orientation":
        turn_rad = float(rng.uniform(-math.pi, math.pi))
        return Trial(**about, goal=Goal(xy, tolerance_m, turn_rad=turn_rad))
    n_actions = max(1, math.ceil(r / 0.09))
    kinds = [kind for kind in KINDS if kind != "topple" or not obj.rollable]
    disturbances = sample_disturbances(int(rng.integers(2**32)), 1, n_actions, kinds)
    return Trial(**about, goal=Goal(xy, tolerance_m), disturbances=disturbances)


@cache
def _tabletop_and_skills() -> tuple[Tabletop, Skills]:
    """One of each for a process."""
    return Tabletop(), Skills.load()


def run_trial(table: str, index: int, seed: int = 0) -> dict[str, Any]:
    """The record of a trial: how it ended, and whether it could be done."""
    world, skills = _tabletop_and_skills()
    trial = sample_trial(table, index, seed)
    world.place(trial.obj, trial.start_xy_m, trial.yaw_rad)
    robot = DisturbanceSchedule(world, trial.goal, trial.disturbances)
    result = run_closed_loop(robot, robot.current_goal, skills)
    record = {"object_class": trial.obj.category, **_measured(world, result)}
    if table == "height":
        record["feasible"] = _can_be_lifted(world, trial, result)
    elif table == "orientation":
        record["feasible"] = True
    elif table == "disturbances":
        record["feasible"] = _stays_feasible(world, trial, result, robot.happened)
        record["kind"] = trial.disturbances[0].kind
        world.place(trial.obj, trial.start_xy_m, trial.yaw_rad)
        record["undisturbed"] = _measured(world, run_closed_loop(world, trial.goal, skills))
    else:
        query = trial.kind, half_width_m(trial.obj.footprint_m)
        record["feasible"] = is_feasible(*query, trial.start_xy_m, trial.goal.xy_m)
        record["on_the_rim"] = on_the_rim(*query, trial.start_xy_m, trial.goal.xy_m)
    return record


def _measured(world: Tabletop, result: ClosedLoopResult) -> dict[str, Any]:
    """What the tables need of a closed loop; the distance is the ground truth."""
    return {
        "status": result.status,
        "message": result.message,
        "distance_m": result.goal.distance_m(world.object_pose()[:2]),
        "actions": len(result.steps),
        "plans": len(result.plans),
        "ik_rejections": result.vetoes,
        "turn_error_rad": result.turn_error_rad,
        "height_error_m": result.height_error_m,
    }


def _can_be_lifted(world: Tabletop, trial: Trial, result: ClosedLoopResult) -> bool:
    """Whether the object was lifted as high, or a whole grasp at the goal does so, by any hand."""
    high = trial.goal.height_m - WITHIN_HEIGHT_M

    def lifts(grip_yaw: float) -> bool:
        world.place(trial.obj, result.goal.xy_m, result.end_pose[2])
        done = world.execute_primitive(Grasp(grip_yaw=grip_yaw), record_unreachable=True)
        return bool(done.effect[:, 2].max() >= high)

    return result.reached or any(map(lifts, GRIPPER_YAWS_RAD))


def _stays_feasible(
    world: Tabletop, trial: Trial, result: ClosedLoopResult, happened: Sequence[Disturbance]
) -> bool:
    """Whether the kinematics allows a way from the start, and from where the disturbance has left
    the object, as it was first seen after it.

    What happens later is up to the robot.
    """
    half, start = half_width_m(trial.obj.footprint_m), trial.start_xy_m
    if not is_feasible(trial.kind, half, start, trial.goal.xy_m):
        return False
    if not happened:
        return True
    disturbance = happened[0]
    first = disturbance.action + (disturbance.at_s is not None)
    if result.status == "lost" and len(result.seen_xy_m) == first + 1:
        return disturbance.kind == "goal"
    kind = Drag if world.object_rolls() else Push
    seen = result.seen_xy_m[first:][:1]
    return all(is_feasible(kind, half, xy, result.goal.xy_m) for xy in seen)


def run_open_loop(table: str, index: int, planner: str) -> dict[str, Any]:
    """The record of one plan of a whole pose, tried even where the planner predicts to fail.

    pose_error: what is missing of the turn [rad] or of the height [m].
    """
    world, skills = _tabletop_and_skills()
    trial = sample_trial(table, index)
    world.place(trial.obj, trial.start_xy_m, trial.yaw_rad)
    image = world.depth_image()
    plan = skills.planner(PLANNERS[planner])(image, trial.start_xy_m, trial.goal)
    yaw, z = world.object_pose()[2], world.object_state()[2]
    refused = False
    try:
        execute_plan(world, plan)
    except UnreachableError:
        refused = True
    pose = world.object_pose()
    if table == "orientation":
        pose_error = wrap_angle(trial.goal.turn_rad - (pose[2] - yaw))
    else:
        pose_error = trial.goal.height_m - (world.object_state()[2] - z)
    world.park()
    return {
        "object_class": trial.obj.category,
        "predicted_reached": plan.reaches_goal,
        "actions": len(plan.steps),
        "arm_refused": refused,
        "distance_m": trial.goal.distance_m(pose[:2]),
        "pose_error": abs(pose_error),
    }


@cache
def _reachability_sha256() -> str:
    return hashlib.sha256(weights_bytes(repo_root() / REACHABILITY)).hexdigest()


def job(table: str, index: int, seed: int) -> Job:
    """One trial of the closed loop."""
    arguments = {"table": table, "index": index, "seed": seed}
    used = ("push", "drag", POSE_PRIMITIVES.get(table))
    files = tuple(file for kind, file in CHECKPOINTS.items() if kind in used)
    return Job(run_trial, arguments, _reachability_sha256(), (), files, VERSIONS[table])


def open_loop_job(table: str, index: int, planner: str) -> Job:
    """One plan of a whole pose."""
    arguments = {"table": table, "index": index, "planner": planner}
    files, version = tuple(CHECKPOINTS.values()), VERSIONS["open_loop_pose_goals"]
    return Job(run_open_loop, arguments, (), (), files, version)


def _in_order(results: list[tuple[dict, dict]]) -> list[dict[str, Any]]:
    return sorted((about | record for about, record in results), key=lambda r: r["index"])


def tables(seed: int = 0) -> dict[str, list[dict[str, Any]]]:
    """All tables of the trials of a seed that were run."""
    found = _in_order(read("closed_loop", job))
    some = {name: [r for r in found if (r["table"], r["seed"]) == (name, seed)] for name in ROWS}
    return {name: rows(some[name]) for name, rows in ROWS.items() if some[name]}


def open_loop_tables() -> dict[str, list[dict[str, Any]]]:
    """The tables of plans that were executed without observing again."""
    found = _in_order(read("open_loop_pose_goals", open_loop_job))
    some = {name: [r for r in found if r["table"] == name] for name in OPEN_LOOP_ROWS}
    return {name: rows(some[name]) for name, rows in OPEN_LOOP_ROWS.items() if some[name]}


@command(OSError, ValueError)
def main(argv: Sequence[str] | None = None) -> int:
    """Run the trials that are missing, and write the tables of all that were run."""
    parser = argparse.ArgumentParser(
        prog="python -m experiments.closed_loop", description=main.__doc__
    )
    parser.add_argument("--tables", type=names_type(VERSIONS), default=",".join(VERSIONS))
    parser.add_argument("--n", type=count_type, default=1000, help="trials of each table")
    parser.add_argument("--seed", type=seed_type, default=0)
    parser.add_argument("--out", default="data/results")
    parser.add_argument("--workers", type=count_type, default=1, help="processes here")
    parser.add_argument("--scheduler", help="address of a Dask scheduler that shares the folder")
    options = parser.parse_args(argv)
    with dask_client(options.workers, options.scheduler) as client:
        for table in options.tables:
            if table in N_TRIALS:
                n = min(options.n, N_TRIALS[table])
                run([job(table, i, options.seed) for i in range(n)], "closed_loop", client)
                continue
            run(
                [
                    open_loop_job(goals, index, planner)
                    for goals in OPEN_LOOP_ROWS
                    for index in range(min(options.n, N_TRIALS[goals]))
                    for planner in PLANNERS
                ],
                table,
                client,
            )
    name = f"closed_loop_seed{options.seed}" if options.seed else "closed_loop"
    print(write_results(options.out, name, {"seed": options.seed}, tables(options.seed)))
    print(write_results(options.out, "open_loop_pose_goals", {}, open_loop_tables()))
    return 0


if __name__ == "__main__":
    sys.exit(main())
