"""Exercises of notebooks 00 and 06 to 08: stops and chains, the closed loop, and new objects."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
import torch

from affordlib.models import load_checkpoint
from affordlib.planning import (
    EffectMap,
    PlanningProblem,
    corners_of,
    gaps_m,
    placed,
    plan_continuous,
    roll_out,
)
from affordlib.planning.effect_map import poses_along
from affordlib.planning.free_space import ring
from affordlib.planning.grasp_rotate import predict_trajectories
from affordlib.primitives import Grasp, Push
from affordlib.types import Goal, Observation, Obstacle, Plan, Step
from affordlib.world import Cuboid, Prism, Tabletop, UprightCylinder
from exercises.checking import Exercise, answer_of, answered
from exercises.world import rest_cm

BOX = Cuboid(length=0.07, width=0.05, height=0.05)
YAW_RAD = 0.3


@cache
def _box_effects() -> EffectMap:
    """The effect map of the box of notebooks 00, 06 and 07."""
    with Tabletop() as world:
        world.place(BOX, yaw_rad=YAW_RAD)
        return EffectMap(load_checkpoint("film_5000")[0], world.depth_image())


# 00 Start here


def _right_percent(reaches: Callable[[np.ndarray], bool]) -> float:
    """Share [%] of 500 goals up to 15 cm away for which the answer is right."""
    rng = np.random.default_rng(0)
    far, bearing = 0.15 * np.sqrt(rng.uniform(size=500)), rng.uniform(0, 2 * math.pi, 500)
    goals = np.column_stack([far * np.cos(bearing), far * np.sin(bearing)])
    *_, ends = _box_effects().fine_grid
    true = ends[False].query(goals)[0] < Goal((0.0, 0.0)).tolerance_m
    return 100 * float(
        np.mean([bool(answer_of(reaches, g)) == t for g, t in zip(goals, true, strict=True)])
    )


# 06 Planning


def _chain_error_mm(chain_end: Callable[..., Any]) -> float:
    """Largest difference [mm] from where 50 random chains of three pushes lead."""
    effects, rng = _box_effects(), np.random.default_rng(0)
    direction = torch.from_numpy(rng.uniform(-math.pi, math.pi, (50, 3)))
    phase = torch.from_numpy(rng.uniform(0.6, 1.0, (50, 3)))
    with torch.no_grad():
        ends = roll_out(effects, direction, phase)[0][:, -1].numpy()
        given = [answer_of(chain_end, effects, d, p) for d, p in zip(direction, phase, strict=True)]
    return 1000 * float(np.hypot(*(np.array(given) - ends).T).max())


def _push_error_mm(choose: Callable[..., Any]) -> float:
    """Mean distance [mm] between goals 3 to 7 cm away and where the chosen pushes end."""
    off = []
    with Tabletop() as world:
        for bearing, far_m in ((0.2, 0.03), (1.5, 0.04), (2.8, 0.05), (-1.9, 0.06), (-0.6, 0.07)):
            goal = far_m * np.array([math.cos(bearing), math.sin(bearing)])
            direction, phase = answer_of(choose, _box_effects(), goal)
            world.place(BOX, yaw_rad=YAW_RAD)
            went = world.execute_primitive(Push.towards(float(direction)), float(phase))
            off.append(math.dist(goal, went.rest_effect[:2]))
    return 1000 * float(np.mean(off))


def _gap_error_mm(gap_m: Callable[..., Any]) -> float:
    """Largest error [mm] of the gaps of 50 pairs of random triangles and boxes."""
    rng, off = np.random.default_rng(0), []
    for _ in range(50):
        triangle = ring(0.03)[np.sort(rng.choice(5, 3, replace=False)) * 3]
        other = placed(BOX.footprint_m, rng.uniform(-0.07, 0.07, 3) * (1, 1, 40))
        expected = gaps_m([other], triangle[None, None].repeat(2, axis=1), far_m=1.0)[0, 0]
        off.append(abs(float(answer_of(gap_m, triangle, other)) - expected))
    return 1000 * max(off)


def _stop_error_mm(last_phase: Callable[..., Any]) -> float:
    """Largest error [mm] of the gap to a wall ahead, where executed pushes have stopped."""
    effects, off, margin_m = _box_effects(), [], 0.004
    with Tabletop() as world:
        for far_m in (0.06, 0.08):
            wall = Obstacle.box((far_m + 0.05, 0.0), (0.02, 0.4))
            world.place(BOX, yaw_rad=YAW_RAD, obstacles=[wall])

            def gap_at(phase: float, wall: Obstacle = wall) -> float:
                angle, stop = torch.zeros(1, dtype=torch.float64), torch.tensor([float(phase)])
                poses = poses_along(effects, np.zeros((1, 3)), angle, stop.double(), 2)[:, [1, 1]]
                shapes = placed(effects.outline_m, poses)
                return float(gaps_m([corners_of(wall)], shapes, far_m=1.0)[0, 0])

            stop = float(answer_of(last_phase, gap_at, margin_m))
            world.execute_primitive(Push.towards(0.0), stop, approach=True)
            end = np.array([[world.object_pose()] * 2])
            gap = gaps_m([corners_of(wall)], placed(BOX.footprint_m, end), far_m=1.0)[0, 0]
            off.append(abs(float(gap) - margin_m))
    return 1000 * max(off)


# 07 Closed loop

MOST_ACTIONS = 9


def _loop_error_mm(bring: Callable[..., Any]) -> float:
    """Mean distance [mm] to the goal in the end, of two objects that somebody shoves."""
    return float(np.mean([_shoved_mm(bring, s) for s in ((-0.05, -0.06, 1.0), (0.02, 0.08, -0.7))]))


def _shoved_mm(bring: Callable[..., Any], shove: tuple[float, float, float]) -> float:
    """Distance [mm] to the goal in the end; after the first action the object is shoved."""
    model, _ = load_checkpoint("film_5000")
    goal, taken = Goal((0.16, 0.09)), []

    def plan(seen: Observation) -> Plan:
        effects = EffectMap(model, seen.image)
        return plan_continuous(PlanningProblem(seen.xy_m, goal, effects))

    def act(step: Step) -> None:
        if len(taken) == MOST_ACTIONS:
            raise RuntimeError(f"no end after {MOST_ACTIONS} actions")
        world.execute(step)
        taken.append(step)
        if len(taken) == 1:
            world.shove(*shove)

    with Tabletop() as world:
        world.place(BOX, yaw_rad=YAW_RAD)
        answered(bring, world.observe, plan, act)
        return 1000 * goal.distance_m(world.object_pose()[:2])


def _lift_error_mm(stop_at: Callable[..., Any]) -> float:
    """Largest difference [mm] from the desired heights."""
    model, _ = load_checkpoint("grasp_film_1000")
    off = []
    with Tabletop() as world:
        for height_m in (0.03, 0.09, 0.18):
            world.place(UprightCylinder(0.045, 0.06))
            grasp = predict_trajectories(model, world.depth_image(), Grasp(), "z", [0.0])
            stop = float(answer_of(stop_at, height_m, grasp.phase, grasp.mean[0]))
            off.append(abs(world.execute_primitive(Grasp(), stop).effect[-1, 2] - height_m))
    return 1000 * max(off)


# 08 Beyond


@cache
def _looks() -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Images of 40 cuboids and cylinders, and of 40 houses."""
    rng = np.random.default_rng(0)
    images: tuple[list[np.ndarray], list[np.ndarray]] = [], []
    with Tabletop() as world:
        for k in range(80):
            obj = _house(rng) if k % 2 else (Cuboid, UprightCylinder)[k // 2 % 2].sample(rng)
            world.place(obj, yaw_rad=rng.uniform(-math.pi, math.pi))
            images[k % 2].append(world.depth_image())
    return images


def _house(rng: np.random.Generator) -> Prism:
    """A square with a gable, as in notebook 08."""
    w = rng.uniform(0.045, 0.06) / 2
    gable = rng.uniform(0.3, 0.9) * w
    return Prism(((-w, -w), (w, -w), (w, w - gable), (0.0, w + gable), (-w, w - gable)), 0.05)


def _told_apart_percent(strangeness: Callable[..., Any]) -> float:
    """Share [%] of pairs of a known object and a house of which the house is the stranger."""
    known, houses = ([float(answer_of(strangeness, image)) for image in some] for some in _looks())
    more = np.subtract.outer(houses, known)
    return 100 * float((more > 0).mean() + 0.5 * (more == 0).mean())


START: dict[str, Exercise] = {
    "00.1": Exercise(
        "Find the phase at which the push must stop for the box to rest 5 cm from its start.",
        lambda phase: rest_cm(phase, YAW_RAD),
        expected=5.0,
        within=0.15,
        unit="cm",
    ),
    "00.2": Exercise(
        "Write reaches(goal_xy_m): whether one full push brings the box within 2 cm of the goal.",
        _right_percent,
        expected=100.0,
        within=8.0,
        unit="% of the answers right",
    ),
}

PLANS: dict[str, Exercise] = {
    "06.1": Exercise(
        "Write chain_end(effects, direction, phase): where a chain of pushes brings the object.",
        _chain_error_mm,
        expected=0.0,
        within=0.1,
        unit="mm, largest error",
    ),
    "06.2": Exercise(
        "Write choose(effects, goal_xy_m): direction and stop phase of one push to a goal.",
        _push_error_mm,
        expected=0.0,
        within=3.0,
        unit="mm from the goal on average",
    ),
    "06.3": Exercise(
        "Write gap_m(corners, others): the gap between two convex polygons.",
        _gap_error_mm,
        expected=0.0,
        within=0.001,
        unit="mm, largest error",
    ),
    "06.4": Exercise(
        "Write last_phase(gap_at, margin_m): where a push towards a wall must stop.",
        _stop_error_mm,
        expected=0.0,
        within=2.0,
        unit="mm from the margin, at most",
    ),
    "07.1": Exercise(
        "Write bring(look, plan, act): observe after every action, and plan again where needed.",
        _loop_error_mm,
        expected=0.0,
        within=2.5,
        unit="mm from the goal on average",
    ),
    "07.2": Exercise(
        "Write stop_at(height_m, phase, height_curve_m): where a grasp ends at a height.",
        _lift_error_mm,
        expected=0.0,
        within=3.0,
        unit="mm, largest error",
    ),
    "08.1": Exercise(
        "Write strangeness(image): larger for a house than for a cuboid or a cylinder.",
        _told_apart_percent,
        expected=100.0,
        within=10.0,
        unit="% of the pairs in the right order",
    ),
    "08.2": Exercise(
        "Measure the mean error [mm] of the half of the pushes with the smallest σ.",
        lambda mine: mine,
        expected=0.112,
        within=0.01,
        unit="mm",
    ),
}
