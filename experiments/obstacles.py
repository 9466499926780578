"""A table with obstacles: what partial actions and each part of the free-space check are worth.

Tasks are drawn with a seed, by an object's dimensions alone, before any planner runs. *Success*: at
most 5 mm from the goal, and neither object nor arm has touched an obstacle, by the contact forces
of every simulation step. *Feasible*: an execution in the clean world has solved it, of any row or
of a search that knows the effects of the simulator.

    python -m experiments.obstacles --only row=continuous,continuous_full
"""

from __future__ import annotations

import copy
import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from typing import Any, Self

import numpy as np
import pandas as pd
import torch

from affordlib.geometry import rotated_each
from affordlib.interactions import open_interactions
from affordlib.interactions.collect import collect
from affordlib.interactions.recipes import Recipe, Variation
from affordlib.models import TrainingConfig, fit_sigma_scale, train
from affordlib.perception import outline_of
from affordlib.planning import PlanMode, PlanningProblem, Skills, execute_plan, free_space
from affordlib.planning.astar import plan_astar
from affordlib.planning.closed_loop import ClosedLoopConfig, run_closed_loop
from affordlib.planning.continuous import plan_continuous
from affordlib.planning.effect_map import poses_along
from affordlib.planning.free_space import N_POSES, FreeSpace, corners_of, gaps_m, placed, ring
from affordlib.planning.gradient import plan_gradient
from affordlib.planning.skills import CHECKPOINTS
from affordlib.primitives import Move, Push
from affordlib.results import resolve_out_dir
from affordlib.types import Goal, Obstacle, UnreachableError
from affordlib.world import (
    CATEGORIES,
    Cuboid,
    Tabletop,
    TabletopObject,
    WorldConfig,
    category_named,
)
from experiments import runner
from experiments.closed_loop import PUSHES, WORLDS, one_tabletop, skills_with
from experiments.commands import command
from experiments.field_baselines import MechanicsMap, plan_cem
from experiments.novelty import FOLDER as STRANGERS
from experiments.novelty import tensors
from experiments.runner import FOLDER, Job, Rows, interval, plain

NAME, SEED, VALIDATION_SEED = "obstacles", 40_001, 40_002
FAMILIES = {"corridor": 30, "pocket": 30, "gate": 40, "bay": 20, "deep bay": 20, "clutter": 100}
"""Tasks of each family; of the validation tasks there are a quarter."""

LONG, LONG_IN, N_LONG = "long_bar", ("corridor", "gate", "bay", "clutter"), 40
"""Further tasks, in turn of these families, with a bar of 10 × 2 cm: longer than all objects of the
training."""

MAX_STEPS, WITHIN_M, WALL_M = 4, 0.005, 0.02
N_OBJECTS = 12  # different objects, each with a yaw; tasks have them in turn

DRAWN = "cuboid", "upright_cylinder", "bar", "sphere", "cuboid", "lying_cylinder"
"""A bar is a cuboid of 8 × 4 cm, the longest within the sizes of the training objects."""


@dataclass(frozen=True)
class LongBar(Cuboid):
    """The bar of these tasks."""

    category = LONG

    @classmethod
    def sample(cls, *_: Any) -> Self:
        """Return the only one."""
        return cls(0.10, 0.02, 0.04)


@dataclass(frozen=True)
class ObstacleTask:
    """An object at the origin with a yaw [rad], obstacles, and a goal to within 5 mm."""

    family: str
    number: int
    obj: TabletopObject
    yaw_rad: float
    goal: Goal
    obstacles: tuple[Obstacle, ...]


def drawn_object(number: int) -> tuple[TabletopObject, float]:
    """Draw an object and its yaw [rad]: in turn a cuboid, a cylinder, a bar, one that rolls.

    Negative numbers are long bars.
    """
    rng = np.random.default_rng([SEED, abs(number)])
    category = DRAWN[number % len(DRAWN)] if number >= 0 else LONG
    bars = {"bar": Cuboid(0.08, 0.04, 0.05), LONG: LongBar.sample()}
    obj = bars.get(category) or category_named(category).sample(rng)
    return obj, float(rng.uniform(-math.pi, math.pi))


