"""Table 3: plan to goals, carry the plans out, measure the distance that remains.

Each planner is a variant: a planner, the models it sees, and how often it may correct itself. Its
outcomes on the frozen goals are written, whole or not at all, as a part; the table is assembled
from the parts that are there.

    python -m experiments.planning --variants continuous astar
"""

from __future__ import annotations

import argparse
import hashlib
import json
import math
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tqdm.auto import tqdm

from affordlib.commands import command
from affordlib.evaluation.metrics import error_row
from affordlib.evaluation.predictions import rounded
from affordlib.evaluation.tasks import FROZEN, ROLLABLE, STANDING, PlanningTask, frozen_tasks
from affordlib.paths import repo_root, resolve_out_dir
from affordlib.planning import PlanMode, execute_plan
from affordlib.results import write_results, write_text_atomically
from affordlib.types import Goal, Outcome, Plan
from affordlib.world import Tabletop, UnreachableError
from experiments import reported
from experiments.parts import pack, part_of
from experiments.planners import VARIANTS

NUDGE_M, NUDGE_RAD = 0.001, math.radians(1.0)
PARTS = "data/results/parts/planning"
NAME = "planning"
ORACLES = ("oracle", "varied_oracle")
"""What tells what execution costs: plans with the simulator itself, as the world is."""

GROUPS = {"all": STANDING + ROLLABLE, "standing": STANDING, "rollable": ROLLABLE} | {
    name: (name,) for name in STANDING + ROLLABLE
}

Planner = Callable[[np.ndarray, tuple[float, float], "Goal", str], Plan]
"""A planner as (image, start_xy_m, goal, mode) → Plan."""


def attempt(
    world: Tabletop,
    task: PlanningTask,
    planner: Planner,
    corrections: int = 0,
    nudged: bool = False,
    looks: int = 1,
) -> Outcome:
    """Plan and carry out one task, correcting the end by up to so many single actions.

    A plan that the arm cannot follow counts with the distance at which it left the object. nudged:
    the robot then believes the object `NUDGE_M` and `NUDGE_RAD` off where it is. looks: of which
    each perception is the mean.
    """
    task.set_up(world)
    world.looks = looks
    seen = world.observe()
    plan = planner(seen.image, seen.xy_m, task.goal, task.mode)
    if nudged:
        side = NUDGE_M * np.array([math.cos(task.yaw_rad), math.sin(task.yaw_rad)])
        config = replace(task.config, bias_m=tuple(side))
        world.place(task.thing, (0.0, 0.0), task.yaw_rad + NUDGE_RAD, config=config)
    once = PlanMode(1, partial=True)
    try:
        return execute_plan(world, plan, corrections, lambda *query: planner(*query, once))
    except UnreachableError as refused:
        return refused.outcome
    finally:
        world.looks = 1


def measure(
    world: Tabletop,
    tasks: list[PlanningTask],
    planner: Planner,
    progress: str = "",
    **how: Any,
) -> list[Outcome]:
    """Outcomes of all tasks with one planner, in order; how: see `attempt`."""
    bar = tqdm(tasks, desc=progress, unit=" goals", disable=not progress, leave=False)
    return [attempt(world, task, planner, **how) for task in bar]


def outcome_record(task: PlanningTask, outcome: Outcome) -> dict[str, Any]:
    """What the table needs of one outcome."""
    plan = outcome.plan
    return {
        "goals": task.goals,
        "mode": task.mode,
        "object_class": task.thing.family,
        "distance_m": outcome.distance_m,
        "predicted_m": plan.predicted_distance_m,
        "surprise_m": float(np.hypot(*np.subtract(plan.predicted_end_xy_m, outcome.end_pose[:2]))),
        "std_m": plan.steps[-1].std_m if plan.steps else 0.0,
        "steps": len(plan.steps),
        "actions": len(outcome.object_paths_xy_m),
        "plan_s": plan.plan_s,
    }


