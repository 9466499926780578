"""Plans with an orientation or a height in them, made from one look and carried out as they are.

    python -m experiments.whole_plans

The goals are those of the tables `orientation` and `height` of `closed_loop`, where the robot looks
after every action; here it looks once, before all of them, and then only for where to act. A plan
is tried even where the planner says that it will not arrive.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from typing import Any

import numpy as np
from tqdm.auto import tqdm

from affordlib.commands import command, count_type
from affordlib.evaluation.metrics import error_row
from affordlib.models.checkpoint import checkpoint_sha256
from affordlib.planning import Skills, execute_plan, plan_astar, plan_continuous
from affordlib.planning.skills import CHECKPOINTS
from affordlib.primitives import wrap_angle
from affordlib.results import write_results
from affordlib.world import Tabletop, UnreachableError
from experiments.closed_loop import N_TRIALS, draw_trial
from experiments.closed_loop_tables import WITHIN_HEIGHT_M, WITHIN_M, WITHIN_TURN_RAD

PLANNERS = {"astar": plan_astar, "continuous": plan_continuous}
WITHIN = {"orientation": ("rad", WITHIN_TURN_RAD), "height": ("m", WITHIN_HEIGHT_M)}


def run_trial(table: str, index: int, planner: str, world: Tabletop, about: Skills) -> dict:
    """The record of one plan: how it was meant to end, and how it did.

    off: what is missing of the turn [rad] or the height [m].
    """
    trial = draw_trial(table, index)
    world.place(trial.obj, trial.start_xy_m, trial.yaw_rad)
    plan = about.planner(PLANNERS[planner])(world.depth_image(), trial.start_xy_m, trial.goal)
    record: dict[str, Any] = {
        "planner": planner,
        "object_class": trial.obj.category,
        "promised": plan.reaches_goal,
        "actions": len(plan.steps),
        "arm_refused": False,
    }
    yaw, z = world.object_pose()[2], world.object_state()[2]
    try:
        execute_plan(world, plan)
    except UnreachableError:
        record["arm_refused"] = True
    pose = world.object_pose()
    if table == "orientation":
        off = wrap_angle(trial.goal.turn_rad - (pose[2] - yaw))
    else:
        off = trial.goal.height_m - (world.object_state()[2] - z)
    world.park()
    return record | {"distance_m": trial.goal.distance_m(pose[:2]), "off": abs(off)}


def whole_plan_rows(records: Sequence[dict], unit: str, within: float) -> list[dict]:
    """Rows of one table: for each planner all classes, then class by class.

    Hit is within 5 mm of the place as well; of the height or turn alone, *pose within*.
    """
    rows = []
    for planner in dict.fromkeys(r["planner"] for r in records):
        of_planner = [r for r in records if r["planner"] == planner]
        for name in ("all", *dict.fromkeys(r["object_class"] for r in of_planner)):
            chosen = [r for r in of_planner if name in ("all", r["object_class"])]
            off, far = (np.array([r[column] for r in chosen]) for column in ("off", "distance_m"))
            spread = error_row(far)
            rows.append(
                {
                    "planner": planner,
                    "object_class": name,
                    "n": len(chosen),
                    "promised": sum(r["promised"] for r in chosen),
                    "arm_refused": sum(r["arm_refused"] for r in chosen),
                    "within_percent": 100 * float(((off <= within) & (far <= WITHIN_M)).mean()),
                    "pose_within_percent": 100 * float((off <= within).mean()),
                    f"off_{unit}_median": float(np.median(off)),
                    **{
                        f"distance_m_{statistic}": spread[f"{statistic}_m"]
                        for statistic in ("mean", "sem", "median", "p95")
                    },
                    "actions_mean": float(np.mean([r["actions"] for r in chosen])),
                }
            )
    return rows


def made_with() -> dict[str, dict[str, str]]:
    """Hashes of the checkpoints that plan."""
    return {"checkpoints": {name: checkpoint_sha256(name)[:16] for name in CHECKPOINTS.values()}}


@command(OSError)
def main(argv: Sequence[str] | None = None) -> int:
    """Make and carry out the plans, and write the table; ten minutes."""
    parser = argparse.ArgumentParser(
        prog="python -m experiments.whole_plans", description=main.__doc__
    )
    parser.add_argument("--n", type=count_type, help="trials of each kind of goal (default: all)")
    parser.add_argument("--out", default="data/results")
    options = parser.parse_args(argv)
    skills = Skills.load()
    tables = {}
    with Tabletop() as world:
        for table, (unit, within) in WITHIN.items():
            n = min(options.n or N_TRIALS[table], N_TRIALS[table])
            asked = [(table, index, planner) for index in range(n) for planner in PLANNERS]
            records = [run_trial(*query, world, skills) for query in tqdm(asked, table)]
            tables[table] = whole_plan_rows(records, unit, within)
    path = write_results(options.out, "whole_plans", made_with(), tables)
    print(f"{path.name} written")
    return 0


if __name__ == "__main__":
    sys.exit(main())
