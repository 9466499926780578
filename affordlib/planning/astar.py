"""A* over (partial) actions (Section 3.4): 36 directions x 20, 40, 60, 80, 100 % of the phase.

An edge costs the distance that the object travels; the heuristic is the Euclidean distance to the
goal's disc, max(0, d - tolerance), which never overestimates. The search ends at the first node
within the tolerance (2 cm in the paper). A push turns the object as well, so its effects are looked
up relative to the yaw that the model foresees; they are kept by degrees and used again.
"""

from __future__ import annotations

import heapq
import itertools
import math
import time
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch

from affordlib.planning.effect_map import EffectMap, map_effects
from affordlib.planning.finish import Finish, finished
from affordlib.planning.modes import PlanMode, is_on_table, mode_named
from affordlib.planning.steps import make_steps
from affordlib.primitives import Push
from affordlib.types import Goal, Plan, check_on_table

if TYPE_CHECKING:
    from collections.abc import Sequence

    from affordlib.models.protocol import EffectModel
    from affordlib.planning.repertoire import Reachable
    from affordlib.primitives import Drag

N_DIRECTIONS = 36
STOP_PHASES = (0.2, 0.4, 0.6, 0.8, 1.0)
PRUNE_BELOW_M = 0.001
YAW_STEP_RAD = math.radians(1)
_SAME_PLACE_M = 1e-4


@dataclass(frozen=True)
class Branches:
    """Every action of the search, and what it does to the object standing as it does.

    direction, stop_phase: (n,); effect_xy_m: (n, 2) along the table's axes; turn_rad: (n,).
    """

    direction: np.ndarray
    stop_phase: np.ndarray
    effect_xy_m: np.ndarray
    turn_rad: np.ndarray

    @cached_property
    def way_m(self) -> np.ndarray:
        """How far each moves the object: (n,)."""
        return np.hypot(*self.effect_xy_m.T)


class BranchTable:
    """The branches of an object by how far it has turned since its image was taken.

    It turns in steps of at most a degree that divide those between the directions, so all that can
    be asked of the map is asked at once: the effects in every direction relative to the object.
    """

    def __init__(
        self,
        effects: EffectMap,
        n_directions: int = N_DIRECTIONS,
        stop_phases: Sequence[float] = STOP_PHASES,
    ) -> None:
        between = 2 * math.pi / n_directions
        self._finer = math.ceil(between / YAW_STEP_RAD)
        self._step_rad = between / self._finer
        relative = torch.arange(n_directions * self._finer, dtype=torch.float64) * self._step_rad
        phases = torch.tensor(stop_phases, dtype=torch.float64)
        with torch.no_grad():
            grid = torch.meshgrid(relative, phases, indexing="ij")
            self._told = effects(*grid)[0].numpy()
        self.effects = effects
        self._direction = np.repeat(np.arange(n_directions) * between, len(stop_phases))
        self._phase = np.tile(phases.numpy(), n_directions)
        self._kept: dict[int, Branches] = {}

    def at(self, turned_rad: float) -> Branches:
        """The branches of the object turned by an angle; those that do nothing are left out."""
        key = round(turned_rad / self._step_rad) % len(self._told)
        if key not in self._kept:
            told = np.roll(self._told, key, axis=0)[:: self._finer].reshape(-1, 3)
            moves = np.hypot(told[:, 0], told[:, 1]) >= PRUNE_BELOW_M
            direction, phase = self._direction[moves], self._phase[moves]
            (ahead, left, turn), c, s = told[moves].T, np.cos(direction), np.sin(direction)
            xy = np.stack([c * ahead - s * left, s * ahead + c * left], axis=-1)
            self._kept[key] = Branches(direction, phase, xy, turn)
        return self._kept[key]


class _Node(NamedTuple):
    """A place in the frontier; no two have the same order, so nothing after it is compared."""

    f: float
    depth: int
    order: int
    g: float
    xy: tuple[float, float]
    turned: float
    parent: _Node | None
    action: tuple[float, float]


