"""Closing the loop, in figures: height, orientation, disturbances, reachability of random goals.

    python -m experiments.closed_loop --tables height,orientation

Trial i of a table is a function of the seed and i: object, start, goal and disturbances are drawn
before anything plans, on objects that no model has seen. A trial's record is kept as soon as it is
made, so a run that is killed goes on. Whether a goal is feasible is judged by the kinematic oracle
(position) and by grasping in full (height), never by the planner under test.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from tqdm.auto import tqdm

from affordlib.commands import command, count_type, names_type, seed_type
from affordlib.evaluation.predictions import rounded
from affordlib.models.checkpoint import checkpoint_sha256, weights_bytes
from affordlib.paths import repo_root
from affordlib.planning import (
    ClosedLoopResult,
    Disturbance,
    DisturbanceSchedule,
    Skills,
    run_closed_loop,
    sample_disturbances,
)
from affordlib.planning.disturbances import KINDS
from affordlib.planning.grasp_rotate import GRIPPER_YAWS_RAD
from affordlib.planning.reachability import SHIPPED as REACHABILITY
from affordlib.planning.skills import CHECKPOINTS
from affordlib.primitives import Drag, Grasp, Push
from affordlib.results import write_results, write_text_atomically
from affordlib.types import TABLE_X_M, TABLE_Y_M, Goal
from affordlib.workers import dask_client
from affordlib.world import Tabletop, TabletopObject, category_named
from experiments.closed_loop_tables import ROWS, WITHIN_HEIGHT_M
from experiments.feasibility import half_width_m, is_feasible, on_the_rim

if TYPE_CHECKING:
    from dask.distributed import Client

FORMATS = {"height": 8, "orientation": 6, "disturbances": 5, "reachability": 4}
"""Counts the changes of code that change a table's records."""

N_TRIALS = {"height": 50, "orientation": 50, "disturbances": 200, "reachability": 1000}
POSE_BY = {"height": "grasp", "orientation": "rotate"}
CLASSES = ("cuboid", "upright_cylinder", "lying_cylinder", "sphere")
TOLERANCE_M = {"height": 0.004, "orientation": 0.004, "disturbances": 0.002, "reachability": 0.002}
"""Of the position; gripping shifts objects."""

EDGE_M = 0.05
PARTS = "data/results/parts/closed_loop"


@dataclass(frozen=True)
class Trial:
    """An object at a place, turned by a yaw [rad], where it should go, and what will go wrong."""

    obj: TabletopObject
    start_xy_m: tuple[float, float]
    yaw_rad: float
    goal: Goal
    disturbances: tuple[Disturbance, ...] = ()


def draw_trial(table: str, index: int, seed: int = 0) -> Trial:
    """Trial number `index` of a table."""
    if table not in N_TRIALS:
        raise ValueError(f"table must be one of {sorted(N_TRIALS)}, got {table!r}")
    key = (100 + list(N_TRIALS).index(table), index)
    rng = np.random.default_rng(np.random.SeedSequence(2_000_003 + seed, spawn_key=key))
    obj = category_named(CLASSES[index % len(CLASSES)]).sample(rng)
    yaw = float(rng.uniform(-math.pi, math.pi))
    if table == "reachability":
        low, high = (np.array([TABLE_X_M[k], TABLE_Y_M[k]]) for k in (0, 1))
        end = rng.uniform(low + EDGE_M, high - EDGE_M).tolist()
        return Trial(obj, (0.0, 0.0), yaw, Goal(tuple(end), TOLERANCE_M[table]))
    farthest = 0.25 if table == "disturbances" else 0.12
    r, angle = math.sqrt(rng.uniform(0.02**2, farthest**2)), rng.uniform(-math.pi, math.pi)
    xy, exact = (r * math.cos(angle), r * math.sin(angle)), TOLERANCE_M[table]
    if table == "height":
        return Trial(obj, (0.0, 0.0), yaw, Goal(xy, exact, height_m=float(rng.uniform(0.02, 0.2))))
    if table == "orientation":
        turn = float(rng.uniform(-math.pi, math.pi))
        return Trial(obj, (0.0, 0.0), yaw, Goal(xy, exact, turn_rad=turn))
    n_actions = max(1, math.ceil(r / 0.09))
    kinds = [kind for kind in KINDS if kind != "topple" or not obj.rollable]
    script = sample_disturbances(int(rng.integers(2**32)), 1, n_actions, kinds)
    return Trial(obj, (0.0, 0.0), yaw, Goal(xy, exact), script)


