"""Planning with off-centre pushes: the contact point determines displacement and rotation.

The effect of a push in the object's frame does not depend on the object's pose. So the effects of a
library of pushes (contact on the outline, direction, length) are predicted once, by any model.
Chains of one to three pushes are searched in it: all pairs form a k-d tree in (x, y, ρ yaw),
queried for what remains after each first push. The chain with the least expected squared distance
to the goal is chosen; ρ, the object's radius of gyration, converts rotations to lengths. If it is
known where the tool is, the first push must be one to which the tool finds a way around the object.
"""

import math
import time
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any, Self

import numpy as np
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import cKDTree

from affordlib.geometry import circle, edge_normals, rotated, rotated_each, unit_vector
from affordlib.logs.fit import PushModel
from affordlib.logs.log import LARGEST_M, Pushes, _nearest, centred, gyration_radius_m, segment_gaps
from affordlib.primitives import PushAt
from affordlib.types import (
    Checked,
    Goal,
    Plan,
    Step,
    UnreachableError,
    check_array,
    check_count,
    check_pair,
    check_within,
    count,
    number,
    parameter,
    span,
)

N_CANDIDATES = 600
LENGTHS_M = 0.002, 0.045  # of pushes of an object without a log
MOST_INCIDENCE_RAD = math.radians(50)
CORNER_SHARE = 0.08  # of an edge, without contacts at each end
SHORTEST_SHARE = 0.3
CLEAR_M = 0.004  # between tool and outline on the tool's way; half of it must remain
TURN_PRICE_M = 0.03  # that the tool rather goes than turn once more on its way
KEPT = 3  # chains of each length that are refined
_NEIGHBOURS, _PAIRS = 30, 2000
_BEFORE = 1 / math.cos(MOST_INCIDENCE_RAD)  # where even an oblique push begins, in CLEAR_M
_SHIFT, _LARGEST_STEP, _DAMPING_M = 0.01, 0.5, 0.0003

XY, Pose = tuple[float, float], tuple[float, float, float]


@dataclass(frozen=True)
class PushedObject(Checked):
    """An object to plan pushes for.

    outline_m: (k, 2) corners [m]; tool_radius_m: of a round tool; lengths_m: range of the lengths
    of pushes; group, context: the condition, as in `Log.add`.
    """

    outline_m: np.ndarray = parameter(lambda name, v: centred(check_array(name, v, 2))[1])
    tool_radius_m: float = number(0.0, LARGEST_M, "m", 0.0)
    lengths_m: XY = span(1e-4, LARGEST_M, LENGTHS_M)
    group: str = "seen"
    context: dict[str, Any] = field(default_factory=dict)

    @classmethod
    def of(cls, pushes: Pushes) -> Self:
        """Return the object of a log with one group, for pushes as long as the log's or shorter."""
        if len(names := np.unique(pushes.groups)) > 1:
            raise ValueError(f"pushes must be of one group, got {names.tolist()!r:.99}; select one")
        longest = pushes.length_m.max()
        lengths_m = min(pushes.length_m.min(), SHORTEST_SHARE * longest), longest
        context = {name: values[0] for name, values in pushes.context.items()}
        return cls(pushes.outline_m, pushes.tool_radius_m, lengths_m, str(names[0]), context)

    def draw(self, n: int = N_CANDIDATES, seed: int | np.random.Generator = 0) -> Pushes:
        """Draw n pushes all around the outline, less those whose tool would overlap the object."""
        return self.at(self.drawn(n, seed))

    def drawn(self, n: int, seed: int | np.random.Generator) -> np.ndarray:
        """Pushes (m, 4): number of the edge, share of it, angle to its normal, log of length."""
        rng, n = np.random.default_rng(seed), check_count("n", n, 1, 100_000)
        sizes = np.linalg.norm(np.roll(self.outline_m, -1, axis=0) - self.outline_m, axis=1)
        edge = rng.choice(len(sizes), n, p=sizes / sizes.sum())
        rows = np.column_stack([edge, *(rng.uniform(*ends, n) for ends in self.bounds)])
        pushes = self.at(rows)
        middle = pushes.contact_m - self.tool_radius_m * pushes.normal
        return rows[_nearest(self.outline_m, middle)[0] > self.tool_radius_m - 1e-6]

    @property
    def bounds(self) -> np.ndarray:
        """Least and largest value (3, 2) of the last three numbers of `drawn`."""
        share, angle = (CORNER_SHARE, 1 - CORNER_SHARE), (-MOST_INCIDENCE_RAD, MOST_INCIDENCE_RAD)
        return np.array([share, angle, np.log(self.lengths_m)])

    def at(self, rows: np.ndarray) -> Pushes:
        """Pushes as `drawn` describes them."""
        edge, n = rows[:, 0].astype(int), len(rows)
        edges = np.roll(self.outline_m, -1, axis=0) - self.outline_m
        normal = -edge_normals(self.outline_m)[edge]
        return Pushes(
            contact_m=self.outline_m[edge] + rows[:, 1:2] * edges[edge],
            normal=normal,
            direction=rotated_each(normal, rows[:, 2]),
            length_m=np.exp(rows[:, 3]),
            groups=np.full(n, self.group),
            context={k: np.repeat(np.array(v)[None], n, 0) for k, v in self.context.items()},
            outline_m=self.outline_m,
            tool_radius_m=self.tool_radius_m,
        )


