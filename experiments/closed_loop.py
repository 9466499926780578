"""Evaluation of the closed loop: height, orientation, disturbances, reachability of random goals.

    python -m experiments.closed_loop --only table=height,orientation

Trial i of a table is a function of the seed and i: object, start, goal and disturbances are sampled
before planning, with objects that no model has seen. Each trial is run in the clean world with the
ideal camera, and in a perturbed one (`Variation`) with the Kinect; `open_loop` trials execute a
plan made from a single image in the clean world. Errors are ground truth of the simulator, which
the robot does not know. Whether a goal is feasible is determined by the arm's kinematics (position)
and by full grasps (height), never by the planner under test.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cache, lru_cache, partial
from itertools import islice, product
from typing import Any

import numpy as np
import pandas as pd
from scipy.spatial import ConvexHull

from affordlib.interactions.recipes import Variation
from affordlib.models import load_checkpoint
from affordlib.planning import Robot, Skills, execute_plan, plan_continuous
from affordlib.planning.closed_loop import ClosedLoopConfig, ClosedLoopResult, run_closed_loop
from affordlib.planning.grasp_rotate import GRIPPER_YAWS_RAD
from affordlib.planning.skills import CHECKPOINTS
from affordlib.primitives import Grasp, move_for
from affordlib.types import TABLE_X_M, TABLE_Y_M, Goal, UnreachableError, check_choice
from affordlib.world import Tabletop, TabletopObject, WorldConfig, category_named
from experiments.disturbances import KINDS, Disturbance, DisturbanceSchedule
from experiments.feasibility import half_width_m, is_feasible, on_the_rim
from experiments.runner import FOLDER, Job, Rows, command_of, hash_of, plain, read

N_TRIALS = {"height": 50, "orientation": 50, "disturbances": 200, "reachability": 1000}
N_TRIALS |= {"orientation_unseen": 50}

POSE_PRIMITIVES = {"height": "grasp", "orientation": "rotate", "orientation_unseen": "rotate"}
CATEGORIES = {"orientation": ("cuboid", "lying_cylinder", "prism")}
CATEGORIES["orientation_unseen"] = ("upright_cylinder", "sphere")
FOUR_CATEGORIES = ("cuboid", "upright_cylinder", "lying_cylinder", "sphere")  # of other tables

OPEN_LOOP, WORLDS = "open_loop", {"clean": 1, "perturbed": 8}
"""Worlds, and the number of images over which an observation averages in each."""
PUSHES = dict.fromkeys(("clean", OPEN_LOOP), CHECKPOINTS["push"])
PUSHES["perturbed"] = "film_5000_perturbed"  # checkpoint of pushes in each world

AT_REST_S = 3.0  # time [s] in which an object of the perturbed world settles before a trial starts
SMALLEST_M2 = 0.001  # models reject objects much smaller than those they were trained on
TOLERANCE_M = dict.fromkeys(POSE_PRIMITIVES, 0.004)
"""Position tolerance [m] if not 2 mm; it is larger here because gripping shifts objects."""

WITHIN_M, WITHIN_HEIGHT_M, WITHIN_TURN_RAD = 0.005, 0.005, math.radians(3)
STATUSES = ("reached", "unreachable", "gave_up", "lost")
ARRIVED = ("reached", "unconfirmed")
"""Statuses of a loop that count as reached here, where the simulator measures the errors."""
EDGE_M = 0.05  # smallest distance [m] of a goal of `reachability` from the table's edge


@dataclass(frozen=True)
class Trial:
    """One task: object, start position and yaw, goal, disturbances and world parameters."""

    obj: TabletopObject
    start_xy_m: tuple[float, float]
    yaw_rad: float
    goal: Goal
    disturbances: tuple[Disturbance, ...] = ()
    config: WorldConfig = field(default_factory=WorldConfig)

    def place(self, world: Tabletop) -> tuple[float, float]:
        """Place the object, wait until it is at rest, and return its yaw [rad] and height [m]."""
        world.place(self.obj, self.start_xy_m, self.yaw_rad, config=self.config)
        if self.config != WorldConfig():
            world.settle(AT_REST_S)
        return world.object_pose()[2], world.object_state()[2]


def sample_trial(table: str, index: int, seed: int = 0, world: str = "clean") -> Trial:
    """Sample trial `index` of a table, a pure function of its arguments, equal in each world."""
    number = list(N_TRIALS).index(check_choice("table", table, N_TRIALS))
    keys = ((first + number, index) for first in (100, 200))
    seeds = (np.random.SeedSequence(2_000_003 + seed, spawn_key=key) for key in keys)
    rng, of_world = map(np.random.default_rng, seeds)
    categories = CATEGORIES.get(table, FOUR_CATEGORIES)
    obj = category_named(categories[index % len(categories)]).sample(rng)
    while ConvexHull(obj.footprint_m).volume < SMALLEST_M2:
        obj = type(obj).sample(rng)
    config = Variation().sample(obj, of_world) if world == "perturbed" else WorldConfig()
    trial = partial(Trial, obj, (0.0, 0.0), float(rng.uniform(-math.pi, math.pi)), config=config)
    tolerance_m = TOLERANCE_M.get(table, 0.002)
    if table == "reachability":
        low, high = (np.array([TABLE_X_M[k], TABLE_Y_M[k]]) for k in (0, 1))
        end = rng.uniform(low + EDGE_M, high - EDGE_M).tolist()
        return trial(Goal(tuple(end), tolerance_m))
    farthest = 0.25 if table == "disturbances" else 0.12
    r, angle = math.sqrt(rng.uniform(0.02**2, farthest**2)), rng.uniform(-math.pi, math.pi)
    goal = Goal((r * math.cos(angle), r * math.sin(angle)), tolerance_m)
    if table == "height":
        return trial(replace(goal, height_m=float(rng.uniform(0.02, 0.2))))
    if table.startswith("orientation"):
        return trial(replace(goal, turn_rad=float(rng.uniform(-math.pi, math.pi))))
    n_actions = max(1, math.ceil(r / 0.09))
    kinds = [kind for kind in KINDS if kind != "topple" or not obj.rollable]
    disturbances = (sample_disturbance(int(rng.integers(2**32)), n_actions, kinds),)
    return trial(goal, disturbances)


def sample_disturbance(seed: int, n_actions: int = 2, kinds: Sequence[str] = KINDS) -> Disturbance:
    """Sample a disturbance during one of n_actions actions or after it, by the seed alone."""
    rng = np.random.default_rng(seed)
    kind = str(rng.choice(list(kinds)))
    action, angle = int(rng.integers(n_actions)), rng.uniform(-math.pi, math.pi)
    low, high = (0.2, 0.5) if kind == "knock" else (0.03, 0.1)
    size = rng.uniform(low, high)
    turn = rng.uniform(-math.pi, math.pi) if kind == "shove" else 0.0
    middle = kind == "knock" or (kind != "shove" and rng.random() < 0.5)
    at_s = float(rng.uniform(2.0, 5.5)) if middle else None
    xy = float(size * math.cos(angle)), float(size * math.sin(angle))
    return Disturbance(kind, action + (not middle), *xy, float(turn), at_s)


one_tabletop = cache(Tabletop)  # one world per process


@lru_cache(maxsize=2)
def skills_with(push: str) -> Skills:
    """Load the skills with a checkpoint of pushes; cached between jobs."""
    skills = Skills.load()
    return replace(skills, models=skills.models | {"push": load_checkpoint(push)[0]})


def run_trial(table: str, index: int, seed: int = 0, world: str = "clean") -> dict[str, Any]:
    """Run a trial and return its record: result, errors and whether the goal was feasible."""
    tabletop, skills = one_tabletop(), skills_with(PUSHES[world])
    trial = sample_trial(table, index, seed, world)
    if world == OPEN_LOOP:
        return run_open_loop(tabletop, skills, trial)
    robot = DisturbanceSchedule(tabletop, trial.goal, trial.disturbances)

    def pursue(goal: Goal | Callable[[], Goal], robot: Robot) -> tuple[ClosedLoopResult, dict]:
        yaw, z = trial.place(tabletop)
        config = ClosedLoopConfig(n_images=WORLDS[world])
        result = run_closed_loop(robot, goal, skills, config=config)
        about = {"status": "reached" if result.status in ARRIVED else result.status}
        about |= {"message": result.message, "actions": len(result.steps)}
        return result, about | _errors(tabletop, result.goal, yaw, z)

    result, measured = pursue(robot.current_goal, robot)
    record = {"object_class": trial.obj.category, **measured}
    if table == "height":
        record["feasible"] = _can_be_lifted(tabletop, trial, result)
    elif table in POSE_PRIMITIVES:
        record["feasible"] = True
    elif table == "disturbances":
        record["feasible"] = _stays_feasible(tabletop, trial, result, robot.happened)
        record["kind"] = trial.disturbances[0].kind
        record["undisturbed"] = pursue(trial.goal, tabletop)[1]
    else:
        kind, half = move_for(trial.obj.rollable), half_width_m(trial.obj.footprint_m)
        query = kind, half, trial.start_xy_m, trial.goal.xy_m
        record |= {"feasible": is_feasible(*query), "on_the_rim": on_the_rim(*query)}
    return record


def run_open_loop(world: Tabletop, skills: Skills, trial: Trial) -> dict[str, Any]:
    """Plan and execute one pose goal, even if the planner predicts a failure; return its record."""
    yaw, z = trial.place(world)
    plan = plan_continuous(skills.problem(world.depth_image(), trial.start_xy_m, trial.goal))
    with suppress(UnreachableError):
        execute_plan(world, plan)
    errors = _errors(world, trial.goal, yaw, z)
    world.park()
    about = {"object_class": trial.obj.category, "status": "reached", "feasible": True}
    return about | {"actions": len(plan.steps)} | errors


def _errors(world: Tabletop, goal: Goal, yaw: float, z: float) -> dict[str, float | None]:
    """Return the true errors; yaw, z: initial yaw [rad] and height [m] of the object."""
    pose = world.object_pose()
    errors = goal.errors(pose[:2], pose[2] - yaw, world.object_state()[2] - z)
    named = {"position": "distance_m", "orientation": "turn_error_rad", "height": "height_error_m"}
    return {name: errors[of].left if of in errors else None for of, name in named.items()}


def _can_be_lifted(world: Tabletop, trial: Trial, result: ClosedLoopResult) -> bool:
    """Return whether the object was lifted, or a full grasp at the goal lifts it, at any yaw."""
    high, yaw_rad = trial.goal.height_m - WITHIN_HEIGHT_M, world.object_pose()[2]

    def lifts(grip_yaw: float) -> bool:
        replace(trial, start_xy_m=result.goal.xy_m, yaw_rad=yaw_rad).place(world)
        done = world.execute_primitive(Grasp(grip_yaw=grip_yaw), record_unreachable=True)
        return bool(done.effect[:, 2].max() >= high)

    return result.status in ARRIVED or any(map(lifts, GRIPPER_YAWS_RAD))


def _stays_feasible(
    world: Tabletop, trial: Trial, result: ClosedLoopResult, happened: Sequence[Disturbance]
) -> bool:
    """Return whether routes exist from the start, and from where it was first seen when moved."""
    kind, half = move_for(trial.obj.rollable), half_width_m(trial.obj.footprint_m)
    if not is_feasible(kind, half, trial.start_xy_m, trial.goal.xy_m):
        return False
    if not happened:
        return True
    disturbance = happened[0]
    first = disturbance.action + (disturbance.at_s is not None)
    if result.status == "lost" and len(result.seen_xy_m) <= first + 1:  # off the table, or unseen
        return disturbance.kind == "goal"
    kind = move_for(world.placed.rolls())
    seen = result.seen_xy_m[first:][:1]
    return all(is_feasible(kind, half, xy, result.goal.xy_m) for xy in seen)


def _groups(table: pd.DataFrame, *by: str) -> Iterator[tuple[dict[str, Any], pd.DataFrame]]:
    """Yield all records and those of each value of some columns, with the common columns."""
    groups = [({}, table)]
    groups += [({k: value}, some) for k in by for value, some in table.groupby(k, sort=False)]
    for about, some in groups:
        row = dict.fromkeys(by, "all") | about | {"n": len(some), "feasible": some.feasible.sum()}
        yield row | {name: (some.status == name).sum() for name in STATUSES}, some


def pose_rows(records: Rows, column: str, within: float, unit: str) -> Rows:
    """Return rates of success (within: [m] or [rad]) at feasible goals, and errors if reached."""
    rows = []
    for row, some in _groups(pd.DataFrame(records), "object_class"):
        feasible = some[some.feasible]
        reached = feasible[feasible.status == "reached"]
        hit, error = feasible[column].abs() <= within, reached[column].abs()
        row["within_percent"] = 100 * (hit & (feasible.distance_m <= WITHIN_M)).mean()
        row[f"pose_error_{unit}_mean"] = error.mean()
        row[f"pose_error_{unit}_p95"] = error.quantile(0.95)
        rows.append(row)
    return plain(rows)


def disturbance_rows(records: Rows) -> Rows:
    """Return the rows of `disturbances`, with means over all feasible trials, reached or not."""
    rows, table = [], pd.json_normalize(list(records), sep="_")
    for row, some in _groups(table, "kind", "object_class"):
        feasible = some[some.feasible]
        row["within_percent"] = 100 * (feasible.distance_m <= WITHIN_M).mean()
        row["disturbed_mean_m"] = feasible.distance_m.mean()
        row["undisturbed_mean_m"] = feasible.undisturbed_distance_m.mean()
        row["actions_mean"] = feasible.actions.mean()
        rows.append(row | {"undisturbed_actions_mean": feasible.undisturbed_actions.mean()})
    return plain(rows)


def reachability_rows(records: Rows) -> Rows:
    """Return the rows of `reachability`: rates for all goals, and without or with those on the rim.

    A result is right if the goal was reached, or is 'unreachable' according to the kinematics too.
    """
    table, rows = pd.DataFrame(records), []
    table["right"] = table.status == table.feasible.map({True: "reached", False: "unreachable"})
    rim = table.on_the_rim
    for goals, some in {"all": table, "off the rim": table[~rim], "on the rim": table[rim]}.items():
        groups = _groups(some, "object_class")
        for row, group in groups if goals == "all" else islice(groups, min(1, len(some))):
            feasible = group.feasible
            row["right_percent"] = 100 * group.right.mean()
            row["feasible_reached_percent"] = 100 * group.right[feasible].mean()
            row["within_percent"] = 100 * (group.distance_m[feasible] <= WITHIN_M).mean()
            row["infeasible_refused_percent"] = 100 * group.right[~feasible].mean()
            rows.append({"goals": goals} | row)
    return plain(rows)


_LIFTS = partial(pose_rows, column="height_error_m", within=WITHIN_HEIGHT_M, unit="m")
_TURNS = partial(pose_rows, column="turn_error_rad", within=WITHIN_TURN_RAD, unit="rad")
ROWS = {"height": _LIFTS, "orientation": _TURNS, "orientation_unseen": _TURNS}
ROWS |= {"disturbances": disturbance_rows, "reachability": reachability_rows}


def job(table: str, index: int, seed: int, world: str = "clean") -> Job:
    """Return the job that runs one trial of the closed loop."""
    arguments: dict[str, Any] = {"table": table, "index": index, "seed": seed}
    arguments |= {"world": world} if world != "clean" else {}
    used = ("push", "drag", POSE_PRIMITIVES.get(table))
    models = CHECKPOINTS | {"push": PUSHES[world]}
    files = tuple(file for kind, file in models.items() if kind in used)
    reach = hash_of("reachability", "checkpoint")
    return Job(run_trial, arguments, reach, (), files, version=5)


def tables(folder: str = FOLDER) -> dict[str, Rows]:
    """Return the tables of the trials in a folder; trials with seeds other than 0 are ignored."""
    results = read("closed_loop", job, folder)
    found = [{"world": "clean"} | about | record for about, record in results]
    found.sort(key=lambda record: record["index"])
    made: dict[str, Rows] = {}
    for table, world in product(ROWS, (*WORLDS, OPEN_LOOP)):
        mine = {"table": table, "seed": 0, "world": world}
        if some := [r for r in found if mine.items() <= r.items()]:
            made.setdefault(table, []).extend({"world": world} | row for row in ROWS[table](some))
    return made


JOBS = [
    job(table, index, 0, world)
    for table, world in [*product(ROWS, WORLDS), ("height", OPEN_LOOP), ("orientation", OPEN_LOOP)]
    for index in range(N_TRIALS[table])
]

main = command_of("closed_loop", __doc__, lambda: JOBS, tables)

if __name__ == "__main__":
    raise SystemExit(main())
