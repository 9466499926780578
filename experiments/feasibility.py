"""A kinematic oracle: can the arm move an object from one position to another at all?

It knows the arm's kinematics and the object, and uses neither models nor planners. An action is
possible if the tool reaches all its poses; a position is reachable if a chain of possible actions
leads to it. The wrist turns freely, so only the tool's distance from the base matters.
"""

import math
from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from scipy.optimize import bisect
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import ConvexHull, cKDTree

from affordlib.primitives import HOVER_M, TIP_HEIGHT_M, Drag, Move, Push
from affordlib.types import TABLE_X_M, TABLE_Y_M
from affordlib.world import UnreachableError, robot
from affordlib.world.trajectory import RETREAT_M

CELL_M, LONGEST_M = 0.02, 0.2
"""Distance [m] between neighbouring places on the table, and that of the longest action or more."""

XY = Sequence[float]
BAND_M = 0.01  # distance [m] from the limit of the reach within which goals are reported separately


@lru_cache
def tool_reach_m(height_m: float) -> tuple[float, float]:
    """Return the smallest and largest distance [m] from the base of a vertical tool at a height."""

    def there(radius: float) -> float:
        at = np.array([robot.BASE_X_M + radius, 0.0, height_m])
        try:
            robot.inverse_kinematics(at, 0.0, robot.HOME)
        except UnreachableError:
            return -1.0
        return 1.0

    return bisect(there, 0.6, 0.0, xtol=1e-6), bisect(there, 0.6, 2.0, xtol=1e-6)


def possible(
    kind: type[Move],
    half_m: float,
    slack_m: float,
    xy_m: np.ndarray,
    direction_rad: np.ndarray,
    length_m: np.ndarray,
) -> np.ndarray:
    """Return which actions are possible, at positions (n, 2), with directions and lengths (n,).

    half_m: half the object's width, by which the fingers of a push stop behind its centre [m];
    slack_m: distance [m] added to the arm's reach.
    """
    ahead = np.column_stack([np.cos(direction_rad), np.sin(direction_rad)])

    def within(along_m: np.ndarray | float, height_m: float) -> np.ndarray:
        at = xy_m + np.broadcast_to(along_m, len(xy_m))[:, None] * ahead
        least, most = tool_reach_m(height_m)
        radius = np.hypot(at[:, 0] - robot.BASE_X_M, at[:, 1])
        return (least - slack_m <= radius) & (radius <= most + slack_m)

    if kind is Drag:
        return within(0.0, HOVER_M) & within(length_m, HOVER_M)
    begin, end, up = -Push(0.0).radius, length_m - half_m, HOVER_M + TIP_HEIGHT_M
    ok = within(begin, up) & within(end, TIP_HEIGHT_M) & within(end - RETREAT_M, up)
    # The path between start and end may pass too near to the base.
    for share in (0.25, 0.5, 0.75):
        ok &= within(begin * (1 - share) + share * end, TIP_HEIGHT_M)
    return ok


def _actions(
    kind: type[Move], half_mm: int, slack_m: float, origins: np.ndarray, ends: np.ndarray
) -> np.ndarray:
    """Return whether one action can move an object between points (n, 2)."""
    origins, ends = np.broadcast_arrays(origins, ends)
    half, way = half_mm / 1000, ends - origins
    reach = Drag(0.0).length if kind is Drag else Push(0.0).length + half
    length_m = np.hypot(*way.T)
    short = length_m <= reach
    actions = origins[short], np.arctan2(*way[short].T[::-1]), length_m[short]
    short[short] = possible(kind, half, slack_m, *actions)
    return short


@lru_cache(maxsize=64)
def _graph(kind: type[Move], half_mm: int, slack_m: float) -> tuple[np.ndarray, csr_array]:
    """Return places (n, 2) on the table, and between which of them one action moves an object."""
    x, y = (np.arange(low + CELL_M / 2, high, CELL_M) for low, high in (TABLE_X_M, TABLE_Y_M))
    places = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)
    pairs = cKDTree(places).query_pairs(LONGEST_M, output_type="ndarray")
    origin, end = np.concatenate([pairs, pairs[:, ::-1]]).T
    ok = _actions(kind, half_mm, slack_m, places[origin], places[end])
    return places, csr_array((ok[ok], (origin[ok], end[ok])), shape=(len(places),) * 2)


def is_feasible(
    kind: type[Move], half_m: float, start_xy_m: XY, goal_xy_m: XY, slack_m: float = 0.0
) -> bool:
    """Return whether a chain of pushes or drags within the arm's reach leads to the goal."""
    how = kind, 5 * round(200 * half_m), slack_m
    places, graph = _graph(*how)
    start, goal = np.asarray(start_xy_m, dtype=float), np.asarray(goal_xy_m, dtype=float)
    if _actions(*how, start, goal[None])[0]:
        return True
    first = np.flatnonzero(_actions(*how, start, places))
    if not len(first):
        return False
    reached = np.isfinite(dijkstra(graph, indices=first, unweighted=True, min_only=True))
    return bool(_actions(*how, places[reached], goal).any())


def on_the_rim(kind: type[Move], half_m: float, start_xy_m: XY, goal_xy_m: XY) -> bool:
    """Return whether feasibility changes if the reach is longer or shorter by `BAND_M`."""
    answers = [is_feasible(kind, half_m, start_xy_m, goal_xy_m, s) for s in (-BAND_M, BAND_M)]
    return answers[0] != answers[1]


def half_width_m(footprint_m: np.ndarray) -> float:
    """Return the radius [m] of the circle that has the area of an outline (n, 2)."""
    return math.sqrt(ConvexHull(footprint_m).volume / math.pi)
