"""Planning with off-centre pushes: the contact point determines displacement and rotation.

The effect of a push in the object's frame does not depend on the object's pose. So the effects of a
library of pushes (contact on the outline, direction, length) are predicted once, by any model.
Chains of one to three pushes are searched in it: all pairs form a k-d tree in (x, y, ρ yaw),
queried for what remains after each first push. The chain with the least expected squared distance
to the goal is chosen; ρ, the object's radius of gyration, converts rotations to lengths.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from scipy.spatial import cKDTree

from affordlib.geometry import rotated
from affordlib.logs.fit import PushModel
from affordlib.logs.log import FEET, LARGEST_M, Pushes, centred, gyration_radius_m
from affordlib.primitives import PushAt
from affordlib.types import Goal, Plan, Step, check_array, check_count, check_range, check_within

N_CANDIDATES = 600
LENGTHS_M = 0.002, 0.045
"""Range of push lengths for an object without a log of pushes."""
MOST_INCIDENCE_RAD = math.radians(50)
CORNER_SHARE = 0.08
"""Fraction of an edge excluded from contacts at each end."""
SHORTEST_SHARE = 0.3
_NEIGHBOURS = 30


@dataclass(frozen=True)
class PushedObject:
    """An object to plan pushes for.

    outline_m: (k, 2) corners [m]; tool_radius_m: of a round tool; lengths_m: range of the lengths
    of pushes; group, context: the condition, as in `Log.add`. By default, for an object that was
    only seen, points on its outline are given as feet of equal weight.
    """

    outline_m: np.ndarray
    tool_radius_m: float = 0.0
    lengths_m: tuple[float, float] = LENGTHS_M
    group: str = "seen"
    context: dict[str, Any] | None = None

    def __post_init__(self) -> None:
        outline_m = centred(check_array("outline_m", self.outline_m, 2))[1]
        check_within("tool_radius_m", self.tool_radius_m, 0.0, LARGEST_M, "m")
        check_range("lengths_m", self.lengths_m, 1e-4, LARGEST_M)
        object.__setattr__(self, "outline_m", outline_m)
        if self.context is None:
            some = np.linspace(0, len(outline_m), min(len(outline_m), FEET), endpoint=False)
            feet = np.insert(outline_m[some.astype(int)], 2, 1 / len(some), axis=1)
            object.__setattr__(self, "context", {"feet": feet})

    @classmethod
    def of(cls, pushes: Pushes) -> Self:
        """Return the object of a log with one group, for pushes as long as the log's or shorter."""
        if len(names := np.unique(pushes.groups)) > 1:
            raise ValueError(f"pushes must be of one group, got {names.tolist()}; select one")
        longest = pushes.length_m.max()
        lengths_m = min(pushes.length_m.min(), SHORTEST_SHARE * longest), longest
        context = {name: values[0] for name, values in pushes.context.items()}
        return cls(pushes.outline_m, pushes.tool_radius_m, lengths_m, str(names[0]), context)

    def draw(self, n: int = N_CANDIDATES, seed: int | np.random.Generator = 0) -> Pushes:
        """Draw n pushes all around the outline."""
        rng, n = np.random.default_rng(seed), check_count("n", n, 1, 100_000)
        edges = np.roll(self.outline_m, -1, axis=0) - self.outline_m
        sizes = np.linalg.norm(edges, axis=1)
        edge = rng.choice(len(edges), n, p=sizes / sizes.sum())
        share = rng.uniform(CORNER_SHARE, 1 - CORNER_SHARE, (n, 1))
        normal = np.stack([-edges[:, 1], edges[:, 0]], axis=1)[edge] / sizes[edge, None]
        angle = rng.uniform(-MOST_INCIDENCE_RAD, MOST_INCIDENCE_RAD, n)
        return Pushes(
            contact_m=self.outline_m[edge] + share * edges[edge],
            normal=normal,
            direction=_turned(normal, angle),
            length_m=np.exp(rng.uniform(*np.log(self.lengths_m), n)),
            groups=np.full(n, self.group),
            context={k: np.repeat(np.array(v)[None], n, 0) for k, v in self.context.items()},
            outline_m=self.outline_m,
            tool_radius_m=self.tool_radius_m,
        )


