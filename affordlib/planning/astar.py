"""A* over (partial) actions (Section 3.4): 36 directions x 20, 40, 60, 80, 100 % of the phase.

The cost of an edge is the distance that the object travels. The heuristic is the Euclidean distance
to the goal, as in the paper, or to the goal's disc, which never overestimates. The search ends at
the first node within the tolerance (2 cm in the paper). A push also rotates the object, so effects
are looked up relative to the predicted yaw, in a table with one entry per degree.
"""

import heapq
import itertools
import math
import time
from collections.abc import Sequence

import numpy as np
import torch

from affordlib.planning.effect_map import EffectMap, make_steps
from affordlib.planning.problem import PlanningProblem
from affordlib.types import Plan, check_array, check_choice, check_count, check_within, on_table

N_DIRECTIONS, MOST_STOPS = 36, 100
HEURISTICS = ("goal", "disc")
STOP_PHASES = (0.2, 0.4, 0.6, 0.8, 1.0)
PRUNE_BELOW_M = 0.001
YAW_STEP_RAD = math.radians(1)
_SAME_PLACE_M = 1e-4
MAX_EXPANSIONS = 20_000


Branches = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]
"""One node's directions (n,), phases (n,), effects (2, n) in the table's frame, rotations (n,)."""


class BranchTable:
    """The branches of an object, by its rotation since its image was taken.

    Rotation is rounded to steps of at most one degree that divide the angle between directions. So
    one query of the map gives the effects in every direction relative to the object.
    """

    def __init__(
        self,
        effects: EffectMap,
        n_directions: int = N_DIRECTIONS,
        stop_phases: Sequence[float] = STOP_PHASES,
    ) -> None:
        n_directions = check_count("n_directions", n_directions, 1, 720)
        stop_phases = check_array("stop_phases", stop_phases).ravel().tolist()
        if len(stop_phases) > MOST_STOPS:
            raise ValueError(f"stop_phases must be at most {MOST_STOPS}, got {len(stop_phases)}")
        stop_phases = [check_within("stop_phases", phase, 1e-3, 1.0) for phase in stop_phases]
        between = 2 * math.pi / n_directions
        finer = math.ceil(between / YAW_STEP_RAD)
        self._step_rad = between / finer
        relative = torch.arange(n_directions * finer, dtype=torch.float64) * self._step_rad
        phases = torch.tensor(stop_phases, dtype=torch.float64)
        self._effects = effects(*torch.meshgrid(relative, phases, indexing="ij"))[0].numpy()
        self._moves = np.hypot(*self._effects[..., :2].T).T >= PRUNE_BELOW_M
        self.effects = effects
        self._first = np.arange(n_directions) * finer
        self._direction = np.repeat(np.arange(n_directions) * between, len(stop_phases))
        self._phase = np.tile(phases.numpy(), n_directions)
        self._kept: dict[int, Branches] = {}

    def at(self, turned_rad: float) -> Branches:
        """The branches of the object rotated by an angle, without those that do not move it."""
        key = round(turned_rad / self._step_rad) % len(self._effects)
        if key not in self._kept:
            rows = (self._first - key) % len(self._effects)
            moves = np.flatnonzero(self._moves[rows])
            ahead, left, turn = self._effects[rows].reshape(-1, 3)[moves].T
            direction = self._direction[moves]
            c, s = np.cos(direction), np.sin(direction)
            effect_m = np.stack([c * ahead - s * left, s * ahead + c * left])
            self._kept[key] = direction, self._phase[moves], effect_m, turn
        return self._kept[key]