def drawn_task(family: str, index: int, seed: int) -> ObstacleTask:
    """Draw a task; those in narrow places have no objects that roll, as the open hand is wider."""
    is_long = family == LONG
    layout = LONG_IN[index % len(LONG_IN)] if is_long else family
    numbers = list(FAMILIES).index(layout) + len(FAMILIES) * is_long, index
    rng = np.random.default_rng([seed, *numbers])

    def turned(xy: Any, angle_rad: float) -> np.ndarray:
        return rotated_each(np.array(xy), np.array(angle_rad))

    while True:
        number = int(rng.integers(N_OBJECTS))
        number = -number - N_OBJECTS if is_long else number
        obj, yaw = drawn_object(number)
        if obj.rollable and layout != "clutter":
            continue
        outline = turned(obj.footprint_m, yaw)
        angle = rng.uniform(-math.pi, math.pi)
        goal, shapes = LAYOUTS[layout](rng, turned(outline, -angle))
        moved = turned([goal, *(one[:2] for one in shapes)], angle)
        goal, *centres = map(tuple, moved.tolist())
        obstacles = tuple(
            Obstacle.box(at, one[2:4], one[4] + angle) if one[3:] else Obstacle.disc(at, one[2])
            for at, one in zip(centres, shapes, strict=True)
        )
        task = ObstacleTask(family, number, obj, yaw, Goal(goal, WITHIN_M), obstacles)
        if _is_fair(task, outline, narrow=layout != "clutter"):
            return task


def _is_fair(task: ObstacleTask, outline: np.ndarray, narrow: bool) -> bool:
    """Whether start and goal are free; in clutter, something must be near the straight way."""
    polygons, goal = [corners_of(one) for one in task.obstacles], np.array(task.goal.xy_m)
    here = np.zeros((1, 2, 3))
    there = here + np.array([*goal, 0.0])
    inner = ring(np.hypot(*outline.T).min())
    free = gaps_m(polygons, placed(outline, here)).min() > (0.003 if narrow else 0.008)
    free &= gaps_m(polygons, placed(inner if narrow else outline, there)).min() > 0.003
    way = np.concatenate([here[:, :1], there[:, :1]], axis=1)
    return bool(free and (narrow or gaps_m(polygons, placed(outline, way)).min() < 0.005))


def _half_m(rng: np.random.Generator, local: np.ndarray) -> float:
    """Half of the width between walls: of the object or the hand, and 6 to 14 mm."""
    return max(float(np.abs(local[:, 1]).max()), 0.03) + rng.uniform(0.006, 0.014)


def _corridor(rng: np.random.Generator, local: np.ndarray) -> tuple:
    half, goal = _half_m(rng, local), (rng.uniform(0.03, 0.12), rng.uniform(-0.003, 0.003))
    walls = [(0.03, s * (half + WALL_M / 2), 0.3, WALL_M, 0.0) for s in (-1, 1)]
    return goal, walls


def _walled(
    rng: np.random.Generator, local: np.ndarray, deep_m: tuple, before_m: tuple = ()
) -> tuple:
    """Two walls with a third behind them, before_m from the object; the goal is deep_m inside."""
    radius = float(np.hypot(*local.T).max())
    mouth = rng.uniform(*before_m) + (radius + 0.01) if before_m else 0.0
    deep, half = rng.uniform(*deep_m), _half_m(rng, local)
    end = mouth + deep + radius + rng.uniform(0.006, 0.014)
    aside = rng.uniform(-0.03, 0.03) if before_m else 0.0
    x, size = (mouth + end) / 2, (end - mouth, WALL_M, 0.0)
    walls = [(x, aside + s * (half + WALL_M / 2), *size) for s in (-1, 1)]
    back = end + WALL_M / 2, aside, WALL_M, 2 * half + 2 * WALL_M, 0.0
    return (mouth + deep, aside), [*walls, back]


def _gate(rng: np.random.Generator, local: np.ndarray) -> tuple:
    half, far = _half_m(rng, local), float(np.hypot(*local.T).max())
    x, y = far + rng.uniform(0.02, 0.06), rng.uniform(-0.04, 0.04)
    walls = [(x, y + s * (half + 0.06), WALL_M, 0.12, 0.0) for s in (-1, 1)]
    return (x + far + rng.uniform(0.01, 0.05), y + rng.uniform(-0.03, 0.03)), walls