def run_trial(table: str, index: int, world: Tabletop, skills: Skills, seed: int) -> dict:
    """The record of a trial: what was asked, how it ended, whether it could be done."""
    trial = draw_trial(table, index, seed)
    record: dict[str, Any] = {"index": index, "object_class": trial.obj.category}
    world.place(trial.obj, trial.start_xy_m, trial.yaw_rad)
    disturbed = DisturbanceSchedule(world, trial.goal, trial.disturbances)
    went = run_closed_loop(disturbed, disturbed.current_goal, skills)
    record |= _told(world, went)
    if table == "height":
        record["feasible"] = _can_be_lifted(world, trial, went)
    elif table == "orientation":
        record["feasible"] = True
    elif table == "disturbances":
        record["feasible"] = _stays_feasible(world, trial, went, disturbed.happened)
        record["kind"] = trial.disturbances[0].kind
        record["in_action"] = trial.disturbances[0].at_s is not None
        record["happened"] = len(disturbed.happened)
        world.place(trial.obj, trial.start_xy_m, trial.yaw_rad)
        undisturbed = run_closed_loop(world, trial.goal, skills)
        record["undisturbed"] = _told(world, undisturbed)
    else:
        asked = _how_moved(trial), half_width_m(trial.obj.footprint_m)
        record["feasible"] = is_feasible(*asked, trial.start_xy_m, trial.goal.xy_m)
        record["on_the_rim"] = on_the_rim(*asked, trial.start_xy_m, trial.goal.xy_m)
        record["moved"] = bool(went.steps)
    return record


def _told(world: Tabletop, went: ClosedLoopResult) -> dict[str, Any]:
    """What the tables need of a closed loop; the distance is measured in the world."""
    return {
        "ending": went.status,
        "words": went.message,
        "distance_m": went.goal.distance_m(world.object_pose()[:2]),
        "actions": len(went.steps),
        "plans": len(went.plans),
        "vetoes": went.vetoes,
        "turn_error_rad": went.turn_error_rad,
        "height_error_m": went.height_error_m,
    }


def _how_moved(trial: Trial) -> type[Push] | type[Drag]:
    return Drag if trial.obj.rollable else Push


def _can_be_lifted(world: Tabletop, trial: Trial, went: ClosedLoopResult) -> bool:
    """Whether the object was lifted as high, or a whole grasp at the goal does so, by any hand."""
    high = trial.goal.height_m - WITHIN_HEIGHT_M

    def lifts(grip_yaw: float) -> bool:
        world.place(trial.obj, went.goal.xy_m, went.end_pose[2])
        return bool(
            world.execute_primitive(Grasp(grip_yaw=grip_yaw), record_unreachable=True)
            .effect[:, 2]
            .max()
            >= high
        )

    return went.reached or any(map(lifts, GRIPPER_YAWS_RAD))


def _stays_feasible(
    world: Tabletop, trial: Trial, went: ClosedLoopResult, happened: Sequence[Disturbance]
) -> bool:
    """Whether the kinematics allows a way from the start, and from where the disturbance has left
    the object, as it was first seen after it.

    What happens later is the robot's affair.
    """
    half, start = half_width_m(trial.obj.footprint_m), trial.start_xy_m
    if not is_feasible(_how_moved(trial), half, start, trial.goal.xy_m):
        return False
    if not happened:
        return True
    what = happened[0]
    look = what.action + (what.at_s is not None)
    if went.status == "lost" and len(went.seen_xy_m) == look + 1:
        return what.kind == "goal"
    kind = Drag if world.object_rolls() else Push
    return all(is_feasible(kind, half, xy, went.goal.xy_m) for xy in went.seen_xy_m[look:][:1])