def search(
    problem: PlanningProblem,
    table: BranchTable,
    trace: list[tuple[np.ndarray, np.ndarray]] | None = None,
    heuristic: str = "goal",
) -> tuple[list[tuple[float, float]], bool]:
    """Find the best chain of (direction, phase) into the goal's disc, or else the nearest to it.

    Returns the chain, and whether it ends in the disc. The best is the shortest path to the goal
    (heuristic "goal": the remaining distance counts) or to its disc ("disc": it does not). Ties go
    to fewer actions. A node reaches the goal only if `pose_planner` can rotate and lift the object
    there as required. trace, if given, receives each expanded position (2,) with those of its
    children (n, 2).
    """
    check_choice("heuristic", heuristic, HEURISTICS)
    goal, pose_planner, effects = problem.goal, problem.pose_planner, table.effects
    max_steps, tolerance = problem.mode.max_steps, goal.tolerance_m
    radius = tolerance if heuristic == "disc" else 0.0
    nearest, nearest_m = (), goal.distance_m(problem.start_xy_m)
    # The running number breaks ties of f and depth, so the node itself is never compared. f is
    # rounded, so that rounding errors do not choose between two orders of the same actions.
    number = itertools.count()
    root = *problem.start_xy_m, 0.0, 0.0, nearest_m, ()
    frontier = [(max(0.0, nearest_m - radius), 0, next(number), root)]
    expanded: set[tuple[int, ...]] = set()
    reached = False
    while frontier and len(expanded) < MAX_EXPANSIONS:
        _, depth, _, (x, y, turned, way_m, away_m, chain) = heapq.heappop(frontier)
        if away_m < nearest_m - 1e-12:
            nearest, nearest_m = chain, away_m
        if away_m <= tolerance and (
            not pose_planner or pose_planner(goal, (x, y), turned) is not None
        ):
            nearest, reached = chain, True
            break
        cell = (round(x / _SAME_PLACE_M), round(y / _SAME_PLACE_M), round(turned / YAW_STEP_RAD))
        if depth == max_steps or (depth, *cell) in expanded:
            continue
        expanded.add((depth, *cell))
        direction, stop_phase, effect_m, turn_rad = table.at(turned)
        depth += 1
        places = effect_m.T + np.array([x, y])
        away = np.hypot(*(places - goal.xy_m).T)
        if depth == max_steps:
            rows = np.flatnonzero(away < max(nearest_m, tolerance + 1e-12))
        else:
            within_m = tolerance + (max_steps - depth) * effects.reach_m + nearest_m
            rows = np.flatnonzero(away <= within_m)
        rows = rows[on_table(places[rows], effects.radius_m)]
        here = np.broadcast_to((x, y), (len(rows), 2))
        rows = rows[problem.reachable(here, direction[rows])]
        if problem.obstacles and len(rows):
            begins = np.broadcast_to((x, y, turned), (len(rows), 3))
            actions = map(torch.from_numpy, (direction[rows], stop_phase[rows]))
            rows = rows[problem.spare_m(begins, *actions) >= 0]
        if trace is not None:
            trace.append((np.array((x, y)), places[rows]))
        if depth == max_steps and len(rows):
            # At the last depth, only the nearest node outside the goal's disc is kept.
            ends = away[rows] <= tolerance
            ends[away[rows].argmin()] = True
            rows = rows[ends]
        way = way_m + np.hypot(*effect_m[:, rows])
        f = np.round(way + np.maximum(0.0, away[rows] - radius), 12)
        turns, actions = turned + turn_rad[rows], (direction[rows], stop_phase[rows])
        for row in np.column_stack([f, places[rows], turns, way, away[rows], *actions]).tolist():
            node = (*row[1:6], (*chain, tuple(row[6:])))
            heapq.heappush(frontier, (row[0], depth, next(number), node))
    return list(nearest), reached


def plan_astar(
    problem: PlanningProblem,
    n_directions: int = N_DIRECTIONS,
    stop_phases: Sequence[float] = STOP_PHASES,
    heuristic: str = "goal",
) -> Plan:
    """Plan by A*; heuristic: the distance to the "goal", as in the paper, or to its "disc"."""
    began = time.perf_counter()
    stops = tuple(stop_phases) if problem.mode.partial else (1.0,)
    table = BranchTable(problem.effects, n_directions, stops)
    chain, reached = search(problem, table, heuristic=heuristic)
    chain = torch.tensor(chain, dtype=torch.float64).reshape(-1, 2)
    steps = make_steps(problem.effects, problem.start_xy_m, chain)
    return problem.plan_of(steps, "astar", reached, began)
