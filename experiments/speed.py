"""Benchmarks of speed: `make bench` writes `runs/speed.json`; what is shipped is a copy.

Plans and the map of effects that they need, measured in one run on one core.
"""

import time
from collections.abc import Callable
from functools import partial
from itertools import count, islice
from typing import Any

import pandas as pd
import torch

from affordlib.models import load_checkpoint
from affordlib.planning import EffectMap, PlanMode, PlanningProblem, plan_astar, plan_continuous
from affordlib.results import write_results
from affordlib.world import Tabletop
from experiments.commands import command
from experiments.obstacles import MAX_STEPS, VALIDATION_SEED, drawn_task
from experiments.runner import Rows
from experiments.tasks import frozen_tasks

MODES = {"single_partial": "one action", "multi_partial": "up to three actions"}
AMONG = "up to four actions, four obstacles"
PLANNERS = {"A*, to the disc": partial(plan_astar, heuristic="disc"), "continuous": plan_continuous}

Task = tuple[Any, ...]


def seconds(work: Callable[[], object]) -> float:
    """Return the CPU time of a call [s], which excludes other programs."""
    began = time.process_time()
    work()
    return time.process_time() - began


def tasks_by_goals(n: int) -> dict[str, list[Task]]:
    """Return n tasks of each kind: object, yaw [rad], goal, mode and obstacles."""
    uniform = [t for t in frozen_tasks() if t.goals == "uniform" and not t.obj.rollable]
    tasks = {
        goals: [(t.obj, t.yaw_rad, t.goal, mode, ()) for t in uniform if t.mode == mode][:n]
        for mode, goals in MODES.items()
    }
    drawn = (drawn_task("clutter", k, VALIDATION_SEED) for k in count())
    some = islice((t for t in drawn if len(t.obstacles) == 4 and not t.obj.rollable), n)
    mode = PlanMode(MAX_STEPS, partial=True)
    tasks[AMONG] = [(t.obj, t.yaw_rad, t.goal, mode, t.obstacles) for t in some]
    return tasks


def planning(n: int = 40) -> Rows:
    """Measure milliseconds per plan, and per map of the effects of a new object."""
    film, rows = load_checkpoint("film_5000")[0], []
    with Tabletop() as world:
        for goals, tasks in tasks_by_goals(n).items():
            times: list[dict[str, float]] = []
            among = goals == AMONG  # where A* takes seconds
            planners = {k: p for k, p in PLANNERS.items() if p is plan_continuous or not among}
            for obj, yaw_rad, goal, mode, obstacles in tasks:
                world.place(obj, (0.0, 0.0), yaw_rad, obstacles=obstacles)
                seen = world.observe()
                effects = EffectMap(film, seen.image)
                took = {"map": seconds(lambda: effects.fine_grid)}  # noqa: B023
                more = {"obstacles": seen.obstacles}
                problem = PlanningProblem(seen.xy_m, goal, effects, mode, **more)
                times.append(took | {k: seconds(partial(p, problem)) for k, p in planners.items()})
            milliseconds = 1000 * pd.DataFrame(times)
            for name in planners:
                row = {"planner": name, "goals": goals, "n": len(times)}
                row |= {"median_ms": milliseconds[name].median()}
                row |= {"p95_ms": milliseconds[name].quantile(0.95)}
                rows.append(row | {"map_median_ms": milliseconds["map"].median()})
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
