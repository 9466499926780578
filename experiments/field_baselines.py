"""The cross-entropy method, with our planner's objective, compared with ours in Table 3."""

from __future__ import annotations

import math
import time

import numpy as np
import torch

from affordlib.planning import PlanningProblem, continuous
from affordlib.planning.rollout import make_steps, roll_out
from affordlib.types import Plan

N_CHAINS, ROUNDS, N_ELITE = 218, 16, 22
"""Cross-entropy method: chains sampled per round, rounds, and number of elite chains.

In total 3,488 chains, about as many as our planner evaluates for a goal of three actions."""

MOVES_M = 0.001
"""Actions that move the object by less than this [m] are removed from a plan."""


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
