"""Exercises of notebooks 00 and 06 to 08: stops and chains, the closed loop, and new objects."""

import math
from collections.abc import Callable
from functools import cache

import numpy as np
import torch

from affordlib import planning
from affordlib.models import load_checkpoint
from affordlib.planning import EffectMap, corners_of, gaps_m, placed
from affordlib.planning.effect_map import poses_along
from affordlib.planning.free_space import ring
from affordlib.planning.grasp_rotate import predict_trajectories
from affordlib.primitives import Grasp, Push
from affordlib.types import Goal, Observation, Obstacle, Plan, Step
from affordlib.world import Cuboid, Prism, Tabletop, UprightCylinder
from exercises.checking import answer_of, exercise, given

BOX = Cuboid(length=0.07, width=0.05, height=0.05)
YAW_RAD, MOST_ACTIONS = 0.3, 9


@cache
def _box_effects() -> EffectMap:
    """The effect map of the box of notebooks 00, 06 and 07."""
    with Tabletop() as world:
        world.place(BOX, yaw_rad=YAW_RAD)
        return EffectMap(load_checkpoint("film_5000")[0], world.depth_image())


@exercise("00.1", 5.0, 0.15, "cm")
def rest_cm(phase: float) -> float:
    """Find the phase at which the push must stop for the box to rest 5 cm from its start.

    A stopped push ends about where the full push passes at that phase.
    Predict the whole effect, and take the phase at which its length passes 5 cm.
    """
    with Tabletop() as world:
        world.place(BOX, yaw_rad=YAW_RAD)
        return 100 * np.hypot(*world.execute_primitive(Push.towards(0.6), phase).rest_effect[:2])


@exercise("00.2", 100.0, 8.0, "% of the answers right")
def right_answers(reaches: Callable) -> float:
    """Write reaches(goal_xy_m): whether one full push brings the box within 2 cm of the goal.

    Every full push of this box has about the same length; only its direction is free.
    Compare the goal's distance from the start with that length, to within the tolerance.
    """
    rng = np.random.default_rng(0)
    far, bearing = 0.15 * np.sqrt(rng.uniform(size=500)), rng.uniform(0, 2 * math.pi, 500)
    goals = np.column_stack([far * np.cos(bearing), far * np.sin(bearing)])
    *_, ends = _box_effects().fine_grid[False]
    true = ends.query(goals)[0] < Goal((0.0, 0.0)).tolerance_m
    return 100 * np.mean([bool(answer_of(reaches, goal)) for goal in goals] == true)


@exercise("06.1", 0.0, 0.1, "mm, largest error")
def chain_error(chain_end: Callable) -> float:
    """Write chain_end(effects, direction, phase): where a chain of pushes brings the object.

    Where a push ends depends on how the object lies when the push begins.
    Ask for the direction minus the turn so far; rotate the answer by the direction.
    """
    effects, rng = _box_effects(), np.random.default_rng(0)
    direction = torch.from_numpy(rng.uniform(-math.pi, math.pi, (50, 3)))
    phase = torch.from_numpy(rng.uniform(0.6, 1.0, (50, 3)))
    with torch.no_grad():
        ends = planning.roll_out(effects, direction, phase)[0][:, -1].numpy()
        answers = [answer_of(chain_end, effects, *d) for d in zip(direction, phase, strict=True)]
    return 1000 * np.linalg.norm(answers - ends, axis=1).max()


@exercise("06.2", 0.0, 3.0, "mm from the goal on average")
def push_error(choose: Callable) -> float:
    """Write choose(effects, goal_xy_m): direction and stop phase of one push to a goal.

    Try many directions and phases together: `effects` takes tensors.
    `ahead` and `left` are in the push frame: rotate them before you compare with the goal.
    """
    off = []
    with Tabletop() as world:
        for bearing, far_m in ((0.2, 0.03), (1.5, 0.04), (2.8, 0.05), (-1.9, 0.06), (-0.6, 0.07)):
            goal = far_m * np.array([math.cos(bearing), math.sin(bearing)])
            direction, phase = answer_of(choose, _box_effects(), goal)
            world.place(BOX, yaw_rad=YAW_RAD)
            went = world.execute_primitive(Push.towards(float(direction)), float(phase))
            off.append(math.dist(goal, went.rest_effect[:2]))
    return 1000 * np.mean(off)


@exercise("06.3", 0.0, 0.001, "mm, largest error")
def gap_error(gap_m: Callable) -> float:
    """Write gap_m(corners, others): the gap between two convex polygons.

    Try the outward normals of the edges of both polygons.
    For each normal, subtract the largest projection of one from the smallest of the other.
    """
    rng, off = np.random.default_rng(0), []
    for _ in range(50):
        triangle = ring(0.03)[np.sort(rng.choice(5, 3, replace=False)) * 3]
        other = placed(BOX.footprint_m, rng.uniform(-0.07, 0.07, 3) * (1, 1, 40))
        expected = gaps_m([other], triangle[None, None].repeat(2, axis=1), far_m=1.0)[0, 0]
        off.append(answer_of(gap_m, triangle, other) - expected)
    return 1000 * np.abs(off).max()