@dataclass
class PushPlanner(Checked):
    """Plans pushes of one object; its library of pushes is drawn and predicted once.

    turn_m: metres per radian in the distance to the goal (default: the radius of gyration); a plan
    reaches the goal if its tolerance covers the distance, and turn_m times what the turn is off;
    price: by which share of the present distance each push of a chain must bring the object nearer;
    rounds: of predictions for the Gauss-Newton steps that refine contacts, directions and lengths
    of the best chains; room_m: least and largest (x, y) that the tool's centre can reach.
    """

    model: PushModel
    obj: PushedObject
    seed: int = count(0, 0)
    turn_m: float | None = number(0.0, LARGEST_M, "m", None)
    price: float = number(0.0, 1.0, default=0.0)
    rounds: int = count(0, 0, 20)
    room_m: tuple[XY, XY] | None = parameter(lambda name, v: check_array(name, v, 2, 2), None)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.turn_m is None:
            self.turn_m = gyration_radius_m(self.obj.outline_m)
        self._drawn = self.obj.drawn(N_CANDIDATES, self.seed)
        self.library = self.obj.at(self._drawn)
        self._effect, self._std = self.model.predict(self.library)
        each = np.arange(len(self.library))
        self._pairs = np.stack(np.meshgrid(each, each), axis=-1).reshape(-1, 2)
        self._ends = _after(*(self._effect[rows] for rows in self._pairs.T))
        self._tree = lru_cache(lambda turn_m: cKDTree(self._ends * (1.0, 1.0, turn_m)))

    def plan(self, pose: Pose, goal: Goal, n_pushes: int = 3, tool_xy_m: XY | None = None) -> Plan:
        """Plan up to three pushes from a pose (x, y, yaw) to a goal, with its turn if it has one.

        pose: of the object's centroid (`Log.centroid_pose`); goal: a position of the centroid in
        the same frame, and a turn relative to the present yaw; tool_xy_m: where the tool's centre
        is; None does not look for a way. Raises UnreachableError if there is none to any push.
        """
        began = time.perf_counter()
        x, y, yaw = check_array("pose", pose, 3).tolist()
        check_within("yaw of pose", yaw, -2 * math.pi, 2 * math.pi, "rad")
        check_within("the distance of pose from the frame's origin", math.hypot(x, y), 0, 100, "m")
        n_pushes = check_count("n_pushes", n_pushes, 1, 3)
        if tool_xy_m is not None:
            away_m = math.dist(check_pair("tool_xy_m", tool_xy_m), (x, y))
            check_within("the distance of tool_xy_m from pose", away_m, 0.0, 100.0, "m")
        weights = np.array([1.0, 1.0, self.turn_m if goal.turn_rad is not None else 1e-6])
        target = np.array([*rotated(np.subtract(goal.xy_m, (x, y)), -yaw), goal.turn_rad or 0.0])
        shut = self.shut(pose, tool_xy_m)
        parts = self._drawn, self._effect, self._std
        risk, effect, n = (weights * self._std) ** 2, self._effect, len(self.library)

        def best(chains, ends):
            cost = ((weights * (ends - target)) ** 2).sum(axis=1) + risk[chains].sum(axis=(1, 2))
            cost[shut[chains[:, 0]]] = np.inf
            order = np.argpartition(cost, KEPT)[:KEPT] if self.rounds else [cost.argmin()]
            return [(math.sqrt(cost[k]), *(part[chains[k]] for part in parts)) for k in order]

        found = best(np.arange(n)[:, None], effect)
        if n_pushes > 1:  # a chain that is refined need not be the very best
            tree = self._tree(weights[2])
            near = tree.query(weights * target, _PAIRS)[1] if self.rounds else slice(None)
            found += best(self._pairs[near], self._ends[near])
        if n_pushes == 3:
            left = target - effect
            left[:, :2] = rotated_each(left[:, :2], -effect[:, 2])
            near = tree.query(weights * left, _NEIGHBOURS)[1].ravel()
            chains = np.column_stack([np.repeat(np.arange(n), _NEIGHBOURS), self._pairs[near]])
            found += best(chains, _after(effect[chains[:, 0]], self._ends[near]))
        if self.rounds:
            found += self._refined([rows for _, rows, *_ in found], weights, target)
            firsts = self.obj.at(np.array([rows[0] for _, rows, *_ in found]))
            shut = self.shut(pose, tool_xy_m, firsts)
            found = [chain for chain, is_shut in zip(found, shut, strict=True) if not is_shut]
        found = [chain for chain in found if math.isfinite(chain[0])]
        if not found:
            raise UnreachableError("tool_xy_m: the tool finds no way around the object to a push")
        price = self.price * np.linalg.norm(weights * target)
        _, rows, *predicted = min(found, key=lambda each: each[0] + price * len(each[1]))
        plan = _steps(pose, self.obj.at(rows), *predicted)
        off_m = goal.distance_m(plan[-1].predicted_end_xy_m)
        turn_off = weights[2] * abs(plan[-1].predicted_turn_rad - target[2])
        reaches, took_s = max(off_m, turn_off) <= goal.tolerance_m, time.perf_counter() - began
        return Plan(goal, (x, y), plan, "push_at", bool(reaches), took_s)

    def way(self, pose: Pose, tool_xy_m: XY, primitive: PushAt) -> np.ndarray:
        """Points (n, 2) of the tool's way from where it is to the end of a push of `plan`.

        It retreats from the outline, goes around the object, and comes to rest before the contact.
        """
        x, y, yaw = pose
        contact, ahead = np.add(primitive.contact, (x, y)), unit_vector(primitive.direction)
        before = contact - _BEFORE * CLEAR_M * ahead
        turns, last, via, _ = self._ways(pose, tool_xy_m, rotated(before - (x, y), -yaw)[None])
        points, k = [], int(via[0])
        while k >= 0:
            points.append(np.add((x, y), rotated(turns[k], yaw)))
            k = int(last[k])
        return np.array([*points[::-1], before, contact + primitive.length * ahead])

    def _refined(
        self, chains: list[np.ndarray], weights: np.ndarray, target: np.ndarray
    ) -> list[tuple]:
        """Gauss-Newton steps of least norm, of all chains of drawn pushes (k, 4) side by side."""
        best: list[tuple] = [(math.inf,)] * len(chains)
        shifts, (low, high) = np.eye(4)[:, None] * [0, _SHIFT, _SHIFT, _SHIFT], self.obj.bounds.T
        places = np.cumsum([4 * len(rows) for rows in chains])[:-1]
        for _ in range(self.rounds):
            shifted = np.concatenate([(rows + shifts).reshape(-1, 4) for rows in chains])
            both = self.model.predict(self.obj.at(shifted))
            parts = zip(*(np.split(each, places) for each in both), strict=True)
            for chain, (effect, std) in enumerate(parts):
                rows, k = chains[chain], len(chains[chain])
                effect, std = effect.reshape(4, k, 3), std[:k]
                ends = np.zeros((1 + 3 * k, 3))  # without shifts, and for each shifted value
                for push in range(k):
                    every = np.tile(effect[0, push], (1 + 3 * k, 1))
                    every[1 + 3 * push : 4 + 3 * push] = effect[1:, push]
                    ends = _after(ends, every)
                off = weights * (ends[0] - target)
                cost = math.sqrt((off**2).sum() + ((weights * std) ** 2).sum())
                if cost < best[chain][0]:
                    best[chain] = cost, rows, effect[0], std
                slope = weights * (ends[1:] - ends[0]) / _SHIFT
                damped = slope.T @ slope + _DAMPING_M**2 * np.eye(3)
                step = np.clip(-slope @ np.linalg.solve(damped, off), -_LARGEST_STEP, _LARGEST_STEP)
                values = np.clip(rows[:, 1:] + step.reshape(k, 3), low, high)
                chains[chain] = np.column_stack([rows[:, 0], values])
        return [each for each in best if math.isfinite(each[0])]

    def shut(self, pose: Any, tool_xy_m: Any, pushes: Pushes | None = None) -> np.ndarray:
        """Which pushes (n,), by default of the library, the tool at tool_xy_m cannot make."""
        pushes = self.library if pushes is None else pushes
        if tool_xy_m is None:
            return np.zeros(len(pushes), dtype=bool)
        middle = pushes.contact_m - self.obj.tool_radius_m * pushes.normal
        before = middle - _BEFORE * CLEAR_M * pushes.direction
        shut = ~np.isfinite(self._ways(pose, tool_xy_m, before)[3])
        if self.room_m is not None:
            ends = middle + pushes.length_m[:, None] * pushes.direction
            for points in (before, ends):
                world = rotated(points, pose[2]) + pose[:2]
                shut |= ((world < self.room_m[0]) | (world > self.room_m[1])).any(axis=1)
        return shut

    def _ways(self, pose: Any, tool_xy_m: Any, goals_m: np.ndarray) -> tuple[np.ndarray, ...]:
        """Shortest ways to goals (n, 2) in the object's frame, over eight points on a circle.

        Returns where the tool may turn (9, 2), from the first it starts; the turn before each (9,);
        the last turn before each goal, and the length of the way (n,), infinite if there is none.
        """
        outline_m, radius_m = self.obj.outline_m, self.obj.tool_radius_m
        start = rotated(np.subtract(tool_xy_m, pose[:2]), -pose[2])
        ring = circle(1.0, 32)
        if (lacks := radius_m + CLEAR_M - _nearest(outline_m, start[None])[0].item()) > 0:
            back = start + (lacks + 1e-4) * ring  # one of these is nearly along the normal
            start = back[_nearest(outline_m, back)[0].argmax()]
        far_m = np.linalg.norm(outline_m, axis=1).max() + radius_m + CLEAR_M
        around = ring[::4] * far_m / math.cos(math.pi / 8)
        if self.room_m is not None:
            inside = np.clip(rotated(around, pose[2]) + pose[:2], *self.room_m)
            around = rotated(inside - pose[:2], -pose[2])
        turns = np.vstack([start, around])
        ends = np.vstack([turns, goals_m])
        off = ends - turns[:, None]
        length = np.linalg.norm(off, axis=-1) + TURN_PRICE_M
        pairs = np.broadcast_to(turns[:, None], off.shape).reshape(-1, 2), np.tile(ends, (9, 1))
        gap = segment_gaps(outline_m, *pairs).min(axis=1).reshape(length.shape)
        nearest = _nearest(outline_m, ends)[0]
        gap = np.minimum(gap, np.minimum(nearest, nearest[:9, None]))
        length[gap < radius_m + CLEAR_M / 2] = np.inf
        from_start, before = dijkstra(length[:, :9], indices=0, return_predecessors=True)
        total = from_start[:, None] + length[:, 9:]
        via = total.argmin(axis=0)
        return turns, before, via, total.min(axis=0)


