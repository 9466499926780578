"""Planners of the field, beside ours in Table 3.

plan_astar_continuous: A*, with the direction and stop of its last action refined continuously.
plan_cem: the cross-entropy method on the effect map, with our planner's objective.
"""

from __future__ import annotations

import math
import time

import numpy as np
import torch

from affordlib.planning import PlanningProblem, continuous, plan_astar
from affordlib.planning.effect_map import rotate
from affordlib.planning.rollout import make_steps, roll_out
from affordlib.types import Plan

N_CHAINS, ROUNDS, N_ELITE = 218, 16, 22
"""Of the cross-entropy method: chains drawn in a round, rounds, and the best, which are fitted.

Together 3,488: our planner tries about as many for a goal of three actions."""

MOVES_M = 0.001
"""An action that moves the object by less is left out of a plan."""


def plan_astar_continuous(problem: PlanningProblem) -> Plan:
    """A*'s plan; its last action is then corrected until it is predicted to end at the goal."""
    began = time.perf_counter()
    plan = plan_astar(problem)
    if not plan.steps:
        return plan
    effects, (*first, last) = problem.effects, plan.steps
    start, turned = problem.start_xy_m, first[-1].predicted_turn_rad if first else 0.0
    left = np.subtract(problem.goal.xy_m, first[-1].predicted_end_xy_m if first else start)
    # The last action as one alone, on the object and with the table turned back.
    back = torch.tensor(-turned, dtype=torch.float64)
    action = [last.primitive.direction_rad - turned, last.stop_phase]
    angle, stop = torch.tensor(action, dtype=torch.float64)[:, None, None]
    target = rotate(torch.from_numpy(left), back)
    better, _ = continuous.correct(effects, target, (angle, stop), problem.mode.partial, 20)
    chain = [(s.primitive.direction_rad, s.stop_phase) for s in first]
    chain = torch.tensor([*chain, (float(better[0, 0]) + turned, float(better[0, 1]))]).double()
    steps = make_steps(effects, start, chain)
    return problem.plan_of(steps, "astar_continuous", plan.reaches_goal, began)


def plan_cem(problem: PlanningProblem, seed: int = 0) -> Plan:
    """Draw chains of as many actions as are allowed, fit a normal distribution to the best, repeat.

    Directions begin around that of the goal and stops around three quarters, spread as in our
    planner. The best chain of all is the plan, without the actions that move nothing.
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
        cost, _ = continuous._objective(effects, torch.from_numpy(goal), *chains.unbind(-1))
        order = cost.argsort()[:N_ELITE]
        elite = drawn[order]
        mean, std = elite.mean(axis=0), elite.std(axis=0)
        if cost[order[0]] < least:
            best, least = chains[order[0]], float(cost[order[0]])
    positions, _, _ = roll_out(effects, *best.T[:, None])
    moved = positions[0].diff(dim=0, prepend=torch.zeros(1, 2)).norm(dim=-1)
    steps = make_steps(effects, problem.start_xy_m, best[moved > MOVES_M])
    end = steps[-1].predicted_end_xy_m if steps else problem.start_xy_m
    reaches = problem.goal.distance_m(end) <= problem.goal.tolerance_m
    return problem.plan_of(steps, "cem", reaches, began)