def search(
    table: BranchTable,
    start_xy_m: Sequence[float],
    goal: Goal,
    max_steps: int,
    reachable: Reachable | None = None,
    max_expansions: int = 20_000,
    trace: list[tuple[np.ndarray, np.ndarray]] | None = None,
    finish: Finish | None = None,
) -> tuple[list[tuple[float, float]], bool, int]:
    """The cheapest chain of (direction, phase) into the goal's disc, whether it gets there, and
    how many nodes were expanded.

    Where no chain does, the one that ends nearest. Ties go to fewer actions. Positions that are
    off the table or out of reach are not expanded. trace, if given, receives each expanded
    position (2,) with those of its children (n, 2). finish: turns and lifts at the end; where it
    cannot, a node is none of the goal's.
    """
    goal_xy = np.asarray(goal.xy_m)
    reach = table.effects.reach_m

    def heuristic(xy: np.ndarray) -> np.ndarray:
        return np.maximum(0.0, np.hypot(*(xy - goal_xy).T) - goal.tolerance_m)

    start = tuple(map(float, start_xy_m))
    counter = itertools.count()
    h = float(heuristic(np.array(start)))
    root = _Node(h, 0, next(counter), 0.0, start, 0.0, None, (0.0, 0.0))
    frontier, nearest, expansions = [root], root, 0
    nearest_m = goal.distance_m(start)
    cheapest: dict[tuple[int, int, int, int], float] = {}
    reached = False
    while frontier and expansions < max_expansions:
        node = heapq.heappop(frontier)
        distance = goal.distance_m(node.xy)
        if distance < nearest_m - 1e-12:
            nearest, nearest_m = node, distance
        if distance <= goal.tolerance_m and (
            finish is None or finish(goal, node.xy, node.turned) is not None
        ):
            nearest, reached = node, True
            break
        if node.depth == max_steps:
            continue
        expansions += 1
        branches = table.at(node.turned)
        children = node.xy + branches.effect_xy_m
        depth = node.depth + 1
        h = heuristic(children)
        if max_steps == depth:
            hopeful = h < max(nearest_m - goal.tolerance_m, 1e-12)
        else:
            hopeful = h <= (max_steps - depth) * reach + nearest_m
        rows = np.flatnonzero(hopeful)
        rows = rows[is_on_table(children[rows])]
        if reachable is not None and len(rows):
            here = np.broadcast_to(node.xy, (len(rows), 2))
            rows = rows[reachable(here, branches.direction[rows])]
        places = children[rows]
        if trace is not None:
            trace.append((np.array(node.xy), places))
        if not len(rows):
            continue
        cells = np.round(places / _SAME_PLACE_M).astype(int)
        turned = node.turned + branches.turn_rad[rows]
        turns = np.round(turned / YAW_STEP_RAD).astype(int)
        g = node.g + branches.way_m[rows]
        told = (cells, turns, g, g + h[rows], places, turned)
        actions = (branches.direction[rows], branches.stop_phase[rows])
        # Lists, since one number at a time is what arrays are slow at.
        for (u, v), turn, cost, f, xy, angle, *action in zip(
            *(column.tolist() for column in (*told, *actions)), strict=True
        ):
            key = (u, v, turn, depth)
            if cost < cheapest.get(key, math.inf):
                cheapest[key] = cost
                child = _Node(f, depth, next(counter), cost, tuple(xy), angle, node, tuple(action))
                heapq.heappush(frontier, child)
    chain = []
    while nearest.parent is not None:
        chain.append(nearest.action)
        nearest = nearest.parent
    return chain[::-1], reached, expansions


def plan_astar(
    model: EffectModel,
    image: np.ndarray,
    start_xy_m: Sequence[float],
    goal: Goal,
    mode: str | PlanMode = "multi_partial",
    kind: type[Push] | type[Drag] = Push,
    effects: EffectMap | None = None,
    reachable: Reachable | None = None,
    n_directions: int = N_DIRECTIONS,
    stop_phases: Sequence[float] = STOP_PHASES,
    finish: Finish | None = None,
) -> Plan:
    """Plan from the object's position [m] and depth image (2, 48, 48) to a goal, by A*.

    kind: push or drag; effects: the object's map, if it was made before; reachable: a function of
    positions (n, 2) and directions (n,) that says where the arm can act; finish: what turns and
    lifts the object at the end, without which a plan cannot reach a goal that asks for it.
    """
    began = time.perf_counter()
    mode = mode_named(mode)
    start = check_on_table("start_xy_m", start_xy_m)
    effects = effects or map_effects(model, image, kind)
    table = BranchTable(effects, n_directions, tuple(stop_phases) if mode.partial else (1.0,))
    chain, reached, expansions = search(
        table, start, goal, mode.max_steps, reachable, finish=finish
    )
    steps = make_steps(effects, start, torch.tensor(chain, dtype=torch.float64).reshape(-1, 2))
    plan = Plan(goal, start, steps, "astar", reached, expansions, 0.0)
    return finished(plan, finish, began)