def planning_rows(records: list[dict[str, Any]], **columns: Any) -> list[dict[str, Any]]:
    """Rows of the table `planning`: per family of goals and mode, all objects and each class.

    columns: `planner`, `model`, `world`, `samples`, `closed_loop`, as they describe the outcomes.
    predicted: how far from the goal the planner expected the end; surprise: how far from there the
    object really ended, open loop.
    """
    rows = []
    for goals in dict.fromkeys(r["goals"] for r in records):
        for mode in dict.fromkeys(r["mode"] for r in records if r["goals"] == goals):
            for group, classes in GROUPS.items():
                chosen = [
                    r
                    for r in records
                    if (r["goals"], r["mode"]) == (goals, mode) and r["object_class"] in classes
                ]
                if not chosen:
                    continue

                def column(name: str, chosen: list = chosen) -> np.ndarray:
                    return np.array([r[name] for r in chosen], dtype=float)

                about = {"goals": goals, "object_class": group, "mode": mode}
                row = error_row(column("distance_m"), **columns, **about)
                row["plan_ms_median"] = 1000 * float(np.median(column("plan_s")))
                row["predicted_mean_m"] = float(column("predicted_m").mean())
                row["surprise_mean_m"] = float(column("surprise_m").mean())
                row["std_mean_m"] = float(column("std_m").mean())
                row["steps_mean"] = float(column("steps").mean())
                row["actions_mean"] = float(column("actions").mean())
                rows.append(row)
    return rows


def run_variant(name: str, tasks: list[PlanningTask], progress: bool = True) -> dict[str, Any]:
    """The records of a variant on the tasks that it can be asked."""
    variant = VARIANTS[name]
    planner = variant.make()
    asked = variant.asked(tasks, lambda task: (task.goals, task.thing.family))
    with Tabletop() as world:
        planner_here = partial(planner, world) if variant.sees_world else planner
        names = ("corrections", "nudged", "looks")
        how = {option: getattr(variant, option) for option in names}
        outcomes = measure(world, asked, planner_here, name * progress, **how)
    records = [outcome_record(t, o) for t, o in zip(asked, outcomes, strict=True)]
    return {"variant": name, "about": variant.about(), "records": rounded(records)}


def tasks_sha256(world: str = "clean") -> str:
    """Hash of the frozen goals of a world."""
    return hashlib.sha256((repo_root() / FROZEN[world]).read_bytes()).hexdigest()


def _is_done(name: str, part: dict[str, Any] | None) -> bool:
    """Whether a part is of this variant, as it is now, on the goals as they are."""
    if part is None:
        return False
    expected = tasks_sha256(VARIANTS[name].world), VARIANTS[name].about()
    return (part["goals_sha256"], part["about"]) == expected


def assemble() -> Path:
    """Write `data/results/planning.json` from all parts; returns its path."""
    rows, parts = [], {}
    for name, variant in VARIANTS.items():
        part = part_of(f"{name}.json", repo_root() / PARTS)
        if part is None:
            continue
        if not _is_done(name, part):
            raise ValueError(
                f"part {name}.json is of other goals or settings than {name!r} has now; run "
                f"`python -m experiments.planning --variants {name}` again, or delete it"
            )
        parts[name] = part["records"]
        about = {"variant": name, "nudged": variant.nudged}
        rows += planning_rows(part["records"], **about, **variant.columns())
    if not rows:
        raise FileNotFoundError(f"there are no parts in {PARTS}; run some variants first")
    summary = [*reported.planning_rows(), *summary_rows(rows)]
    tables = {
        "planning": rows,
        "summary": summary,
        "paired": paired_rows(parts) + paired_rows(parts, "varied"),
    }
    tables["error_decomposition"] = decomposition_rows(rows)
    hashes = {world: tasks_sha256(world) for world in FROZEN}
    return write_results("data/results", NAME, {"goals_sha256": hashes}, tables)


