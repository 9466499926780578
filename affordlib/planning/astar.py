"""A* over (partial) actions (Section 3.4): 36 directions x 20, 40, 60, 80, 100 % of the phase.

An edge costs the distance that the object travels; the heuristic is the Euclidean distance to the
goal's disc, max(0, d - tolerance), which never overestimates. The search ends at the first node
within the tolerance (2 cm in the paper). A push turns the object as well, so its effects are looked
up relative to the yaw that the model predicts; they are kept by degrees and used again.
"""

from __future__ import annotations

import heapq
import itertools
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from affordlib.planning.effect_map import EffectMap
from affordlib.planning.problem import PlanningProblem, is_on_table
from affordlib.planning.rollout import make_steps
from affordlib.types import Plan, check_count, check_within

N_DIRECTIONS = 36
STOP_PHASES = (0.2, 0.4, 0.6, 0.8, 1.0)
PRUNE_BELOW_M = 0.001
YAW_STEP_RAD = math.radians(1)
_SAME_PLACE_M = 1e-4


@dataclass(frozen=True)
class Branches:
    """Every action of the search, and what it does to the object as it is turned now.

    direction, stop_phase: (n,); effect_m: (2, n) along the table's axes; turn_rad: (n,).
    """

    direction: np.ndarray
    stop_phase: np.ndarray
    effect_m: np.ndarray
    turn_rad: np.ndarray


class BranchTable:
    """The branches of an object by how far it has turned since its image was taken.

    It turns in steps of at most a degree that divide those between the directions, so the map is
    queried once: for the effects in every direction relative to the object.
    """

    def __init__(
        self,
        effects: EffectMap,
        n_directions: int = N_DIRECTIONS,
        stop_phases: Sequence[float] = STOP_PHASES,
    ) -> None:
        check_count("n_directions", n_directions, 1, 720)
        stop_phases = [check_within("stop_phases", phase, 1e-3, 1.0) for phase in stop_phases]
        if not stop_phases:
            raise ValueError("stop_phases must hold at least one phase in (0, 1], got none")
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
        """The branches of the object turned by an angle; those that do nothing are left out."""
        key = round(turned_rad / self._step_rad) % len(self._effects)
        if key not in self._kept:
            rows = (self._first - key) % len(self._effects)
            moves = np.flatnonzero(self._moves[rows])
            ahead, left, turn = self._effects[rows].reshape(-1, 3)[moves].T
            direction = self._direction[moves]
            c, s = np.cos(direction), np.sin(direction)
            effect_m = np.stack([c * ahead - s * left, s * ahead + c * left])
            self._kept[key] = Branches(direction, self._phase[moves], effect_m, turn)
        return self._kept[key]


@dataclass(slots=True)
class _Children:
    """Where the actions from one node lead: arrays over the actions, and the node they are from.

    A node of the search is one row of its parent's children.
    """

    parent: tuple[_Children, int] | None
    xy_m: np.ndarray
    turned: np.ndarray
    way_m: np.ndarray
    away_m: np.ndarray
    direction: np.ndarray
    stop_phase: np.ndarray


def search(
    problem: PlanningProblem,
    table: BranchTable,
    max_expansions: int = 20_000,
    trace: list[tuple[np.ndarray, np.ndarray]] | None = None,
) -> tuple[list[tuple[float, float]], bool, int]:
    """The cheapest chain of (direction, phase) into the goal's disc, whether it gets there, and
    how many nodes were expanded.

    Where no chain does, the one that ends nearest. Ties go to fewer actions. No action leads where
    a part of the object would be off the table, or begins out of reach; a node from which the
    object cannot be turned and lifted as the goal asks is none of the goal's. trace, if given,
    receives each expanded position (2,) with those of its children (n, 2).
    """
    goal, pose_planner = problem.goal, problem.pose_planner
    max_steps = problem.mode.max_steps
    goal_xy, tolerance = np.array(goal.xy_m)[:, None], goal.tolerance_m
    reach = table.effects.reach_m
    start, nothing = np.array([problem.start_xy_m]), np.zeros(1)
    nearest_m = goal.distance_m(start[0])
    root = _Children(None, start, nothing, nothing, np.array([nearest_m]), nothing, nothing)
    # The running number tells nodes of the same f and depth apart, so nothing after it is compared;
    # f is rounded, lest the last digits of a sum choose between two orders of the same actions.
    number = itertools.count()
    frontier = [(max(0.0, nearest_m - tolerance), 0, next(number), root, 0)]
    nearest, expansions, reached = (root, 0), 0, False
    expanded: set[tuple[int, ...]] = set()
    while frontier and expansions < max_expansions:
        _, depth, _, family, k = heapq.heappop(frontier)
        (x, y), turned, away = family.xy_m[k].tolist(), float(family.turned[k]), family.away_m[k]
        if away < nearest_m - 1e-12:
            nearest, nearest_m = (family, k), float(away)
        if away <= tolerance and (
            not pose_planner or pose_planner(goal, (x, y), turned) is not None
        ):
            nearest, reached = (family, k), True
            break
        cell = (round(x / _SAME_PLACE_M), round(y / _SAME_PLACE_M), round(turned / YAW_STEP_RAD))
        if depth == max_steps or (depth, *cell) in expanded:
            continue
        expanded.add((depth, *cell))
        expansions += 1
        branches = table.at(turned)
        depth += 1
        places = (branches.effect_m + np.array([[x], [y]])).T
        away = np.hypot(*(places.T - goal_xy))
        if depth == max_steps:
            rows = np.flatnonzero(away < max(nearest_m, tolerance + 1e-12))
        else:
            rows = np.flatnonzero(away <= tolerance + (max_steps - depth) * reach + nearest_m)
        if len(rows):
            rows = rows[is_on_table(places[rows], table.effects.radius_m)]
            here = np.broadcast_to((x, y), (len(rows), 2))
            rows = rows[problem.reachable(here, branches.direction[rows])]
        if trace is not None:
            trace.append((np.array((x, y)), places[rows]))
        if not len(rows):
            continue
        if depth == max_steps:
            # From there nothing goes on: outside the goal's disc only the nearest counts.
            ends = away[rows] <= tolerance
            ends[away[rows].argmin()] = True
            rows = rows[ends]
        children = _Children(
            (family, k),
            places[rows],
            turned + branches.turn_rad[rows],
            family.way_m[k] + np.hypot(*branches.effect_m[:, rows]),
            away[rows],
            branches.direction[rows],
            branches.stop_phase[rows],
        )
        f = np.round(children.way_m + np.maximum(0.0, children.away_m - tolerance), 12)
        for row, value in enumerate(f.tolist()):
            heapq.heappush(frontier, (value, depth, next(number), children, row))
    chain = []
    family, k = nearest
    while family.parent is not None:
        chain.append((float(family.direction[k]), float(family.stop_phase[k])))
        family, k = family.parent
    return chain[::-1], reached, expansions


def plan_astar(
    problem: PlanningProblem,
    n_directions: int = N_DIRECTIONS,
    stop_phases: Sequence[float] = STOP_PHASES,
) -> Plan:
    """Plan by A*."""
    began = time.perf_counter()
    mode = problem.mode
    stops = tuple(stop_phases) if mode.partial else (1.0,)
    table = BranchTable(problem.effects, n_directions, stops)
    chain, reached, expansions = search(problem, table)
    chain = torch.tensor(chain, dtype=torch.float64).reshape(-1, 2)
    steps = make_steps(problem.effects, problem.start_xy_m, chain)
    return problem.plan(steps, "astar", reached, expansions, began)
