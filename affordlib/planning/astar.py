"""A* over (partial) pushes (Section 3.4): 36 directions x 20, 40, 60, 80, 100 % of the phase.

An edge costs the distance that the object travels; the heuristic is the Euclidean distance to the
goal's disc, max(0, d - tolerance), which never overestimates. The search ends at the first node
within the tolerance (2 cm in the paper).
"""

from __future__ import annotations

import heapq
import itertools
import time
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
import torch

from affordlib.models.protocol import observe_pushes
from affordlib.planning.modes import (
    PATH_SAMPLES,
    PlanMode,
    encode_image,
    is_on_table,
    mode_named,
    plane,
)
from affordlib.primitives import Push
from affordlib.types import Goal, Plan, Step, check_on_table

if TYPE_CHECKING:
    from collections.abc import Sequence

    from affordlib.models.protocol import EffectModel

N_DIRECTIONS = 36
STOP_PHASES = (0.2, 0.4, 0.6, 0.8, 1.0)
PRUNE_BELOW_M = 0.001
_SAME_PLACE_M = 1e-4


@dataclass(frozen=True)
class Branches:
    """Every action of the search and its predicted effect, the same at every node.

    theta, stop_phase: (n,); effect_xy_m: (n, 2); std_m: (n,); path_xy_m: (n, PATH_SAMPLES, 2).
    """

    theta: np.ndarray
    stop_phase: np.ndarray
    effect_xy_m: np.ndarray
    std_m: np.ndarray
    path_xy_m: np.ndarray


@torch.no_grad()
def predict_branches(
    model: EffectModel,
    image: np.ndarray,
    n_directions: int = N_DIRECTIONS,
    stop_phases: Sequence[float] = STOP_PHASES,
) -> Branches:
    """Predict all branches in one call, the image encoded once; those that do nothing are left out.

    Effects are relative to the object, so one table serves every node of the search.
    """
    thetas = np.arange(n_directions) * (2 * np.pi / n_directions)
    features = encode_image(model, image)
    shares = torch.linspace(0, 1, PATH_SAMPLES)
    t_target = (torch.tensor(stop_phases, dtype=torch.float32)[:, None] * shares).reshape(1, -1)
    observations = observe_pushes(model, [Push(theta) for theta in thetas])
    prediction = model.predict(features, observations, t_target.expand(n_directions, -1))
    shape = (n_directions * len(stop_phases), PATH_SAMPLES, 2)
    path = prediction.effect_mean[..., plane(model)].reshape(shape).numpy().astype(float)
    std = prediction.effect_std[..., plane(model)].reshape(shape)[:, -1].norm(dim=-1).numpy()
    theta, stop = np.repeat(thetas, len(stop_phases)), np.tile(stop_phases, n_directions)
    moves = np.hypot(*path[:, -1].T) >= PRUNE_BELOW_M
    return Branches(theta[moves], stop[moves], path[moves, -1], std[moves], path[moves])


@dataclass(order=True)
class _Node:
    f: float
    depth: int
    order: int
    g: float = field(compare=False)
    xy: np.ndarray = field(compare=False)
    parent: _Node | None = field(compare=False)
    branch: int = field(compare=False)


def search(
    branches: Branches,
    start_xy_m: Sequence[float],
    goal: Goal,
    max_steps: int,
    max_expansions: int = 20_000,
) -> tuple[list[int], bool, int]:
    """The branches of the cheapest chain into the goal's disc, whether it gets there, expansions.

    Where no chain does, the one that ends nearest. Ties go to fewer actions.
    """
    goal_xy = np.asarray(goal.xy_m)
    lengths = np.hypot(*branches.effect_xy_m.T)
    reach = lengths.max(initial=0.0)

    def heuristic(xy: np.ndarray) -> np.ndarray:
        return np.maximum(0.0, np.hypot(*(xy - goal_xy).T) - goal.tolerance_m)

    start = np.asarray(start_xy_m, dtype=float)
    counter = itertools.count()
    root = _Node(float(heuristic(start)), 0, next(counter), 0.0, start, None, -1)
    frontier, nearest, expansions = [root], root, 0
    nearest_m = goal.distance_m(start)
    cheapest: dict[tuple[int, int, int], float] = {}
    reached = False
    while frontier and expansions < max_expansions:
        node = heapq.heappop(frontier)
        distance = goal.distance_m(node.xy)
        if distance < nearest_m - 1e-12:
            nearest, nearest_m = node, distance
        if distance <= goal.tolerance_m:
            nearest, reached = node, True
            break
        if node.depth == max_steps:
            continue
        expansions += 1
        children = node.xy + branches.effect_xy_m
        depth = node.depth + 1
        h, g = heuristic(children), node.g + lengths
        hopeful = is_on_table(children) & (h <= (max_steps - depth) * reach + nearest_m)
        if max_steps == depth:
            hopeful &= h < max(nearest_m - goal.tolerance_m, 1e-12)
        places = np.round(children / _SAME_PLACE_M).astype(int)
        for k in np.flatnonzero(hopeful):
            key = (int(places[k, 0]), int(places[k, 1]), depth)
            if g[k] < cheapest.get(key, np.inf):
                cheapest[key] = g[k]
                order = next(counter)
                child = _Node(float(g[k] + h[k]), depth, order, float(g[k]), children[k], node, k)
                heapq.heappush(frontier, child)
    chain = []
    while nearest.parent is not None:
        chain.append(nearest.branch)
        nearest = nearest.parent
    return chain[::-1], reached, expansions


def plan_astar(
    model: EffectModel,
    image: np.ndarray,
    start_xy_m: Sequence[float],
    goal: Goal,
    mode: str | PlanMode = "multi_partial",
    n_directions: int = N_DIRECTIONS,
    stop_phases: Sequence[float] = STOP_PHASES,
) -> Plan:
    """Plan from the object's position [m] and depth image (2, 48, 48) to a goal, by A*."""
    began = time.perf_counter()
    mode = mode_named(mode)
    start = check_on_table("start_xy_m", start_xy_m)
    phases = tuple(stop_phases) if mode.partial else (1.0,)
    branches = predict_branches(model, image, n_directions, phases)
    chain, reached, expansions = search(branches, start, goal, mode.max_steps)
    steps, xy = [], np.asarray(start)
    for k in chain:
        path = xy + branches.path_xy_m[k]
        xy = xy + branches.effect_xy_m[k]
        steps.append(
            Step(
                Push(branches.theta[k]),
                float(branches.stop_phase[k]),
                (float(xy[0]), float(xy[1])),
                path,
                std_m=float(branches.std_m[k]),
            )
        )
    seconds = time.perf_counter() - began
    return Plan(goal, start, tuple(steps), "astar", reached, expansions, seconds)
