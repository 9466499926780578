"""Benchmarks of speed: `make bench` writes `runs/speed.json`; what is shipped is a copy.

Plans and the map of effects that they need, measured in one run on one core.
"""

import time
from dataclasses import replace
from functools import partial

import numpy as np
import pandas as pd
import torch

from affordlib.models import load_checkpoint
from affordlib.planning import EffectMap, PlanningProblem, plan_astar, plan_continuous
from affordlib.results import write_results
from affordlib.world import Tabletop
from experiments.commands import command
from experiments.runner import Rows
from experiments.tasks import frozen_tasks

MODES = {"single_partial": "one action", "multi_partial": "up to three actions"}
PLANNERS = {"A*, to the disc": partial(plan_astar, heuristic="disc"), "continuous": plan_continuous}


def planning(n_goals: int = 15) -> Rows:
    """Measure milliseconds per plan; `whole` includes the map of the effects of a new object."""
    film, rows = load_checkpoint("film_5000")[0], []
    uniform = [t for t in frozen_tasks() if t.goals == "uniform" and not t.obj.rollable]
    with Tabletop() as world:
        for mode, goals in MODES.items():
            times = {name: [] for name in PLANNERS}
            for task in [t for t in uniform if t.mode == mode][:n_goals]:
                world.place(task.obj, (0.0, 0.0), task.yaw_rad)
                effects = EffectMap(film, world.depth_image())
                effects.fine_grid  # noqa: B018, computed once per object
                problem = PlanningProblem(world.object_pose()[:2], task.goal, effects, task.mode)
                for name, planner in PLANNERS.items():
                    began = time.process_time()  # CPU time, which excludes other programs
                    planner(problem)
                    planned = time.process_time()
                    planner(replace(problem, effects=EffectMap(film, effects.image)))
                    times[name].append((planned - began, time.process_time() - planned))
            for name, values in times.items():
                median, with_map = 1000 * np.median(values, axis=0)
                row = {"planner": name, "goals": goals, "median_ms": median}
                rows.append(row | {"whole_median_ms": with_map})
    return rows


@command(OSError, ValueError)
def main() -> int:
    """Run the benchmarks on one core."""
    torch.set_num_threads(1)
    rows = planning()
    print(pd.DataFrame(rows).to_string(index=False))
    print(write_results("runs", "speed", {}, {"planning": rows}))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
