"""Open-loop plans for pose goals: the goals of `closed_loop`, planned once from a single image.

python -m experiments.open_loop_pose_goals
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from contextlib import suppress
from itertools import product
from pathlib import Path
from typing import Any

import pandas as pd

from affordlib.planning import execute_plan, plan_astar, plan_continuous
from affordlib.planning.skills import CHECKPOINTS
from affordlib.types import UnreachableError
from experiments import runner
from experiments.closed_loop import (
    N_TRIALS,
    WITHIN_HEIGHT_M,
    WITHIN_M,
    WITHIN_TURN_RAD,
    sample_trial,
    tabletop_and_skills,
)
from experiments.commands import command
from experiments.runner import FOLDER, Job, Rows, plain

NAME = "open_loop_pose_goals"
PLANNERS = {"astar": plan_astar, "continuous": plan_continuous}
WITHIN = {"orientation": WITHIN_TURN_RAD, "height": WITHIN_HEIGHT_M}


def run_open_loop(table: str, index: int, planner: str) -> dict[str, Any]:
    """Plan and execute one pose goal, even if the planner predicts a failure; return its record.

    pose_error: remaining rotation [rad] or height [m].
    """
    world, skills = tabletop_and_skills()
    trial = sample_trial(table, index)
    world.place(trial.obj, trial.start_xy_m, trial.yaw_rad)
    problem = skills.problem(world.depth_image(), trial.start_xy_m, trial.goal)
    plan = PLANNERS[planner](problem)
    yaw, z = world.object_pose()[2], world.object_state()[2]
    with suppress(UnreachableError):
        execute_plan(world, plan)
    pose = world.object_pose()
    errors = trial.goal.errors(pose[:2], pose[2] - yaw, world.object_state()[2] - z)
    world.park()
    return {
        "object_class": trial.obj.category,
        "actions": len(plan.steps),
        "distance_m": errors["position"].left,
        "pose_error": abs(errors[table].left),
    }


def open_loop_rows(records: Rows, within: float) -> Rows:
    """Return a row of open-loop results per planner, with the criterion of `pose_rows`."""
    table = pd.DataFrame(records)
    hit = (table.pose_error <= within) & (table.distance_m <= WITHIN_M)
    groups = table.assign(within_percent=100 * hit).groupby("planner", sort=False)
    means = groups[["within_percent", "distance_m", "actions"]].mean()
    means.columns = ["within_percent", "distance_m_mean", "actions_mean"]
    means.insert(0, "n", groups.size())
    means.insert(0, "object_class", "all")
    return plain(means.reset_index())


def job(table: str, index: int, planner: str) -> Job:
    """Return the job of one open-loop plan."""
    arguments = {"table": table, "index": index, "planner": planner}
    return Job(run_open_loop, arguments, checkpoints=tuple(CHECKPOINTS.values()), version=2)


def tables(folder: str | Path = FOLDER) -> dict[str, Rows]:
    """Return the tables of all executed plans."""
    found = [about | record for about, record in runner.read(NAME, job, folder)]
    return {
        table: open_loop_rows([record for record in found if record["table"] == table], within)
        for table, within in WITHIN.items()
    }


JOBS = [job(t, i, planner) for t, planner in product(WITHIN, PLANNERS) for i in range(N_TRIALS[t])]


@command(OSError, ValueError)
def main(argv: Sequence[str] | None = None) -> int:
    """Make and execute missing plans, and write the tables."""
    return runner.make(JOBS, NAME, runner.parser(NAME, main.__doc__).parse_args(argv), tables)


if __name__ == "__main__":
    sys.exit(main())
