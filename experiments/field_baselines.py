"""Baselines that learn nothing: a standard planner, and mechanics in place of a network."""

import math
import time
from dataclasses import dataclass

import numpy as np
import torch

from affordlib.geometry import rotate
from affordlib.logs.log import centred, gyration_radius_m
from affordlib.logs.physics import AnalyticPusher
from affordlib.planning import EffectMap, PlanningProblem, continuous
from affordlib.planning.effect_map import make_steps, roll_out
from affordlib.types import Plan

N_CHAINS, ROUNDS, N_ELITE = 218, 16, 22
"""Cross-entropy method: chains sampled per round, rounds, and number of elite chains.

In total 3,488 chains, about as many as our planner evaluates for a goal of three actions."""

MOVES_M = 0.001  # actions that move the object by less than this [m] are removed from a plan


def plan_cem(problem: PlanningProblem, seed: int = 0) -> Plan:
    """Plan with the cross-entropy method: sample chains, fit a Gaussian to the elite, repeat.

    Initial means are the goal's direction and a stop phase of 0.75, with the same spread as in our
    planner. The plan is the best of all chains, without actions that move nothing.
    """
    began = time.perf_counter()
    effects, mode, rng = problem.effects, problem.mode, np.random.default_rng(seed)
    goal = np.subtract(problem.goal.xy_m, problem.start_xy_m)
    mean = np.tile([math.atan2(goal[1], goal[0]), 0.75], (mode.max_steps, 1))
    std = np.broadcast_to([continuous.DIRECTION_SPREAD_RAD, 0.25], mean.shape)
    best, least = torch.from_numpy(mean), math.inf
    for _ in range(ROUNDS):
        drawn = mean + std * rng.standard_normal((N_CHAINS, *mean.shape))
        drawn[..., 1] = drawn[..., 1].clip(effects.kind.acts_from, 1) if mode.partial else 1.0
        chains = torch.from_numpy(drawn)
        cost, _ = continuous.objective(effects, torch.from_numpy(goal), chains.unbind(-1))
        if problem.obstacles:  # those that are not free are taken only where there are no others
            cost = cost + 1.0 * ~continuous.free(problem, chains.unbind(-1))
        order = cost.argsort()[:N_ELITE]
        elite = drawn[order]
        mean, std = elite.mean(axis=0), elite.std(axis=0)
        if cost[order[0]] < least:
            best, least = chains[order[0]], float(cost[order[0]])
    if problem.obstacles and least > 1.0:
        return problem.plan_of((), "cem", False, began)
    positions, _, _ = roll_out(effects, *best.T[:, None])
    moved = positions[0].diff(dim=0, prepend=torch.zeros(1, 2)).norm(dim=-1)
    steps = make_steps(effects, problem.start_xy_m, best[moved > MOVES_M])
    end = steps[-1].predicted_end_xy_m if steps else problem.start_xy_m
    reaches = problem.goal.distance_m(end) <= problem.goal.tolerance_m
    return problem.plan_of(steps, "cem", reaches, began)


FINGERS_M, FRONT_M = np.linspace((-0.027, 0.015), (-0.015, 0.027), 7).T.ravel(), 0.009
MECHANICS = AnalyticPusher(friction=1.0, size=2.0)
FLUSH_M, N_STEPS = 0.0002, 120
"""Where the fingers are across a push, and how far their front is before the hand's centre.

Friction with the object, and the ellipsoid's ratio of torque to force in radii of gyration; these
and the front were chosen by hand, from two dozen settings on 40 training pushes. Points of the
outline within FLUSH_M of the rearmost touch as well; steps of a push."""


@dataclass(frozen=True, eq=False)
class MechanicsMap(EffectMap):
    """Effects of pushes by quasi-static mechanics of the outline that the camera sees; σ is 0.

    Two fingers meet the outline; the object turns about the contact until a face lies against both.
    Its weight is taken to be spread evenly, so that its limit surface is an ellipsoid.
    """

    def query(self, direction_rad, t_target):
        """Effects and σ (n, T, 3) of pushes in n directions, as `EffectMap.query`."""
        angle = torch.as_tensor(direction_rad)
        middle, corners = (torch.from_numpy(v) for v in centred(self.outline_m))
        unit, n = gyration_radius_m(corners.numpy()), len(angle)
        middle, corners = rotate(middle.expand(n, 2), -angle), corners.expand(n, -1, 2)
        corners = rotate(corners, -angle[:, None])
        at, turn = middle.clone(), torch.zeros(n).double()
        ahead = torch.tensor([[1.0, 0.0]]).double().expand(n, 2)
        front = np.linspace(-0.1, self.kind.towards(0.0).length + FRONT_M, N_STEPS)
        effects = np.zeros((n, N_STEPS, 3))
        for k, x in enumerate(front):
            rear = rear_of(rotate(corners, turn[:, None]) + at[:, None])
            first = rear.amin(dim=1)
            across = torch.from_numpy(FINGERS_M).expand(n, -1)
            touch = rear < first[:, None] + FLUSH_M
            low = across.where(touch, torch.inf).amin(dim=1)
            high = across.where(touch, -torch.inf).amax(dim=1)
            y = torch.minimum(torch.maximum(at[:, 1], low), high)
            contact = (torch.stack([first, y], -1) - at) / unit
            travel = (x - first).clamp_min(0).where(first.isfinite(), 0.0) / unit
            rows = torch.nan_to_num(torch.cat([contact, ahead, ahead, travel[:, None]], -1))
            moved = MECHANICS.predict(rows, steps=1).where(travel[:, None] > 0, 0.0)
            at, turn = at + unit * moved[:, :2], turn + moved[:, 2]
            effects[:, k] = torch.cat([at - rotate(middle, turn), turn[:, None]], -1)
        hand = [self.kind.towards(0.0).path(t)[:, 0] + FRONT_M for t in t_target.numpy()]
        pairs = zip(hand, effects, strict=True)
        found = [[np.interp(ahead, front, e) for e in one.T] for ahead, one in pairs]
        mean = torch.from_numpy(np.array(found)).mT
        return mean, torch.zeros_like(mean)


def rear_of(corners: torch.Tensor) -> torch.Tensor:
    """Least x (n, F) of convex outlines (n, k, 2) in the way of each finger point; inf if none."""
    start, edge = corners[..., None, :], (corners.roll(-1, dims=1) - corners)[..., None, :]
    share = (torch.from_numpy(FINGERS_M) - start[..., 1]) / edge[..., 1]
    x = start[..., 0] + share * edge[..., 0]
    return x.where((share >= 0) & (share <= 1), torch.inf).amin(dim=1)
