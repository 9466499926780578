"""Benchmarks of speed: `make bench`; with `--keep` they are written to `data/results/speed.json`.

Plans, the map of effects that they need, and collection, measured in one run on one core.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
import pandas as pd
import torch

from affordlib.interactions.recipes import RECIPES, interact
from affordlib.models import load_checkpoint
from affordlib.planning import EffectMap, PlanningProblem, plan_astar, plan_continuous
from affordlib.primitives import PRIMITIVES
from affordlib.results import repo_root, write_results
from affordlib.world import Tabletop
from experiments.commands import command
from experiments.runner import Rows
from experiments.tasks import frozen_tasks

MODES = {"single_partial": "one action", "multi_partial": "up to three actions"}
PLANNERS = {"A*, to the disc": partial(plan_astar, heuristic="disc"), "continuous": plan_continuous}


def seconds(work: Callable[[], object]) -> float:
    """Return the CPU time of a call [s], which excludes other programs."""
    began = time.process_time()
    work()
    return time.process_time() - began


def planning(n_goals: int = 15) -> Rows:
    """Measure milliseconds per plan; `whole` includes the map of the effects of a new object."""
    film, rows, maps_s = load_checkpoint("film_5000")[0], [], []
    uniform = [t for t in frozen_tasks() if t.goals == "uniform" and not t.obj.rollable]

    def whole(planner: Callable, problem: PlanningProblem) -> None:
        planner(replace(problem, effects=EffectMap(film, problem.effects.image)))

    with Tabletop() as world:
        for mode, goals in MODES.items():
            times = {name: [] for name in PLANNERS}
            for task in [t for t in uniform if t.mode == mode][:n_goals]:
                world.place(task.obj, (0.0, 0.0), task.yaw_rad)
                effects = EffectMap(film, world.depth_image())
                maps_s.append(seconds(lambda e=effects: e.spline))
                effects.fine_grid  # noqa: B018, computed once per object
                problem = PlanningProblem(world.object_pose()[:2], task.goal, effects, task.mode)
                for name, planner in PLANNERS.items():
                    both = partial(planner, problem), partial(whole, planner, problem)
                    times[name].append([seconds(each) for each in both])
            for name, values in times.items():
                median, with_map = 1000 * np.median(values, axis=0)
                row = {"planner": name, "goals": goals, "median_ms": median}
                rows.append(row | {"whole_median_ms": with_map})
    about = {"planner": "map", "goals": "an object", "median_ms": 1000 * np.median(maps_s)}
    return [*rows, about | {"whole_median_ms": None}]


def collection(n: int = 24) -> Rows:
    """Measure interactions per second, by primitive."""
    rows = []
    with Tabletop() as world:
        for name in (name for name in PRIMITIVES if name in RECIPES):
            interact(RECIPES[name], 0, world)
            each = [seconds(partial(interact, RECIPES[name], k, world)) for k in range(n)]
            rows.append({"primitive": name, "n": n, "per_second": 1 / float(np.mean(each))})
    return rows


@command(OSError, ValueError)
def main(argv: Sequence[str] | None = None) -> int:
    """Run the benchmarks on one core."""
    parser = argparse.ArgumentParser(prog="python -m experiments.speed", description=main.__doc__)
    parser.add_argument("--keep", action="store_true", help="write data/results/speed.json")
    options = parser.parse_args(argv)
    torch.set_num_threads(1)
    tables = {measure.__name__: measure() for measure in (planning, collection)}
    for name, rows in tables.items():
        print(f"{name}\n{pd.DataFrame(rows).to_string(index=False)}")
    print(f"load {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores")
    if options.keep:
        write_results(repo_root() / "data" / "results", "speed", {}, tables)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
