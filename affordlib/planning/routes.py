"""Ways to far goals: over a grid of places, by actions that are in reach.

A planner of a few actions sees 25 cm far. Whether an object can be brought across the table at all,
and which way round, is a question of where the arm can act; a wave from the goal answers it for
all places at once. The fine planner then goes from waypoint to waypoint.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from affordlib.planning.problem import is_on_table
from affordlib.primitives import Drag, Push
from affordlib.types import TABLE_X_M, TABLE_Y_M

Feasible = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]

CELL_M = 0.02
REACH_M = {Push: 0.075, Drag: 0.045}
"""How far one action takes nearly any object: a little less than the whole action mostly does."""


def places() -> tuple[np.ndarray, np.ndarray]:
    """The grid: x (nx, 1) and y (1, ny) [m] of its places."""
    x = np.arange(TABLE_X_M[0] + CELL_M / 2, TABLE_X_M[1], CELL_M)
    y = np.arange(TABLE_Y_M[0] + CELL_M / 2, TABLE_Y_M[1], CELL_M)
    return x[:, None], y[None, :]


def moves_within(reach_m: float) -> np.ndarray:
    """Moves (m, 2) from place to place, in cells, that one action can make."""
    n = math.floor(reach_m / CELL_M)
    i, j = (v.ravel() for v in np.mgrid[-n : n + 1, -n : n + 1])
    length = CELL_M * np.hypot(i, j)
    return np.column_stack([i, j])[(length > 0) & (length <= reach_m)]


@dataclass(frozen=True)
class RouteMap:
    """Which moves are possible from which places: allowed (m, nx, ny) of moves (m, 2)."""

    moves: np.ndarray
    allowed: np.ndarray
    reach_m: float

    @classmethod
    def of(cls, reach_m: float, judge: Feasible) -> RouteMap:
        """judge: which of the positions (n, 2), directions (n,), lengths (n,) [m] are possible."""
        x, y = places()
        moves = moves_within(reach_m)
        xy = np.stack(np.broadcast_arrays(x, y), axis=-1).reshape(-1, 2)
        angle = np.arctan2(moves[:, 1], moves[:, 0])
        length = CELL_M * np.hypot(*moves.T)
        n = len(xy)
        said = judge(np.tile(xy, (len(moves), 1)), np.repeat(angle, n), np.repeat(length, n))
        return cls(moves, said.reshape(len(moves), x.size, y.size), reach_m)

    def to_go_m(self, last: np.ndarray, allowed: np.ndarray) -> np.ndarray:
        """Lengths (nx, ny) [m] of the shortest ways, inf where there is none.

        last: (nx, ny), of the last action to the goal itself, inf where one does not get there.
        allowed: (m, nx, ny), the moves that may be used.
        """
        to_go = last.copy()
        lengths = CELL_M * np.hypot(*self.moves.T)
        while True:
            before = to_go
            to_go = before.copy()
            for (i, j), length, ok in zip(self.moves, lengths, allowed, strict=True):
                ahead = np.full_like(before, np.inf)
                here, there = _overlap(i, before.shape[0]), _overlap(j, before.shape[1])
                ahead[here[0], there[0]] = before[here[1], there[1]] + length
                np.minimum(to_go, np.where(ok, ahead, np.inf), out=to_go)
            if np.array_equal(to_go, before):
                return to_go


def _overlap(shift: int, n: int) -> tuple[slice, slice]:
    """Where places have a place `shift` further on, and which those are."""
    return slice(max(0, -shift), min(n, n - shift)), slice(max(0, shift), min(n, n + shift))


def find_route(
    routes: RouteMap,
    start_xy_m: Sequence[float],
    goal_xy_m: Sequence[float],
    judge: Feasible,
    barred: Sequence[tuple[int, int, int]] = (),
    radius_m: float = 0.0,
) -> list[tuple[float, float]] | None:
    """Places (x, y) [m] after each action of the shortest way, the goal last; None: there is none.

    judge: which actions the arm can do, of positions (n, 2), directions and lengths (n,).
    barred: moves that are not to be used, as (move, i, j); radius_m: no place on the way is nearer
    to the table's rim than this.
    """
    start, goal = np.asarray(start_xy_m, dtype=float), np.asarray(goal_xy_m, dtype=float)
    x, y = places()
    xy = np.stack(np.broadcast_arrays(x, y), axis=-1)

    def one_action(origin: np.ndarray, end: np.ndarray) -> np.ndarray:
        """Lengths of single actions between places (n, 2), inf where they are not possible."""
        way = end - origin
        length = np.hypot(*way.T)
        near = length <= routes.reach_m
        out = np.full(len(way), np.inf)
        from_xy = np.broadcast_to(origin, way.shape)[near]
        ok = judge(from_xy, np.arctan2(way[near, 1], way[near, 0]), length[near])
        out[near] = np.where(ok, length[near], np.inf)
        return out

    if np.isfinite(one_action(start, goal[None])[0]):
        return [tuple(goal.tolist())]
    last = one_action(xy.reshape(-1, 2), np.broadcast_to(goal, (x.size * y.size, 2)))
    last = np.where(is_on_table(xy, radius_m), last.reshape(x.size, y.size), np.inf)
    open_moves = routes.allowed & is_on_table(xy, radius_m)
    if barred:
        open_moves[tuple(np.array(barred).T)] = False
    to_go = routes.to_go_m(last, open_moves)
    first = one_action(start, xy.reshape(-1, 2)).reshape(to_go.shape) + to_go
    if not np.isfinite(first).any():
        return None
    at = np.unravel_index(int(first.argmin()), first.shape)
    route = [at]
    lengths = CELL_M * np.hypot(*routes.moves.T)
    while to_go[at] < last[at] - 1e-12:
        ends = [
            length + to_go[at[0] + i, at[1] + j]
            if ok and 0 <= at[0] + i < x.size and 0 <= at[1] + j < y.size
            else math.inf
            for (i, j), length, ok in zip(
                routes.moves, lengths, open_moves[:, at[0], at[1]], strict=True
            )
        ]
        i, j = routes.moves[int(np.argmin(ends))]
        at = (int(at[0] + i), int(at[1] + j))
        route.append(at)
    return [tuple(xy[k].tolist()) for k in route] + [tuple(goal.tolist())]
