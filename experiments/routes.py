"""Routes to distant goals: shortest paths over a grid of places, by reachable actions.

Whether an object can be brought across the table depends on where the arm can act. Dijkstra's
algorithm from the goal answers this for all places at once.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from affordlib.planning.problem import OUR_TABLE, Table

Feasible = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]
"""Function of positions (n, 2), directions (n,), lengths (n,) [m]: which actions are possible."""

CELL_M = 0.02


@dataclass(frozen=True)
class RouteMap:
    """Pairs of places between which one action of at most `reach_m` can move an object.

    places_xy_m: (n, 2), a grid on the table; origin, end: (E,), indices of places, sorted by origin
    and then by end; length_m: (E,).
    """

    reach_m: float
    table: Table
    places_xy_m: np.ndarray
    origin: np.ndarray
    end: np.ndarray
    length_m: np.ndarray

    @classmethod
    def of(cls, reach_m: float, feasible: Feasible, table: Table = OUR_TABLE) -> Self:
        """Make the map for actions that are feasible."""
        x, y = (np.arange(low + CELL_M / 2, high, CELL_M) for low, high in (table.x_m, table.y_m))
        places = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)
        n, shape = math.floor(reach_m / CELL_M), np.array([len(x), len(y)])
        moves = np.mgrid[-n : n + 1, -n : n + 1].reshape(2, -1).T
        length_m = CELL_M * np.hypot(*moves.T)
        keep = (length_m > 0) & (length_m <= reach_m)
        moves, length_m = moves[keep], length_m[keep]
        ends = np.indices(shape).reshape(2, -1).T[:, None] + moves
        origin, move = np.nonzero(((ends >= 0) & (ends < shape)).all(axis=-1))
        end = np.ravel_multi_index(tuple(ends[origin, move].T), shape)
        angle, length_m = np.arctan2(moves[:, 1], moves[:, 0])[move], length_m[move]
        ok = feasible(places[origin], angle, length_m)
        return cls(reach_m, table, places, origin[ok], end[ok], length_m[ok])


def find_route(
    routes: RouteMap,
    start_xy_m: Sequence[float],
    goal_xy_m: Sequence[float],
    feasible: Feasible,
    radius_m: float = 0.0,
) -> list[tuple[float, float]]:
    """Places (x, y) [m] after each action of the shortest route, the goal last; empty without one.

    feasible: used for the first and the last action. radius_m: minimum distance of the route's
    places from the rim of the table.
    """
    start, goal = np.asarray(start_xy_m, dtype=float), np.asarray(goal_xy_m, dtype=float)

    def one_action(origins: np.ndarray, ends: np.ndarray) -> np.ndarray:
        """Lengths of single actions between points (n, 2), inf where not possible."""
        origins, ends = np.broadcast_arrays(origins, ends)
        way = ends - origins
        length_m = np.hypot(*way.T)
        near = np.flatnonzero(length_m <= routes.reach_m)
        angle = np.arctan2(way[near, 1], way[near, 0])
        near = near[feasible(origins[near], angle, length_m[near])]
        out = np.full(len(way), np.inf)
        out[near] = length_m[near]
        return out

    if np.isfinite(one_action(start, goal[None])[0]):
        return [tuple(goal.tolist())]
    places = routes.places_xy_m
    n, inside = len(places), routes.table.holds(places, radius_m)
    last_m = np.where(inside, one_action(places, goal), np.inf)
    usable = inside[routes.origin]
    origin, end, length_m = (v[usable] for v in (routes.origin, routes.end, routes.length_m))
    # The graph is reversed, to search from the goal, which has index n.
    lasts = np.flatnonzero(np.isfinite(last_m))
    backwards = (
        np.concatenate([length_m, last_m[lasts]]),
        (np.append(end, np.full(len(lasts), n)), np.append(origin, lasts)),
    )
    to_go_m = dijkstra(csr_array(backwards, shape=(n + 1, n + 1)), indices=n)[:n]
    first_m = one_action(start, places) + to_go_m
    if not np.isfinite(first_m).any():
        return []
    at = int(first_m.argmin())
    route = [at]
    while to_go_m[at] < last_m[at] - 1e-12:
        here = slice(*np.searchsorted(origin, [at, at + 1]))
        at = int(end[here][(length_m[here] + to_go_m[end[here]]).argmin()])
        route.append(at)
    return [tuple(places[k].tolist()) for k in route] + [tuple(goal.tolist())]