def _clutter(rng: np.random.Generator, local: np.ndarray) -> tuple:
    goal, shapes = (rng.uniform(0.08, 0.18), 0.0), []
    for _ in range(rng.integers(1, 6)):
        at = rng.uniform(-0.08, goal[0] + 0.08), rng.uniform(-0.12, 0.12)
        size = rng.uniform(0.02, 0.08, 2)
        box = (*at, *size.tolist(), rng.uniform(0, math.pi))
        shapes.append(box if rng.random() < 0.5 else (*at, size[0] / 2))
    return goal, shapes


LAYOUTS = {
    "corridor": _corridor,
    "pocket": partial(_walled, deep_m=(0.05, 0.08)),
    "gate": _gate,
    "bay": partial(_walled, deep_m=(0.02, 0.04), before_m=(0.03, 0.08)),
    "deep bay": partial(_walled, deep_m=(0.05, 0.08), before_m=(0.10, 0.18)),
    "clutter": _clutter,
}
"""Goal (x, y), and obstacles (x, y, length, width, yaw) or (x, y, radius), ahead of an object whose
outline is given."""


@dataclass(frozen=True)
class PartlyChecked(PlanningProblem):
    """A problem of which only a part is checked.

    check: "goal", the object's pose near the goal; "ends", its pose after each action, and the
    hand; "line", the straight way between these poses, and the hand; "object", its whole way
    without the hand.
    """

    check: str = "line"

    def spare_m(self, begins, direction_rad, phase):
        """Return the gap of what is checked, minus the margin [m] (n,)."""
        poses = poses_along(self.effects, begins, direction_rad, phase, N_POSES)
        space, ends = self.free_space, poses[:, [-1, -1]]
        action, angle = self.effects.kind.towards(0.0), direction_rad.numpy()
        if self.check == "line":
            return space.spare_m(action, angle, phase.numpy(), poses[:, [0, -1]])
        shown = poses if self.check == "object" else ends
        spare = gaps_m(space.polygons, placed(space.outline_m, shown)).min(axis=1)
        spare = spare - space.margin_m(poses[:, -1, :2])
        if self.check == "goal":
            away = np.linalg.norm(ends[:, 0, :2] - np.array(self.goal.xy_m), axis=-1)
            return np.where(away < 0.02, spare, np.inf)
        if self.check == "ends":  # the hand, with an object that is nowhere near
            dot = 1e-4 * ring(1.0)
            hand = FreeSpace(self.obstacles, space.image, self.start_xy_m, dot)
            spare = np.minimum(spare, hand.spare_m(action, angle, phase.numpy(), poses))
        return spare


@lru_cache
def tuned() -> Skills:
    """Skills whose network is tuned as in notebook 08, on 80 pushes of the bar; 20 validate."""
    CATEGORIES[LONG] = LongBar
    path = resolve_out_dir(STRANGERS) / f"{LONG}.zarr.zip"
    collect(Recipe(("push",), 100, 77, (LONG,)), path, progress=False)
    skills = skills_with(PUSHES["clean"])
    model = copy.deepcopy(skills.models["push"])
    sets = (open_interactions("push"), slice(300)), (open_interactions(path), slice(None))
    known, bars = (tensors(data, model).select(rows) for data, rows in sets)
    train(model, known.joined(bars.select(slice(80))), bars.select(slice(80, None)), TUNING)
    fit_sigma_scale(model, bars.select(slice(80, None)))
    return replace(skills, models=skills.models | {"push": model})


TUNING = TrainingConfig(
    600, n_targets=8, patience=99, beta=0.5, final_sigma_floor=0.005, ema=0.99, learning_rate=5e-4
)
"""Training of the tuned network; none of it was chosen."""

