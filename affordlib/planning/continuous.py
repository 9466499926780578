"""Our continuous planner: directions and phases of all actions of a chain, found together.

    p_k+1 = p_k + R(φ_k) e(φ_k - ψ_k, t_k),   ψ_k+1 = ψ_k + e_ψ(φ_k - ψ_k, t_k)
    minimise |p_K - goal|² + λ tr Cov p_K   over φ_1, t_1, …, φ_K, t_K

e is the object's effect map, p and ψ its position and how far it has turned; with λ = 1 it would be
the expected squared distance, and `RISK_WEIGHT` weighs the model's doubt more. The covariance is
carried along the chain, so that of two plans that end at the goal the surer one is taken: a model
knows which pushes it foresees well. Many chains are started at once, the last action of each looked
up in the map; the best descend the gradient, and the one that remains is corrected against the
model itself until it expects to end at the goal.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from affordlib.planning.effect_map import EffectMap
from affordlib.planning.problem import PlanningProblem, is_on_table
from affordlib.planning.rollout import make_steps, roll_out
from affordlib.types import Plan, check_count

N_STARTS = 192
DIRECTION_SPREAD_RAD = 1.2
MIN_STOP_PHASE = 0.5
N_REFINED = 16
ITERATIONS = 15
STEP = 1e-6
CORRECTIONS, HALVINGS = 5, 4
RISK_WEIGHT = 10.0
"""Weight of the variance beside the squared distance. Without it three-step plans end at 1.77 mm,
with 1 at 0.73, with 10 at 0.41 mm (40 validation goals)."""

ACTION_COST_M = 0.0005
"""An action more must make the end surer by this much."""

SHORTEST_M = 1e-4
"""The least way that an action is counted as, when it is told how many a distance asks for."""


def _starts(
    effects: EffectMap, target: Tensor, n_actions: int, partial: bool, rng: np.random.Generator
) -> tuple[Tensor, Tensor]:
    """Chains (B, K) whose last action is the one in the map that brings them nearest."""
    n = N_STARTS if n_actions > 1 else 1
    bearing = math.atan2(float(target[1]), float(target[0]))
    shape = (n, n_actions - 1)
    direction = torch.from_numpy(
        bearing + rng.uniform(-DIRECTION_SPREAD_RAD, DIRECTION_SPREAD_RAD, shape)
    )
    phase = torch.from_numpy(rng.uniform(MIN_STOP_PHASE, 1.0, shape) if partial else np.ones(shape))
    left, turned = target.expand(n, 2), target.new_zeros(n)
    if n_actions > 1:
        positions, turns, _ = roll_out(effects, direction, phase)
        left, turned = target - positions[:, -1], turns[:, -1]
    c, s = turned.cos(), turned.sin()
    x, y = left.unbind(-1)
    wanted = torch.stack([c * x + s * y, c * y - s * x], dim=-1)
    many = 2 if n_actions > 1 else 2 * N_REFINED
    last_direction, last_phase = effects.nearest(wanted, many, partial)
    last_direction = last_direction + turned[:, None]
    return (
        torch.cat([direction.repeat_interleave(many, 0), last_direction.reshape(-1, 1)], dim=1),
        torch.cat([phase.repeat_interleave(many, 0), last_phase.reshape(-1, 1)], dim=1),
    )


def _objective(
    effects: EffectMap, target: Tensor, direction: Tensor, phase: Tensor
) -> tuple[Tensor, Tensor]:
    """Squared distances and weighed variance (B,) [m²]; positions (B, K, 2) after each action."""
    positions, _, variances = roll_out(effects, direction, phase)
    return (positions[:, -1] - target).square().sum(dim=-1) + RISK_WEIGHT * variances[
        :, -1
    ], positions


def _slopes(
    value: Callable[[Tensor, Tensor], Tensor], direction: Tensor, phase: Tensor
) -> tuple[Tensor, Tensor]:
    """Derivatives (B, K, ...) by direction and by phase of a value (B, ...) of chains (B, K).

    The surfaces are smooth and in double precision, so differences tell them to six digits; asked
    about all 1 + 2K neighbours at once they cost a fraction of going back through a graph. A phase
    is changed towards its inside, so that a whole action has a slope too.
    """
    n, k = direction.shape
    one = STEP * torch.eye(k, dtype=direction.dtype)
    same = one.new_zeros(k + 1, k)
    directions = direction[:, None] + torch.cat([same[:1], one, same[1:]])
    phases = phase[:, None] - torch.cat([same, one])
    values = value(directions.reshape(-1, k), phases.reshape(-1, k))
    values = values.reshape(n, 1 + 2 * k, *values.shape[1:])
    here, by_direction, by_phase = values.split([1, k, k], dim=1)
    return (by_direction - here) / STEP, (here - by_phase) / STEP


@torch.no_grad()
def _descend(
    effects: EffectMap, target: Tensor, direction: Tensor, phase: Tensor, partial: bool
) -> tuple[Tensor, Tensor]:
    """Chains after some steps down the gradient of the expected squared distance."""
    direction, phase = direction.clone(), phase.clone()
    sought = [direction, phase] if partial else [direction]
    optimiser = torch.optim.Adam(
        [{"params": [p], "lr": rate} for p, rate in zip(sought, (0.02, 0.01), strict=False)],
        betas=(0.8, 0.95),
    )
    for _ in range(ITERATIONS):
        slopes = _slopes(lambda *chain: _objective(effects, target, *chain)[0], direction, phase)
        for p, slope in zip(sought, slopes, strict=False):
            p.grad = slope
        optimiser.step()
        phase.clamp_(0, 1)
    return direction, phase


def _correct(
    effects: EffectMap,
    target: Tensor,
    direction: Tensor,
    phase: Tensor,
    partial: bool,
    corrections: int,
) -> tuple[Tensor, tuple[Tensor, Tensor]]:
    """One chain (1, K), brought to the target as the model foresees it, by Newton's method.

    The map's slopes serve for the model's. Returns the chain (K, 2), and the positions (K, 2) and
    turns (K,) that the model foresees.
    """
    ends, turns = _foreseen(effects, direction, phase)
    for _ in range(corrections):
        off = target - ends[-1]
        if float(off.norm()) < 2e-5:
            break
        slopes = _slopes(lambda *chain: roll_out(effects, *chain)[0][:, -1], direction, phase)
        by_direction, by_phase = (one[0].T for one in slopes)
        free = (phase[0] < 1) | (off @ by_phase < 0)
        by_phase = by_phase * (free & partial)
        # A radian moves as far as about half a phase does; weighed so, steps stay small in both.
        scale = torch.cat([torch.ones_like(direction[0]), 0.5 * torch.ones_like(phase[0])])
        slopes = torch.cat([by_direction, by_phase], dim=1) * scale
        step = scale * (torch.linalg.pinv(slopes, rtol=0.05) @ off)
        step = step * min(1.0, 0.3 / max(float(step.abs().max()), 1e-9))
        k = direction.shape[1]
        for _ in range(HALVINGS):
            better = direction + step[:k], (phase + step[k:]).clamp(0, 1)
            moved, turned = _foreseen(effects, *better)
            if (moved[-1] - target).norm() < off.norm():
                break
            step = step / 2
        else:
            break
        (direction, phase), ends, turns = better, moved, turned
    return torch.stack([direction[0], phase[0]], dim=1), (ends, turns)


def _foreseen(effects: EffectMap, direction: Tensor, phase: Tensor) -> tuple[Tensor, Tensor]:
    """Positions (K, 2) and turns (K,) after each action of a chain (1, K), of the model itself.

    An action's effect depends on the turns before it; the map's are near enough to ask all at once,
    and what the model says of the turns then takes their place.
    """
    _, turns, _ = roll_out(effects, direction, phase)
    before = torch.cat([turns.new_zeros(1), turns[0, :-1]])
    told = effects.query_model(direction[0] - before, phase[0])
    c, s = direction[0].cos(), direction[0].sin()
    moves = torch.stack([c * told[:, 0] - s * told[:, 1], s * told[:, 0] + c * told[:, 1]], dim=-1)
    return moves.cumsum(dim=0), told[:, 2].cumsum(dim=0)


def plan_continuous(
    problem: PlanningProblem,
    seed: int = 0,
    draft: bool = False,
    trace: list[tuple[Tensor, Tensor, Tensor]] | None = None,
) -> Plan:
    """Plan over directions and phases at once.

    Where no chain comes near the goal, the plan is the one that comes nearest. draft: a first plan,
    of as few actions as the distance allows and without the descent; of three in a quarter of the
    time. trace, if given, receives for each number of actions K the directions and phases (B, K) of
    the chains that remain, and their costs (B,) [m].
    """
    began = time.perf_counter()
    effects, start, goal, mode = (
        getattr(problem, name) for name in ("effects", "start_xy_m", "goal", "mode")
    )
    rng = np.random.default_rng(check_count("seed", seed, least=0))
    target = torch.from_numpy(np.subtract(goal.xy_m, start))
    fewest = max(1, math.ceil(float(target.norm()) / max(effects.reach_m, SHORTEST_M)))
    best, iterations = None, 0
    if float(target.norm()) > 1e-4:
        for n_actions in range(min(fewest, mode.max_steps), mode.max_steps + 1):
            found = _best_chain(problem, target, n_actions, rng, draft, trace)
            iterations += 0 if draft else ITERATIONS
            if found is not None and (best is None or found[0] < best[0]):
                best = found
            if best is not None and n_actions >= fewest + (not draft):
                break
    steps = ()
    if best is not None:
        direction, phase = best[1:]
        corrections = 1 if draft else CORRECTIONS
        chain, foreseen = _correct(effects, target, direction, phase, mode.partial, corrections)
        if not _allowed(problem, foreseen[0][None], chain[None, :, 0]).all():
            chain, foreseen = torch.stack([direction[0], phase[0]], dim=1), None
        steps = make_steps(effects, start, chain, foreseen)
        if goal.distance_m(steps[-1].predicted_end_xy_m) >= goal.distance_m(start):
            steps = ()  # where nothing brings it nearer, the object stays
    end = steps[-1].predicted_end_xy_m if steps else start
    reaches = goal.distance_m(end) <= goal.tolerance_m
    return problem.plan(steps, "continuous", reaches, iterations, began)


def _allowed(problem: PlanningProblem, positions: Tensor, direction: Tensor) -> Tensor:
    """Which chains (B,) act within reach and keep the object on the table; positions: (B, K, 2)."""
    xy, reachable = np.array(problem.start_xy_m), problem.reachable
    ends = xy + positions.numpy()
    allowed = is_on_table(ends, problem.effects.radius_m)
    if reachable is not None:
        begins = np.concatenate([np.broadcast_to(xy, ends[:, :1].shape), ends[:, :-1]], axis=1)
        told = reachable(begins.reshape(-1, 2), direction.reshape(-1).numpy())
        allowed &= told.reshape(direction.shape)
    return torch.from_numpy(allowed.all(axis=1))


def _best_chain(
    problem: PlanningProblem,
    target: Tensor,
    n_actions: int,
    rng: np.random.Generator,
    draft: bool,
    trace: list[tuple[Tensor, Tensor, Tensor]] | None,
) -> tuple[float, Tensor, Tensor] | None:
    """The cost [m] and the actions (1, K) of the best chain of so many actions, if there is one."""
    effects, partial = problem.effects, problem.mode.partial

    def judged(direction, phase):
        with torch.no_grad():
            expected, positions = _objective(effects, target, direction, phase)
        allowed = _allowed(problem, positions, direction)
        return expected.sqrt() + ACTION_COST_M * n_actions, allowed

    direction, phase = _starts(effects, target, n_actions, partial, rng)
    cost, allowed = judged(direction, phase)
    order = torch.where(allowed, cost, torch.inf).argsort()[: min(N_REFINED, int(allowed.sum()))]
    if not len(order):
        return None
    direction, phase, cost = direction[order], phase[order], cost[order]
    # One action has nothing left to choose once it ends at the goal.
    if n_actions > 1 and not draft:
        after = _descend(effects, target, direction, phase, partial)
        better, allowed = judged(*after)
        direction, phase = torch.cat([direction, after[0]]), torch.cat([phase, after[1]])
        cost = torch.cat([cost, torch.where(allowed, better, torch.inf)])
    if trace is not None:
        trace.append((direction, phase, cost))
    k = int(cost.argmin())
    return float(cost[k]), direction[k : k + 1], phase[k : k + 1]
