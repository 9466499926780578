"""Planning with off-centre pushes: the contact point determines displacement and rotation.

The effect of a push in the object's frame does not depend on the object's pose. So the effects of a
library of pushes (contact on the outline, direction, length) are predicted once, by any model of a
log. Chains of one to three pushes are searched in it: all pairs form a k-d tree in (x, y, ρ yaw),
queried for what remains after each first push. The chain with the least expected squared distance
to the goal is chosen; ρ, the object's radius of gyration, converts rotations to lengths.
"""

from __future__ import annotations

import math
import time
from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from affordlib.geometry import rotated
from affordlib.interactions.log import N_PHASES, PushLog, centred
from affordlib.models.fit import PushModel, gyration_radius_m
from affordlib.primitives import PushAt
from affordlib.types import Goal, Plan, Step, check_array, check_count, check_on_table

N_CANDIDATES = 600
LENGTHS_M = 0.002, 0.045
"""Range of push lengths for an object without a log of pushes."""
MOST_INCIDENCE_RAD = math.radians(50)
CORNER_SHARE = 0.08
"""Fraction of an edge excluded from contacts at each end."""
SHORTEST_SHARE = 0.3
_NEIGHBOURS = 30


def plan_push_at(
    model: PushModel,
    log: PushLog,
    pose: tuple[float, float, float],
    goal: Goal,
    n_pushes: int = 3,
    seed: int = 0,
    turn_m: float | None = None,
) -> Plan:
    """Plan off-centre pushes from a pose (x, y, yaw) to a goal, with its rotation if it has one.

    pose: of the object's centroid, in metres and radians (`Log.centroid_pose`); goal: a position of
    the centroid in the same frame, within the table's limits, and a turn relative to the present
    yaw; log: the log that the model was fitted to, with one group only, or `pushes_around` the
    outline of an object that was only seen; it determines the object, its context and the lengths
    of pushes; turn_m: metres per radian in the distance to the goal (default: the radius of
    gyration). Raises ValueError for more than one group.
    """
    began = time.perf_counter()
    x, y, yaw = check_array("pose", pose, 3)
    check_on_table("pose", (x, y))
    check_count("n_pushes", n_pushes, 1, 3)
    if len(names := np.unique(log.groups)) > 1:
        raise ValueError(f"log must hold one group, got {names.tolist()}; select one of them")
    pushes = _candidates(log, np.random.default_rng(check_count("seed", seed, least=0)))
    effect, std = model.predict(pushes)
    turn_m = turn_m or gyration_radius_m(log.outline_m)
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
    steps, end = [], np.zeros((1, 3))
    for k in chain:
        heading = yaw + end[0, 2]
        primitive = primitive_of(pushes, int(k), heading)
        path = [np.add((x, y), rotated(end[0, :2], yaw))]
        end = _after(end, effect[k : k + 1])
        path.append(np.add((x, y), rotated(end[0, :2], yaw)))
        std_m = float(np.hypot(*std[k, :2]))
        turn = float(end[0, 2])
        steps.append(Step(primitive, 1.0, tuple(path[1]), np.array(path), None, std_m, turn))
    reaches = goal.distance_m(steps[-1].predicted_end_xy_m) <= goal.tolerance_m
    took_s = time.perf_counter() - began
    return Plan(goal, (x, y), tuple(steps), "push_at", reaches, took_s)


def primitive_of(pushes: PushLog, k: int, heading_rad: float) -> PushAt:
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


def pushes_around(
    outline_m: np.ndarray,
    tool_radius_m: float = 0.0,
    n: int = N_CANDIDATES,
    lengths_m: tuple[float, float] = LENGTHS_M,
    seed: int | np.random.Generator = 0,
) -> PushLog:
    """Draw pushes all around an outline (k, 2) [m]; returns a log whose effects are zero.

    Its corners are given as feet of equal weight, in the absence of other information.
    """
    rng, outline_m = np.random.default_rng(seed), centred(outline_m)[1]
    edges = np.roll(outline_m, -1, axis=0) - outline_m
    sizes = np.linalg.norm(edges, axis=1)
    edge = rng.choice(len(edges), n, p=sizes / sizes.sum())
    share = rng.uniform(CORNER_SHARE, 1 - CORNER_SHARE, (n, 1))
    contact = outline_m[edge] + share * edges[edge]
    normal = np.stack([-edges[:, 1], edges[:, 0]], axis=1)[edge] / sizes[edge, None]
    direction = _turned(normal, rng.uniform(-MOST_INCIDENCE_RAD, MOST_INCIDENCE_RAD, n))
    length = np.exp(rng.uniform(*np.log(lengths_m), n))
    t = np.linspace(0, length, N_PHASES).T[..., None]
    feet = np.column_stack([outline_m, np.full(len(edges), 1 / len(edges))])
    still = np.zeros((n, 2)), np.zeros(n)
    known = np.full(n, "seen"), {"feet": np.repeat(feet[None], n, axis=0)}
    paths = contact[:, None] + t * direction[:, None], np.zeros((n, N_PHASES, 3))
    drawn = contact, normal, direction, length, *still, *known, *paths, outline_m
    return PushLog(*drawn, tool_radius_m=tool_radius_m)


def _candidates(log: PushLog, rng: np.random.Generator) -> PushLog:
    """Draw pushes around the object of a log, with its context, as long as its own or shorter."""
    longest = log.length_m.max()
    lengths = min(log.length_m.min(), SHORTEST_SHARE * longest), longest
    drawn = pushes_around(log.outline_m, log.tool_radius_m, lengths_m=lengths, seed=rng)
    taken = log.select(np.zeros(len(drawn), dtype=int))
    return replace(drawn, groups=taken.groups, context=taken.context, crop_width_m=log.crop_width_m)