OTHERS = {"astar": plan_astar, "gradient": plan_gradient, "cem": plan_cem}
BOTH: dict[str, dict[str, Any]] = {"": {}, "_full": {"partial": False}}
ROWS = {
    "continuous": (plan_continuous, {}),
    "continuous_full": (plan_continuous, {"partial": False}),
    "check_goal": (plan_continuous, {"check": "goal"}),
    "check_ends": (plan_continuous, {"check": "ends"}),
    "check_line": (plan_continuous, {"check": "line"}),
    "check_object": (plan_continuous, {"check": "object"}),
    "perturbed": (plan_continuous, {"world": "perturbed"}),
    "perturbed_full": (plan_continuous, {"world": "perturbed", "partial": False}),
    **{
        f"{name}{change}": (planner, more)
        for name, planner in OTHERS.items()
        for change, more in BOTH.items()
    },
    "no_sigma": (partial(plan_continuous, risk_weight=0.0), {}),
    "film_500": (plan_continuous, {"push": "film_500"}),
    "cnp_500": (plan_continuous, {"push": "cnp_500"}),
    "mechanics": (plan_continuous, {"mechanics": True}),
    "tuned": (plan_continuous, {"push": LONG}),
    "tuned_full": (plan_continuous, {"push": LONG, "partial": False}),
    "tuned_line": (plan_continuous, {"push": LONG, "check": "line"}),
    "closed_loop_tuned": (plan_continuous, {"push": LONG, "observes": True}),
    "closed_loop_tuned_full": (plan_continuous, {"push": LONG, "observes": True, "partial": False}),
    "closed_loop": (plan_continuous, {"observes": True}),
    "closed_loop_full": (plan_continuous, {"observes": True, "partial": False}),
    **{
        f"closed_loop_{name}{change}": (planner, {"observes": True} | more)
        for name, planner in OTHERS.items()
        for change, more in BOTH.items()
    },
    "closed_loop_perturbed": (plan_continuous, {"observes": True, "world": "perturbed"}),
    "closed_loop_perturbed_full": (
        plan_continuous,
        {"observes": True, "world": "perturbed", "partial": False},
    ),
}
"""Planner of each row, and its settings: whether it may stop early, what is checked, the world, the
network of pushes or mechanics instead, and whether it observes after each action, with up to two
actions more."""


def run_task(row: str, family: str, index: int, seed: int) -> Any:
    """Plan and execute a task; return what came of it.

    Rows "margin", "felt" and "search" plan nothing.
    """
    if row in ("margin", "felt"):
        return (calibrate if row == "margin" else felt)(family, index)
    if row == "search":
        return search(family, index, seed)
    planner, settings = ROWS[row]
    task, world = drawn_task(family, index, seed), one_tabletop()
    where = settings.get("world", "clean")
    rng = np.random.default_rng([seed, index])
    config = Variation().sample(task.obj, rng) if where == "perturbed" else WorldConfig()
    world.place(task.obj, (0.0, 0.0), task.yaw_rad, config=config, obstacles=task.obstacles)
    if where == "perturbed":
        world.settle(2.0)
    push = settings.get("push", PUSHES[where])
    skills = tuned() if push == LONG else skills_with(push)
    mode = PlanMode(MAX_STEPS, settings.get("partial", True))
    if settings.get("observes"):
        config = ClosedLoopConfig(mode, MAX_STEPS + 2, max_renewals=0, n_images=WORLDS[where])
        result = run_closed_loop(world, task.goal, skills, planner, config)
        return {"status": result.status} | _outcome(task, world, len(result.steps))
    seen = world.observe()
    effects = skills.effects(seen.image)
    if settings.get("mechanics") and effects.kind is Push:
        effects = MechanicsMap(effects.model, seen.image)
    effects.spline  # noqa: B018 - computed before the time is taken, as by a loop that planned
    posed, more = PlanningProblem, {"obstacles": seen.obstacles}
    if "check" in settings:
        posed, more = PartlyChecked, more | {"check": settings["check"]}
    began = time.perf_counter()
    try:
        plan = planner(posed(seen.xy_m, task.goal, effects, mode, **more))
    except ValueError as error:
        return {"planned": False, "why": str(error), "distance_m": math.hypot(*task.goal.xy_m)}
    seconds, fault = time.perf_counter() - began, False
    try:
        execute_plan(world, plan)
    except UnreachableError:
        fault = True
    about = {"planned": plan.predicted_distance_m <= WITHIN_M, "unreachable": fault}
    return about | _outcome(task, world, len(plan.steps)) | {"plan_s": seconds}