def primitive_of(pushes: Pushes, k: int, heading_rad: float) -> PushAt:
    """Push k as a motion of the tool's centre, for an object rotated by a heading."""
    middle = pushes.contact_m[k] - pushes.tool_radius_m * pushes.normal[k]
    direction = math.atan2(pushes.direction[k, 1], pushes.direction[k, 0]) + heading_rad
    return PushAt(tuple(rotated(middle, heading_rad)), direction, float(pushes.length_m[k]))


def _steps(pose: Pose, pushes: Pushes, effect: np.ndarray, std: np.ndarray) -> tuple[Step, ...]:
    x, y, yaw = pose
    steps, ends = [], np.zeros((1, 3))
    for k in range(len(pushes)):
        ends = np.vstack([ends, _after(ends[-1:], effect[k : k + 1])])
        path = np.add((x, y), rotated(ends[-2:, :2], yaw))
        primitive = primitive_of(pushes, k, yaw + ends[-2, 2])
        std_m, turn = float(np.hypot(*std[k, :2])), float(ends[-1, 2])
        steps.append(Step(primitive, 1.0, tuple(path[1].tolist()), path, None, std_m, turn))
    return tuple(steps)


def _after(pose: np.ndarray, effect: np.ndarray) -> np.ndarray:
    """Poses (n, 3) after effects (n, 3), each in the frame of its pose."""
    xy = pose[:, :2] + rotated_each(effect[:, :2], pose[:, 2])
    return np.column_stack([xy, pose[:, 2] + effect[:, 2]])