def summary_rows(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """One row per variant on constructed goals: mean, standard error and median of each mode."""
    summary: dict[tuple[str, str], dict[str, Any]] = {}
    for row in rows:
        group = row["object_class"]
        if row["goals"] != "constructed" or group not in ("all", "standing", "rollable"):
            continue
        names = ("variant", "model", "world", "samples", "closed_loop", "object_class")
        told = summary.setdefault((row["variant"], group), {name: row[name] for name in names})
        for statistic in ("mean", "sem", "median"):
            told[f"{row['mode']}_{statistic}_m"] = row[f"{statistic}_m"]
        told[f"{row['mode']}_plan_ms"] = row["plan_ms_median"]
    return list(summary.values())


def decomposition_rows(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Where the open-loop error on constructed goals comes from, by variant, mode and group.

    search: what the planner itself expected to remain; model: how far from what it expected the
    object ended; execution: what remains with the simulator as the model, which has no σ to prefer
    sure plans by; nudged: what remains of `continuous` when the object is a millimetre and a degree
    from where it is believed, in the clean world. Variants that are only asked about what stands
    have no row of all.
    """
    open_loop = [
        r for r in rows if r["goals"] == "constructed" and not r["closed_loop"] and not r["nudged"]
    ]

    def place(row: dict[str, Any]) -> tuple[str, str, str]:
        return row["world"], row["mode"], row["object_class"]

    oracle = {place(r): r["mean_m"] for r in open_loop if r["variant"] in ORACLES}
    nudged = {place(r): r["mean_m"] for r in rows if r["nudged"]}
    return [
        {
            **{key: row[key] for key in ("variant", "world", "mode", "object_class", "n")},
            "search_mean_m": row["predicted_mean_m"],
            "model_mean_m": row["surprise_mean_m"],
            "execution_mean_m": oracle.get(place(row)),
            "nudged_mean_m": nudged.get(place(row)),
            "total_mean_m": row["mean_m"],
        }
        for row in open_loop
        if row["object_class"] in ("standing", "rollable")
        or (row["object_class"] == "all" and VARIANTS[row["variant"]].classes != STANDING)
    ]


def paired_rows(
    parts: dict[str, list[dict[str, Any]]], than: str = "continuous", n_draws: int = 2000
) -> list[dict[str, Any]]:
    """By how much each variant ends farther from the same goals than `than`: mean [m], interval.

    The interval holds 95 % of the means of goals drawn again with replacement.
    """
    rows: list[dict[str, Any]] = []
    rng = np.random.default_rng(0)
    for name, records in parts.items():
        variant = VARIANTS[name]
        if name == than or than not in parts or variant.world != VARIANTS[than].world:
            continue
        others = variant.asked(parts[than], lambda r: (r["goals"], r["object_class"]))
        pairs: dict[tuple[str, str], list[float]] = {}
        for one, other in zip(records, others, strict=True):
            farther = one["distance_m"] - other["distance_m"]
            pairs.setdefault((one["goals"], one["mode"]), []).append(farther)
        for (goals, mode), gain in pairs.items():
            draws = rng.choice(gain, (n_draws, len(gain))).mean(axis=1)
            low, high = np.quantile(draws, [0.025, 0.975])
            rows.append(
                {
                    "variant": name,
                    "than": than,
                    "goals": goals,
                    "mode": mode,
                    "n": len(gain),
                    "difference_mean_m": float(np.mean(gain)),
                    "low_m": float(low),
                    "high_m": float(high),
                }
            )
    return rows


@command(OSError, ValueError)
def main(argv: Sequence[str] | None = None) -> int:
    """Measure planners on the frozen goals and make the table from all that were measured."""
    parser = argparse.ArgumentParser(
        prog="python -m experiments.planning", description=main.__doc__
    )
    parser.add_argument("--variants", nargs="*", choices=list(VARIANTS), default=list(VARIANTS))
    options = parser.parse_args(argv)
    torch.set_num_threads(1)
    folder = resolve_out_dir(PARTS)
    for name in options.variants:
        if _is_done(name, part_of(f"{name}.json", folder)):
            print(f"{name}: there already")
            continue
        world = VARIANTS[name].world
        part = run_variant(name, frozen_tasks(world)) | {"goals_sha256": tasks_sha256(world)}
        text = json.dumps(part, separators=(",", ":"))
        write_text_atomically(folder / f"{name}.json", text + "\n")
        for row in planning_rows(part["records"]):
            if row["object_class"] == "all":
                print(
                    f"{name}: {row['goals']} {row['mode']} {1000 * row['mean_m']:.2f} mm, "
                    f"median {1000 * row['median_m']:.2f} (n = {row['n']})",
                    flush=True,
                )
    pack(folder)
    print(assemble())
    return 0


if __name__ == "__main__":
    sys.exit(main())