def _outcome(task: ObstacleTask, world: Tabletop, actions: int) -> dict[str, Any]:
    x, y, _ = world.object_pose()
    touched = {what for _, what in world.obstacles.touched}
    about = {f"{name}_touched": name in touched for name in ("object", "arm")}
    return {"distance_m": task.goal.distance_m((x, y)), "actions": actions} | about


N_PUSHES, N_BESIDE, WITHIN_GAP_M = 20, 20, 0.02
"""Actions of a calibration job, obstacles beside each, and the gaps [m] that are counted."""


def beside(rng: np.random.Generator, poses: np.ndarray) -> Callable[[float], Obstacle]:
    """Draw an obstacle; return it as a function of its distance [m] from one of poses (n, 3)."""
    aim, away = poses[rng.integers(N_POSES), :2], rng.uniform(-math.pi, math.pi)
    size, ahead = rng.uniform(0.02, 0.08, 2), np.array([math.cos(away), math.sin(away)])
    yaw = rng.uniform(0, math.pi) if rng.random() < 0.5 else None

    def at(far_m: float) -> Obstacle:
        x, y = (aim + far_m * ahead).tolist()
        return (
            Obstacle.disc((x, y), size[0] / 2) if yaw is None else Obstacle.box((x, y), size, yaw)
        )

    return at


def nearest(at: Callable[[float], Obstacle], is_free: Callable[[Obstacle], bool]) -> Obstacle:
    """Return the obstacle just so far away that it is free."""
    low, high = 0.0, 0.3
    for _ in range(14):
        middle = (low + high) / 2
        low, high = (low, middle) if is_free(at(middle)) else (middle, high)
    return at(high)


def drawn_action(kind: str, index: int, k: int) -> tuple[Any, ...]:
    """Place an object and draw an action of a kind on it.

    Returns the generator, the object and its yaw, the observation, the action, where it stops, and
    the predicted poses (1, n, 3).
    """
    rng, world = np.random.default_rng([VALIDATION_SEED, index, k]), one_tabletop()
    of_kind = (0, 1, 2) if kind == "push" else (3, 5)
    obj, yaw = drawn_object(int(rng.integers(1000)) * 6 + of_kind[k % len(of_kind)])
    world.place(obj, (0.0, 0.0), yaw)
    seen, angle, stop = world.observe(), rng.uniform(-math.pi, math.pi), rng.uniform(0.7, 1.0)
    effects = skills_with(CHECKPOINTS["push"]).effects(seen.image)
    chain = torch.tensor([[angle], [stop]], dtype=torch.float64)
    poses = poses_along(effects, np.zeros((1, 3)), *chain, N_POSES)
    return rng, (obj, yaw), seen, effects.kind.towards(angle), stop, poses


def felt(kind: str, index: int) -> list[dict[str, float]]:
    """Execute pushes beside an obstacle at the margin, and return whether anything touched it."""
    world, found = one_tabletop(), []
    for k in range(N_PUSHES):
        rng, (obj, yaw), seen, action, stop, poses = drawn_action(kind, 1000 + index, k)
        if action.name != kind:
            continue
        known = np.array([action.direction_rad]), np.array([stop]), poses

        def is_free(one: Obstacle, seen=seen, action=action, known=known) -> bool:
            space = FreeSpace([one], seen.image, (0.0, 0.0))
            return space.least_m == free_space.START_M and space.spare_m(action, *known)[0] >= 0

        one = nearest(beside(rng, poses[0]), is_free)
        world.place(obj, (0.0, 0.0), yaw, obstacles=[one])
        world.execute_primitive(action, stop, approach=True)
        touched = {what for _, what in world.obstacles.touched}
        found.append({f"{what}_percent": 100.0 * (what in touched) for what in ("object", "arm")})
    return found


