"""Benchmarks of speed: `make bench` writes `runs/speed.json`; what is shipped is a copy.

Plans and the map of effects that they need, measured in one run on one core.
"""

import time
import warnings
from collections.abc import Callable
from functools import partial
from itertools import count, islice
from typing import Any

import pandas as pd
import torch

from affordlib.models import load_checkpoint
from affordlib.planning import (
    EffectMap,
    PlanMode,
    PlanningProblem,
    plan_astar,
    plan_continuous,
    plan_gradient,
)
from affordlib.results import write_results
from affordlib.world import Tabletop
from experiments.commands import command
from experiments.field_baselines import plan_cem
from experiments.obstacles import MAX_STEPS, VALIDATION_SEED, drawn_task
from experiments.runner import Rows, plain
from experiments.tasks import frozen_tasks

MODES = {"single_partial": "one action", "multi_partial": "up to three actions"}
AMONG = "up to four actions, four obstacles"
OURS = {"continuous": plan_continuous}
ON_EMPTY_TABLE = OURS | {"A*, to the disc": partial(plan_astar, heuristic="disc")}
BETWEEN = OURS | {"A*": plan_astar, "gradient": plan_gradient, "cross-entropy": plan_cem}


def timed(work: Callable[[], Any]) -> tuple[Any, float]:
    """Return the result of a call and its CPU time [ms], which excludes other programs."""
    began = time.process_time()
    return work(), 1000 * (time.process_time() - began)


def tasks_by_goals(n: int) -> dict[str, list[tuple]]:
    """Return n tasks of each kind: object, yaw [rad], goal, mode and obstacles."""
    of_modes = (t for t in frozen_tasks() if t.mode in MODES and t.goals == "uniform")
    uniform, tasks = [t for t in of_modes if not t.obj.rollable], {k: [] for k in MODES.values()}
    for t in uniform:
        tasks[MODES[t.mode]].append((t.obj, t.yaw_rad, t.goal, t.mode, ()))
    drawn = (drawn_task("clutter", k, VALIDATION_SEED) for k in count())
    some = islice((t for t in drawn if len(t.obstacles) == 4 and not t.obj.rollable), n)
    mode = PlanMode(MAX_STEPS, partial=True)
    tasks[AMONG] = [(t.obj, t.yaw_rad, t.goal, mode, t.obstacles) for t in some]
    return {goals: some[:n] for goals, some in tasks.items()}


def planning(n: int = 40) -> Rows:
    """Measure the time per plan, and per map of the effects of a new object."""
    film, rows = load_checkpoint("film_5000")[0], []
    with Tabletop() as world:
        for goals, tasks in tasks_by_goals(n).items():
            for obj, yaw_rad, goal, mode, obstacles in tasks:
                world.place(obj, (0.0, 0.0), yaw_rad, obstacles=obstacles)
                seen = world.observe()
                effects = EffectMap(film, seen.image)
                _, map_ms = timed(partial(getattr, effects, "fine_grid"))
                problem = PlanningProblem(seen.xy_m, goal, effects, mode, obstacles=seen.obstacles)
                for name, planner in (BETWEEN if obstacles else ON_EMPTY_TABLE).items():
                    plan, plan_ms = timed(partial(planner, problem))
                    about = {"planner": name, "map_ms": map_ms, "ms": plan_ms}
                    none = bool(obstacles) and not plan.reaches_goal
                    about["goals"] = goals + ", no plan found" * none
                    rows.append(about)
    groups = pd.DataFrame(rows).groupby(["planner", "goals"], sort=False)
    table = groups.agg(
        n=("ms", "size"),
        median_ms=("ms", "median"),
        p95_ms=("ms", lambda each: each.quantile(0.95)),
        map_median_ms=("map_ms", "median"),
    )
    return plain(table.reset_index())


@command(OSError, ValueError)
def main() -> int:
    """Run the benchmarks on one core."""
    torch.set_num_threads(1)
    warnings.simplefilter("ignore")  # of plans that do not reach their goals
    planning(1)  # what is imported or compiled at the first use is not counted
    rows = planning()
    print(pd.DataFrame(rows).to_string(index=False))
    print(write_results("runs", "speed", {}, {"planning": rows}))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