def plan_push_at(
    model: PushModel,
    obj: PushedObject,
    pose: tuple[float, float, float],
    goal: Goal,
    n_pushes: int = 3,
    seed: int = 0,
    turn_m: float | None = None,
) -> Plan:
    """Plan off-centre pushes from a pose (x, y, yaw) to a goal, with its rotation if it has one.

    pose: of the object's centroid, in metres and radians (`Log.centroid_pose`); goal: a position of
    the centroid in the same frame, and a turn relative to the present yaw; turn_m: metres per
    radian in the distance to the goal (default: the radius of gyration). The plan reaches the goal
    if its tolerance covers the distance, and turn_m times what the turn is off.
    """
    began = time.perf_counter()
    x, y, yaw = check_array("pose", pose, 3).tolist()
    check_within("yaw of pose", yaw, -2 * math.pi, 2 * math.pi, "rad")
    check_count("n_pushes", n_pushes, 1, 3)
    pushes = obj.draw(seed=check_count("seed", seed, least=0))
    effect, std = model.predict(pushes)
    turn_m = gyration_radius_m(obj.outline_m) if turn_m is None else turn_m
    check_within("turn_m", turn_m, 0.0, LARGEST_M, "m")
    weights = np.array([1.0, 1.0, turn_m if goal.turn_rad is not None else 1e-6])
    risk = (weights * std) ** 2
    target = np.array([*rotated(np.subtract(goal.xy_m, (x, y)), -yaw), goal.turn_rad or 0.0])

    def best(chains):
        ends = np.zeros((len(chains), 3))
        for k in range(chains.shape[1]):
            ends = _after(ends, effect[chains[:, k]])
        cost = ((weights * (ends - target)) ** 2).sum(axis=1) + risk[chains].sum(axis=(1, 2))
        return cost.min(), chains[cost.argmin()]

    n = len(pushes)
    pairs = np.stack(np.meshgrid(np.arange(n), np.arange(n)), axis=-1).reshape(-1, 2)
    found = [best(chains) for chains in (np.arange(n)[:, None], pairs)[:n_pushes]]
    if n_pushes == 3:
        tree = cKDTree(weights * _after(effect[pairs[:, 0]], effect[pairs[:, 1]]))
        left = target - effect
        left[:, :2] = _turned(left[:, :2], -effect[:, 2])
        near = tree.query(weights * left, _NEIGHBOURS)[1].ravel()
        first = np.repeat(np.arange(n), _NEIGHBOURS)
        found.append(best(np.column_stack([first, pairs[near]])))
    chain = min(found, key=lambda each: each[0])[1]
    steps, ends = [], np.zeros((1, 3))
    for k in chain.tolist():
        ends = np.vstack([ends, _after(ends[-1:], effect[k : k + 1])])
        path = np.add((x, y), rotated(ends[-2:, :2], yaw))
        primitive = primitive_of(pushes, k, yaw + ends[-2, 2])
        std_m, turn = float(np.hypot(*std[k, :2])), float(ends[-1, 2])
        steps.append(Step(primitive, 1.0, tuple(path[1].tolist()), path, None, std_m, turn))
    off_m = goal.distance_m(steps[-1].predicted_end_xy_m), weights[2] * abs(ends[-1, 2] - target[2])
    reaches, took_s = max(off_m) <= goal.tolerance_m, time.perf_counter() - began
    return Plan(goal, (x, y), tuple(steps), "push_at", bool(reaches), took_s)


def primitive_of(pushes: Pushes, k: int, heading_rad: float) -> PushAt:
    """Push k as a motion of the tool's centre, for an object rotated by a heading."""
    middle = pushes.contact_m[k] - pushes.tool_radius_m * pushes.normal[k]
    direction = math.atan2(pushes.direction[k, 1], pushes.direction[k, 0]) + heading_rad
    return PushAt(tuple(rotated(middle, heading_rad)), direction, float(pushes.length_m[k]))


def _turned(xy: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Rotate points (n, 2), each by its angle (n,)."""
    c, s = np.cos(angle), np.sin(angle)
    return np.column_stack([c * xy[:, 0] - s * xy[:, 1], s * xy[:, 0] + c * xy[:, 1]])


def _after(pose: np.ndarray, effect: np.ndarray) -> np.ndarray:
    """Poses (n, 3) after effects (n, 3), each in the frame of its pose."""
    return np.column_stack(
        [pose[:, :2] + _turned(effect[:, :2], pose[:, 2]), pose[:, 2] + effect[:, 2]]
    )