def settings_sha256(table: str, seed: int) -> str:
    """Hash of what decides a table's records: the seed, the models it needs, the code's format."""
    told = hashlib.sha256(f"{FORMATS[table]} {seed}".encode())
    told.update(weights_bytes(repo_root() / REACHABILITY))
    for kind, name in CHECKPOINTS.items():
        if kind in ("push", "drag", POSE_BY.get(table)):
            told.update(checkpoint_sha256(name).encode())
    return told.hexdigest()


def read_records(path: Path, sha256: str) -> dict[int, dict]:
    """Records of a part by index; none where there are none of these settings."""
    if not path.is_file():
        return {}
    head, *lines = path.read_text().splitlines()
    if json.loads(head) != {"settings_sha256": sha256}:
        return {}
    return {r["index"]: r for r in map(json.loads, lines)}


def _part(table: str, seed: int) -> Path:
    return repo_root() / PARTS / f"{table}_{seed}.jsonl"


def _write_records(path: Path, sha256: str, records: dict[int, dict]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    compact = {"allow_nan": False, "separators": (",", ":")}
    lines = [json.dumps(records[k], **compact) for k in sorted(records)]
    write_text_atomically(path, "\n".join([json.dumps({"settings_sha256": sha256}), *lines, ""]))


_here: dict[str, Any] = {}


def _records_of(table: str, indices: Sequence[int], seed: int) -> list[dict]:
    """Some trials in one process, which keeps its world and its models."""
    if not _here:
        _here.update(world=Tabletop(), skills=Skills.load())
    here = _here["world"], _here["skills"], seed
    return [rounded(run_trial(table, i, *here)) for i in indices]


def run_table(
    table: str, n: int, seed: int = 0, client: Client | None = None, progress: bool = True
) -> list[dict]:
    """The records of a table's first n trials, those that are there not made again.

    client: a Dask client that shares the folder; None means this process.
    """
    path, sha256 = _part(table, seed), settings_sha256(table, seed)
    records = read_records(path, sha256)
    missing = [i for i in range(n) if i not in records]
    batches = [missing[k : k + 5] for k in range(0, len(missing), 5)]
    if client is None:
        done = (_records_of(table, batch, seed) for batch in batches)
    else:
        from dask.distributed import as_completed

        futures = [client.submit(_records_of, table, b, seed, pure=False) for b in batches]
        done = (future.result() for future in as_completed(futures))
    for some in tqdm(done, desc=table, total=len(batches), disable=not progress):
        records |= {r["index"]: r for r in some}
        _write_records(path, sha256, records)
    return [records[i] for i in range(n)]


@command(OSError, ValueError)
def main(argv: Sequence[str] | None = None) -> int:
    """Run the trials of the closed loop that are missing, and write the tables."""
    parser = argparse.ArgumentParser(
        prog="python -m experiments.closed_loop", description=main.__doc__
    )
    parser.add_argument("--tables", type=names_type(N_TRIALS), default=",".join(N_TRIALS))
    parser.add_argument("--n", type=count_type, help="trials of each table (default: all)")
    parser.add_argument("--seed", type=seed_type, default=0)
    parser.add_argument("--out", default="data/results")
    parser.add_argument("--scheduler", help="address of a Dask scheduler that shares the folder")
    options = parser.parse_args(argv)
    with dask_client(scheduler=options.scheduler) as client:
        for table in options.tables:
            n = min(options.n or N_TRIALS[table], N_TRIALS[table])
            run_table(table, n, options.seed, client)
    # Also those of earlier runs.
    tables = {}
    for table, rows in ROWS.items():
        part, sha256 = _part(table, options.seed), settings_sha256(table, options.seed)
        if records := read_records(part, sha256):
            tables[table] = rows([records[i] for i in sorted(records)])
        elif part.is_file():
            raise ValueError(
                f"part {part.name} is of other models or code than {table!r} has now; run "
                f"`--tables {table}` again, or delete it"
            )
    name = f"closed_loop_seed{options.seed}" if options.seed else "closed_loop"
    path = write_results(options.out, name, {"seed": options.seed}, tables)
    print(f"{path.name} written")
    return 0


if __name__ == "__main__":
    sys.exit(main())