@exercise("06.4", 0.0, 2.0, "mm from the margin, at most")
def stop_error(last_phase: Callable) -> float:
    """Write last_phase(gap_at, margin_m): where a push towards a wall must stop.

    The gap may fall below the margin and rise again.
    Find the first phase at which the gap is too small, and stop before it.
    """
    effects, off, margin_m = _box_effects(), [], 0.004
    with Tabletop() as world:
        for far_m in (0.06, 0.08):
            wall = Obstacle.box((far_m + 0.05, 0.0), (0.02, 0.4))
            world.place(BOX, yaw_rad=YAW_RAD, obstacles=[wall])

            def gap_of(outline: np.ndarray, poses: np.ndarray, wall: Obstacle = wall) -> float:
                return gaps_m([corners_of(wall)], placed(outline, poses), far_m=1.0).item(0)

            def gap_at(phase: float, gap_of: Callable = gap_of) -> float:
                angle, stop = torch.zeros(1, dtype=torch.float64), torch.tensor([float(phase)])
                poses = poses_along(effects, np.zeros((1, 3)), angle, stop.double(), 2)[:, [1, 1]]
                return gap_of(effects.outline_m, poses)

            stop = float(answer_of(last_phase, gap_at, margin_m))
            world.execute_primitive(Push.towards(0.0), stop, approach=True)
            end = np.array([[world.object_pose()] * 2])
            off.append(gap_of(BOX.footprint_m, end) - margin_m)
    return 1000 * np.abs(off).max()


@exercise("07.1", 0.0, 2.5, "mm from the goal on average")
def loop_error(bring: Callable) -> float:
    """Write bring(look, plan, act): observe after every action, and plan again where needed.

    After each action compare what you see with `step.predicted_end_xy_m`.
    Keep the remaining steps while both agree; otherwise plan again from what you see.
    """
    return np.mean([_shoved_mm(bring, s) for s in ((-0.05, -0.06, 1.0), (0.02, 0.08, -0.7))])


def _shoved_mm(bring: Callable, shove: tuple[float, float, float]) -> float:
    """Distance [mm] to the goal in the end; after the first action the object is shoved."""
    model, _ = load_checkpoint("film_5000")
    goal, taken = Goal((0.16, 0.09)), []

    def plan(seen: Observation) -> Plan:
        problem = planning.PlanningProblem(seen.xy_m, goal, EffectMap(model, seen.image))
        return planning.plan_continuous(problem)

    def act(step: Step) -> None:
        if len(taken) == MOST_ACTIONS:
            raise RuntimeError(f"no end after {MOST_ACTIONS} actions")
        world.execute(step)
        taken.append(step)
        if len(taken) == 1:
            world.shove(*shove)

    with Tabletop() as world:
        world.place(BOX, yaw_rad=YAW_RAD)
        given(bring(world.observe, plan, act))
        return 1000 * goal.distance_m(world.object_pose()[:2])


@exercise("07.2", 0.0, 3.0, "mm, largest error")
def lift_error(stop_at: Callable) -> float:
    """Write stop_at(height_m, phase, height_curve_m): where a grasp ends at a height.

    The curve crosses the height once the hand lifts; before that it only trembles.
    Look for the last sample below the height, and interpolate to the next one.
    """
    model, _ = load_checkpoint("grasp_film_1000")
    off = []
    with Tabletop() as world:
        for height_m in (0.03, 0.09, 0.18):
            world.place(UprightCylinder(0.045, 0.06))
            grasp = predict_trajectories(model, world.depth_image(), Grasp(), "z", [0.0])
            stop = float(answer_of(stop_at, height_m, grasp.phase, grasp.mean[0]))
            off.append(world.execute_primitive(Grasp(), stop).effect[-1, 2] - height_m)
    return 1000 * np.abs(off).max()


@exercise("08.1", 100.0, 10.0, "% of the pairs in the right order")
def told_apart(strangeness: Callable) -> float:
    """Write strangeness(image): larger for a house than for a cuboid or a cylinder.

    Rotate the image by half a turn.
    Compare the rotated image with the image; a house differs from itself.
    """
    rng, found = np.random.default_rng(0), ([], [])
    with Tabletop() as world:
        for k in range(80):
            obj = _house(rng) if k % 2 else (Cuboid, UprightCylinder)[k // 2 % 2].sample(rng)
            world.place(obj, yaw_rad=rng.uniform(-math.pi, math.pi))
            found[k % 2].append(float(answer_of(strangeness, world.depth_image())))
    known, houses = found
    return 100 * np.heaviside(np.subtract.outer(houses, known), 0.5).mean()


def _house(rng: np.random.Generator) -> Prism:
    """A square with a gable, as in notebook 08."""
    w = rng.uniform(0.045, 0.06) / 2
    gable = rng.uniform(0.3, 0.9) * w
    return Prism(((-w, -w), (w, -w), (w, w - gable), (0.0, w + gable), (-w, w - gable)), 0.05)


@exercise("08.2", 0.112, 0.01, "mm")
def surest_half(mm: float) -> float:
    """Measure the mean error [mm] of the half of the pushes with the smallest σ.

    Sort the pushes by σ, not by their error.
    Average the errors of the first half, in mm.
    """
    return mm