def calibrate(kind: str, index: int) -> list[dict[str, float]]:
    """Execute actions, and return by how much each comes nearer to obstacles than predicted.

    The obstacles lie beside the object's predicted way, just without contact, and are not felt:
    the gap to the recorded way, negative where it would touch, is the error. travel_m: predicted
    distance of the object from its start, where it comes nearest.
    """
    world, found = one_tabletop(), []
    for k in range(N_PUSHES):
        rng, (obj, _), seen, action, stop, poses = drawn_action(kind, index, k)
        outline_m = outline_of(seen.image)
        done = world.execute_primitive(action, stop, approach=True)
        if done.fell or done.left_table or action.name != kind:
            continue
        path = done.object_path[:, [0, 1, 3]][None]
        for _ in range(N_BESIDE):

            def gaps(one: Obstacle, outline_m=outline_m, poses=poses) -> np.ndarray:
                return gaps_m([corners_of(one)], placed(outline_m, poses))[0]

            one = nearest(beside(rng, poses[0]), lambda one, gaps=gaps: gaps(one).min() > 0)
            really = gaps_m([corners_of(one)], placed(obj.footprint_m, path)).min()
            travel = float(np.hypot(*poses[0, gaps(one).argmin(), :2]))
            found.append({"error_m": float(gaps(one).min() - really), "travel_m": travel})
    return found


N_DIRECTIONS, N_STOPS, BEAM, N_TRIES, CLEAR_M = 90, 16, 100, 24, 0.0005
"""Of the search: directions and stops of an action, states that are kept of each length of plan,
plans that are executed, and the gap [m] that they keep."""


@lru_cache(maxsize=N_OBJECTS)
def simulated(number: int) -> tuple[type[Move], np.ndarray, np.ndarray]:
    """Execute full actions with an object, alone on the table, and return their primitive,
    directions [rad] (d,), and the object's poses (d, 301, 3) from its own.
    """
    world, (obj, yaw) = one_tabletop(), drawn_object(number)
    angles, ways = [], []
    for angle in np.linspace(-math.pi, math.pi, N_DIRECTIONS, endpoint=False):
        world.place(obj, (0.0, 0.0), yaw)
        seen = world.observe()
        kind = Skills.kind_for(seen.image)
        done = world.execute_primitive(kind.towards(angle), approach=True, seen=seen)
        if not (done.fell or done.left_table):
            angles.append(angle)
            ways.append(done.object_path[:, [0, 1, 3]] - [0.0, 0.0, yaw])
    return kind, np.array(angles), np.array(ways)


def search(family: str, index: int, seed: int) -> dict[str, Any]:
    """Search plans with the simulator's effects, breadth first, and execute the best ones until one
    succeeds; return what came of it, or of the one that ended nearest.
    """
    task, world = drawn_task(family, index, seed), one_tabletop()
    kind, angles, ways = simulated(task.number)
    world.place(task.obj, (0.0, 0.0), task.yaw_rad, obstacles=task.obstacles)
    outline = placed(task.obj.footprint_m, np.array([0.0, 0.0, task.yaw_rad]))
    space = FreeSpace(task.obstacles, world.observe().image, (0.0, 0.0), outline)
    space.margin_m = lambda xy_m: np.full(np.shape(xy_m)[:-1], CLEAR_M)
    rng, first = np.random.default_rng([seed, index]), kind.acts_from
    stops = np.repeat([np.linspace(first, 1, N_STOPS + 1)[1:]], len(angles), axis=0).ravel()
    which = np.repeat(np.arange(len(angles)), N_STOPS)
    share = (first + (stops[:, None] - first) * np.linspace(0, 1, N_POSES)) * 300
    steps = ways[which[:, None], share.round().astype(int)]
    ends, plans, found = [np.zeros(3)], [()], []
    for _ in range(MAX_STEPS):
        all_ends, all_plans = [], []
        for end, plan in zip(ends, plans, strict=True):
            poses = np.concatenate([placed(steps[..., :2], end), end[2] + steps[..., 2:]], axis=-1)
            turned = angles[which] + end[2]
            free = space.spare_m(kind.towards(0.0), turned, stops, poses) >= 0
            all_ends.extend(poses[free, -1])
            all_plans += [(*plan, one) for one in zip(turned[free], stops[free], strict=True)]
        if not all_ends:
            break
        away = np.linalg.norm(np.array(all_ends)[:, :2] - task.goal.xy_m, axis=1)
        order = np.argsort(away)
        found += [all_plans[k] for k in order[:200] if away[k] < WITHIN_M]
        if len(found) > 2 * N_TRIES:
            break
        order = np.concatenate([order[: len(order) // 4], rng.permutation(order)])
        cells = np.round(np.array(all_ends)[order] / [0.008, 0.008, 0.3])
        kept = np.sort(np.unique(cells, axis=0, return_index=True)[1])[:BEAM]
        ends, plans = ([many[k] for k in order[kept]] for many in (all_ends, all_plans))
    best = {"distance_m": math.hypot(*task.goal.xy_m), "actions": 0}
    for k in rng.permutation(len(found))[:N_TRIES]:
        world.place(task.obj, (0.0, 0.0), task.yaw_rad, obstacles=task.obstacles)
        for angle, stop in found[k]:
            if not world.obstacles.touched:
                world.execute_primitive(kind.towards(angle), stop, approach=True)
        came = _outcome(task, world, len(found[k]))
        if not world.obstacles.touched and came["distance_m"] <= best["distance_m"]:
            best = came
        if best["distance_m"] <= WITHIN_M:
            break
    return best | {"found": len(found)}


def job(row: str, family: str = "", index: int = 0, seed: int = SEED) -> Job:
    """Return the job of a row and a task."""
    arguments = {"row": row, "family": family, "index": index, "seed": seed}
    checkpoints = [*CHECKPOINTS.values(), PUSHES["perturbed"]]
    if row in ROWS and ROWS[row][1].get("push", LONG) != LONG:
        checkpoints.append(ROWS[row][1]["push"])
    version = {
        "margin": 2,
        "closed_loop_perturbed": 5,
        "closed_loop": 4,
        "closed_loop_full": 2,
    }.get(row, 1)
    made_of = ((TUNING, LongBar.sample()), ("push",)) if "tuned" in row else ((), ())
    return Job(run_task, arguments, *made_of, tuple(checkpoints), version)


TASKS = [(family, k, SEED) for family, n in FAMILIES.items() for k in range(n)]
LONG_TASKS = [(LONG, k, SEED) for k in range(N_LONG)]
VALIDATION = [(family, k, VALIDATION_SEED) for family, n in FAMILIES.items() for k in range(n // 4)]
ONCE, LOOPS = ("continuous", "continuous_full"), ("closed_loop", "closed_loop_full")
TUNED = tuple(row for row in ROWS if "tuned" in row)
JOBS = [
    *(job("margin", kind, k) for kind, n in (("push", 3), ("drag", 1)) for k in range(n)),
    *(job("felt", "push", k) for k in range(25)),
    *(job(row, *task) for row in ROWS if row not in TUNED for task in TASKS),
    *(job(row, *task) for row in (*ONCE, *LOOPS, *TUNED) for task in LONG_TASKS),
    *(job(row, *task) for row in ("continuous", *LOOPS) for task in VALIDATION),
]


def tables(folder: str = FOLDER) -> dict[str, Rows]:
    """Return the tables of all stored results."""
    found = runner.read(NAME, job, folder)
    errors = pd.DataFrame([a | e for a, r in found if a["row"] == "margin" for e in r])
    pushes = pd.DataFrame([e for a, r in found if a["row"] == "felt" for e in r])
    records = judged([a | r for a, r in found if isinstance(r, dict)])
    records = records[records.row != "search"]
    validation, records = (records[records.seed == seed] for seed in (VALIDATION_SEED, SEED))
    long, records = records[records.family == LONG], records[records.family != LONG]
    made = {"rows": rows_of(records), "partial_and_full": paired_rows(records)}
    made |= {"long_bar": rows_of(long), "validation": rows_of(validation)}
    beside_them = [{"primitive": "push", "n": len(pushes)} | pushes.mean().to_dict()]
    return {"margin": margin_rows(errors), "felt": beside_them} | made


def margin_rows(errors: pd.DataFrame) -> Rows:
    """Return quantiles of the gap's error [m], and how many touch of what is predicted to pass.

    at_margin_percent: of those that pass at the margin; within_percent: of those that pass by up to
    `WITHIN_GAP_M` more, all gaps being equally frequent.
    """
    rows, start_m = [], free_space.START_M
    for kind, some in errors.groupby("family", sort=False):
        grown = np.minimum(some.travel_m / free_space.FULL_AT_M, 1)
        over = some.error_m - start_m - (free_space.MARGIN_M - start_m) * grown
        row = {"primitive": kind, "n": len(some)}
        row |= {f"q{q}_m": float(some.error_m.quantile(q / 100)) for q in (50, 95, 99)}
        row["at_margin_percent"] = 100 * float((over > 0).mean())
        row["within_percent"] = 100 * float((over / WITHIN_GAP_M).clip(0, 1).mean())
        rows.append(row)
    return rows


def judged(records: Rows) -> pd.DataFrame:
    """Return records of tasks with contact, success, and whether the task is feasible."""
    table = pd.DataFrame(records).fillna({"object_touched": False, "arm_touched": False})
    contact = table.object_touched.astype(bool) | table.arm_touched.astype(bool)
    table = table.assign(contact=contact, success=(table.distance_m <= WITHIN_M) & ~contact)
    solved = table.success & ~table.row.str.contains("perturbed")
    task = [table.family, table["index"], table.seed]
    return table.assign(feasible=solved.groupby(task).transform("any"))


def by_family(table: pd.DataFrame) -> Iterator[tuple[str, pd.DataFrame]]:
    """Yield each family's part of a table, and the whole as "all"."""
    for family in FAMILIES:
        if (table.family == family).any():
            yield family, table[table.family == family]
    yield "all", table


def rows_of(records: pd.DataFrame) -> Rows:
    """Return a row of results for each row of tasks and family."""
    rows = []
    for row, of_row in records.groupby("row", sort=False):
        for family, some in by_family(of_row):
            made = {"row": row, "family": family, "n": len(some)}
            for name in ("success", "contact", "planned"):
                made[f"{name}_percent"] = 100 * some[name].astype(float).mean()
            made |= {"feasible": int(some.feasible.sum())}
            made["of_feasible_percent"] = 100 * float(some.success[some.feasible].mean())
            made["distance_m_median"] = some.distance_m.median()
            rows.append(made | {"actions_mean": some.actions.mean()})
    return plain(rows)


PAIRS = [(row, f"{row}_full") for row in ROWS if f"{row}_full" in ROWS]
PAIRS += [("continuous", row) for row in ROWS if row.startswith("check")]
PAIRS += [("continuous", row) for row in ("cem", "no_sigma", "film_500", "mechanics")]
PAIRS += [("film_500", "cnp_500"), ("no_sigma", "mechanics")]
PAIRS += [("closed_loop", "continuous")]
PAIRS += [("closed_loop_perturbed", "perturbed")]


def paired_rows(records: pd.DataFrame) -> Rows:
    """Return paired differences of success [%] and 95 % intervals, None where all are equal.

    actions, other_actions: mean numbers on the tasks that both solve.
    """
    table, rows = records.drop_duplicates(["family", "index", "row"]), []
    actions = table[table.success].pivot(index=["family", "index"], columns="row", values="actions")
    table = table.pivot(index=["family", "index"], columns="row", values="success")
    for one, other in PAIRS:
        if not {one, other} <= {*table.columns}:
            continue
        both = table[[one, other]].dropna().astype(float).reset_index()
        for family, some in by_family(both):
            off = 100 * (some[one] - some[other])
            mean, low, high = interval(off) if off.nunique() > 1 else (off.iloc[0], None, None)
            row = {"row": one, "other": other, "family": family, "n": len(some)}
            row |= {"successes": int(some[one].sum()), "other_successes": int(some[other].sum())}
            solved = actions.reindex(pd.MultiIndex.from_frame(some[["family", "index"]]))
            solved = solved[[one, other]].dropna().mean()
            row |= {"actions": solved[one], "other_actions": solved[other]}
            rows.append(row | {"difference_percent": mean, "low": low, "high": high})
    return plain(rows)


@command(OSError, ValueError)
def main(argv: Sequence[str] | None = None) -> int:
    """Plan and execute missing tasks, search plans for those not solved, and write the tables."""
    options = runner.parser(NAME, main.__doc__).parse_args(argv)
    runner.make(JOBS, NAME, options, tables)
    if options.only:
        return 0
    rows = judged([a | r for a, r in runner.read(NAME, job, options.raw) if a["row"] in ROWS])
    solved = {*rows[rows.feasible].groupby(["family", "index", "seed"]).groups}
    every = (*TASKS, *LONG_TASKS, *VALIDATION)
    searches = [job("search", *task) for task in every if task not in solved]
    return runner.make(searches, NAME, options, tables)


if __name__ == "__main__":
    raise SystemExit(main())
