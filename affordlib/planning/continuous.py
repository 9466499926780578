"""Our continuous planner: joint optimisation of the directions and phases of all actions.

    p_k+1 = p_k + R(φ_k) e(φ_k - ψ_k, t_k),   ψ_k+1 = ψ_k + e_ψ(φ_k - ψ_k, t_k)
    minimise |p_K - goal|² + λ tr Cov p_K   over φ_1, t_1, …, φ_K, t_K

e is the object's effect map, p and ψ are its position and rotation. λ = 1 gives the expected
squared distance; a larger λ, the risk weight, weights the variance more. The covariance is
propagated along the chain, so that of two plans ending at the goal the one of lower variance is
chosen: the model's uncertainty differs between pushes. Many chains are started together; the best
follow the gradient, and the best of all is corrected by queries of the model itself.
"""

import math
import time
from collections.abc import Callable
from functools import partial

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from affordlib.geometry import rotate
from affordlib.planning.effect_map import EffectMap, make_steps, roll_out
from affordlib.planning.problem import PlanningProblem
from affordlib.types import Plan, check_count, check_within, on_table

N_STARTS, N_REFINED = 192, 16
"""Number of initial chains, and of the best of them that are refined by gradient descent."""

DIRECTION_SPREAD_RAD, MIN_STOP_PHASE = 1.2, 0.5
"""First actions are drawn within this angle of the goal direction, with at least this phase."""

N_FREE_STARTS, N_CHECKED, NEAR_M = (256, 1024), 96, 0.01
"""Beside obstacles: chains drawn, more if none is near; chains of the least cost whose way is
checked before the refinement; and the cost [m] of a chain that is near."""

ITERATIONS, BETAS = 15, (0.8, 0.95)
DIFFERENCE = 1e-6
CORRECTIONS, HALVINGS = 5, 4
EXACT_M, WELL_M = 2e-5, 2e-4
"""Predicted distances [m] from the goal, below which no correction or no other chain is tried."""

RISK_WEIGHT = 10.0
"""Default weight λ. Confirmed on 40 validation goals: plans of up to three actions end 0.66 mm from
the goal with λ = 0, 0.62 mm with 1, 0.37 mm with 10 and 0.48 mm with 30."""

ACTION_COST_M = 0.0005
"""Cost per action [m], added to the square root of the objective."""

Chains = tuple[Tensor, Tensor]
"""Directions [rad] and phases (B, K) of B chains of K actions."""

Objective = Callable[[Chains], tuple[Tensor, Tensor]]
"""Function of chains that returns their objective (B,) [m²] and positions (B, K, 2)."""


def starts(
    problem: PlanningProblem, target: Tensor, n_actions: int, n: int, rng: np.random.Generator
) -> Chains:
    """Draw n chains; the last action of each is one in the map that ends nearest to the target."""
    effects, stops_early = problem.effects, problem.mode.partial
    n = n if n_actions > 1 else 1
    bearing, spread = math.atan2(float(target[1]), float(target[0])), DIRECTION_SPREAD_RAD
    if problem.obstacles:
        direction, phase = _free_chains(problem, bearing, n_actions - 1, n, rng)
        n = len(direction)
        if not n:
            return direction.new_zeros(2, 0, n_actions).unbind()
    else:
        shape = (n, n_actions - 1)
        direction = torch.from_numpy(bearing + rng.uniform(-spread, spread, shape))
        phase = torch.from_numpy(
            rng.uniform(MIN_STOP_PHASE, 1.0, shape) if stops_early else np.ones(shape)
        )
    left, turned = target.expand(n, 2), target.new_zeros(n)
    if n_actions > 1:
        positions, turns, _ = roll_out(effects, direction, phase, False)
        left, turned = target - positions[:, -1], turns[:, -1]
    many = 2 if n_actions > 1 else (2 + 4 * bool(problem.obstacles)) * N_REFINED
    last_direction, last_phase = effects.nearest(rotate(left, -turned), many, stops_early)
    last_direction = last_direction + turned[:, None]
    return (
        torch.cat([direction.repeat_interleave(many, 0), last_direction.reshape(-1, 1)], dim=1),
        torch.cat([phase.repeat_interleave(many, 0), last_phase.reshape(-1, 1)], dim=1),
    )


def _free_chains(
    problem: PlanningProblem, bearing: float, n_actions: int, n: int, rng: np.random.Generator
) -> Chains:
    """Draw up to n chains in free space, action after action; half of them towards the goal."""
    direction = phase = torch.zeros(1, 0, dtype=torch.float64)
    for _ in range(n_actions):
        parent = rng.integers(len(direction), size=n)
        spread = np.where(np.arange(n) % 2, DIRECTION_SPREAD_RAD, math.pi)
        stop = rng.uniform(MIN_STOP_PHASE, 1.0, n) if problem.mode.partial else np.ones(n)
        angle = bearing + spread * rng.uniform(-1, 1, n)
        direction = torch.cat([direction[parent], torch.from_numpy(angle)[:, None]], dim=1)
        phase = torch.cat([phase[parent], torch.from_numpy(stop)[:, None]], dim=1)
        kept = free(problem, (direction, phase), last=True)
        direction, phase = direction[kept], phase[kept]
        if not len(direction):
            break
    return direction, phase


def free(problem: PlanningProblem, chains: Chains, last: bool = False) -> Tensor:
    """Return whether chains (B,), or the last action of each, are allowed and meet no obstacle."""
    direction, phase = chains
    positions, turns, _ = roll_out(problem.effects, direction, phase, False)
    poses = torch.cat([positions, turns[..., None]], dim=-1)
    begins = torch.cat([torch.zeros_like(poses[:, :1]), poses[:, :-1]], dim=1)
    begins[..., :2] += torch.tensor(problem.start_xy_m)
    actions = (v[:, -1 if last else 0 :].flatten(0, 1) for v in (begins, direction, phase))
    begins, *actions = actions
    spare_m = problem.spare_m(begins.numpy(), *actions).reshape(len(positions), -1)
    clear = torch.from_numpy((spare_m >= 0).all(axis=1))
    return clear & _allowed(problem, positions, direction)


def objective(
    effects: EffectMap, target: Tensor, chains: Chains, risk_weight: float = RISK_WEIGHT
) -> tuple[Tensor, Tensor]:
    """Objective (B,) [m²] and positions (B, K, 2) after each action."""
    positions, _, variances = roll_out(effects, *chains)
    squared = (positions[:, -1] - target).square().sum(dim=-1)
    return squared + risk_weight * variances[:, -1], positions


def _slopes(value: Callable[..., Tensor], direction: Tensor, phase: Tensor) -> Chains:
    """Derivatives (B, K, ...) of a value (B, ...) of chains by direction and by phase.

    The surfaces are smooth and in double precision, so finite differences have six correct digits;
    all 1 + 2K neighbours are queried together. The difference in phase is backward, since a phase
    of 1 cannot grow.
    """
    n, k = direction.shape
    one = DIFFERENCE * torch.eye(k, dtype=direction.dtype)
    same = one.new_zeros(k + 1, k)
    directions = direction[:, None] + torch.cat([same[:1], one, same[1:]])
    phases = phase[:, None] - torch.cat([same, one])
    values = value(directions.reshape(-1, k), phases.reshape(-1, k))
    values = values.reshape(n, 1 + 2 * k, *values.shape[1:])
    here, by_direction, by_phase = values.split([1, k, k], dim=1)
    return (by_direction - here) / DIFFERENCE, (here - by_phase) / DIFFERENCE


@torch.no_grad()
def _descend(value: Objective, chains: Chains, stops_early: bool) -> Chains:
    """The chains after steps of Adam; that of `torch.optim` takes a second to import."""
    direction, phase = (v.clone() for v in chains)
    sought = (direction, 0.02), (phase, 0.01 * stops_early)
    means, squares = ([torch.zeros_like(direction) for _ in sought] for _ in range(2))
    for k in range(1, ITERATIONS + 1):
        slopes = _slopes(lambda *near: value(near)[0], direction, phase)
        for (p, rate), slope, mean, square in zip(sought, slopes, means, squares, strict=True):
            mean.lerp_(slope, 1 - BETAS[0])
            square.lerp_(slope.square(), 1 - BETAS[1])
            size = (square / (1 - BETAS[1] ** k)).sqrt() + 1e-8
            p -= rate / (1 - BETAS[0] ** k) * mean / size
        phase.clamp_(0, 1)
    return direction, phase


def _correct(
    effects: EffectMap, target: Tensor, chains: Chains, stops_early: bool
) -> tuple[Chains, Tensor, Tensor]:
    """Correct chains (B, K) by Newton's method until their ends by the model are the target.

    The derivatives are the map's. Returns the chains, and what `_predicted` says of them.
    """
    direction, phase = (v.clone() for v in chains)
    ends, turns = _predicted(effects, direction, phase)
    k, nearer = direction.shape[1], torch.ones(len(direction), dtype=torch.bool)
    # One radian moves the end about as far as half the phase does; this scales the two alike.
    scale = torch.tensor([1.0, 0.5], dtype=phase.dtype).repeat_interleave(k)
    for _ in range(CORRECTIONS):
        away = (target - ends[:, -1]).norm(dim=1)
        rows = (nearer & (away >= EXACT_M)).nonzero()[:, 0]
        if not len(rows):
            break
        near, off = (direction[rows], phase[rows]), target - ends[rows, -1]
        slopes = _slopes(lambda *near: roll_out(effects, *near, False)[0][:, -1], *near)
        by_direction, by_phase = (one.mT for one in slopes)
        free = (near[1] < 1) | ((off[:, None] @ by_phase)[:, 0] < 0)
        slopes = torch.cat([by_direction, by_phase * (free & stops_early)[:, None]], dim=2) * scale
        # Singular values below 5 % of the largest are dropped, as their steps would be long; beyond
        # 0.3 rad, or 0.3 of the phase, the linearisation is invalid.
        step = scale * (torch.linalg.pinv(slopes, rtol=0.05) @ off[..., None])[..., 0]
        step = step * (0.3 / step.abs().amax(dim=1, keepdim=True).clamp_min(1e-9)).clamp_max(1)
        nearer[rows] = False
        for _ in range(HALVINGS):
            better = direction[rows] + step[:, :k], (phase[rows] + step[:, k:]).clamp(0, 1)
            moved, turned = _predicted(effects, *better)
            good = (moved[:, -1] - target).norm(dim=1) < away[rows]
            found = *better, moved, turned
            for old, new in zip((direction, phase, ends, turns), found, strict=True):
                old[rows[good]] = new[good]
            nearer[rows[good]] = True
            rows, step = rows[~good], step[~good] / 2
            if not len(rows):
                break
    return (direction, phase), ends, turns


def _predicted(effects: EffectMap, direction: Tensor, phase: Tensor) -> tuple[Tensor, Tensor]:
    """Positions (B, K, 2) and rotations (B, K) after each action of chains (B, K), by the model.

    An action's effect depends on the rotations before it. The map's rotations are accurate enough
    to query all actions together; the model's are returned.
    """
    _, turns, _ = roll_out(effects, direction, phase, False)
    relative = direction - F.pad(turns[:, :-1], (1, 0))
    effect = effects.query_model(relative.flatten(), phase.flatten()).view(*phase.shape, 3)
    return rotate(effect[..., :2], direction).cumsum(dim=1), effect[..., 2].cumsum(dim=1)


def plan_continuous(
    problem: PlanningProblem,
    seed: int = 0,
    trace: list[tuple[Tensor, Tensor, Tensor]] | None = None,
    risk_weight: float = RISK_WEIGHT,
) -> Plan:
    """Plan by optimising directions and phases together.

    Where no chain comes near the goal, the plan is the one that comes nearest. trace,
    if given, receives for each number of actions K the directions and phases (B, K) of the
    remaining chains, and their costs (B,) [m]. risk_weight: λ.
    """
    began = time.perf_counter()
    effects, start, goal, mode = problem.effects, problem.start_xy_m, problem.goal, problem.mode
    rng = np.random.default_rng(check_count("seed", seed, least=0))
    target = torch.from_numpy(np.subtract(goal.xy_m, start))
    fewest = max(1, math.ceil(float(target.norm()) / max(effects.reach_m, 1e-4)))
    risk_weight = check_within("risk_weight", risk_weight, 0.0, 1e6)
    value = partial(objective, effects, target, risk_weight=risk_weight)
    candidates = []
    for n in N_FREE_STARTS if problem.obstacles else (N_STARTS,):
        if float(target.norm()) < 1e-4 or (candidates and candidates[0][0] < NEAR_M):
            break
        for n_actions in range(min(fewest, mode.max_steps), mode.max_steps + 1):
            candidates += _best_chain(problem, value, target, (n, n_actions), rng, trace)
            candidates.sort(key=lambda one: one[0])
            enough = fewest + 1
            if problem.obstacles:
                enough = 1 if candidates and candidates[0][0] < NEAR_M else math.inf
            if candidates and n_actions >= enough:
                break
    # The plan remains empty if none ends nearer to the goal.
    steps, least_m = (), goal.distance_m(start)
    near = [one for one in candidates if problem.obstacles and one[0] < NEAR_M]
    near = near or candidates[:1]
    for some in filter(None, (near[:1], near[1:])):
        if least_m < WELL_M:
            break
        chains = tuple(map(torch.cat, list(zip(*some, strict=True))[1:]))
        corrected, ends, turns = _correct(effects, target, chains, mode.partial)
        ok = _allowed(problem, ends, corrected[0])
        if problem.obstacles:
            ok &= free(problem, corrected)
        for k in range(len(some)):
            chain = torch.stack([one[k] for one in (corrected if ok[k] else chains)], dim=1)
            found = make_steps(effects, start, chain, (ends[k], turns[k]) if ok[k] else None)
            if (away_m := goal.distance_m(found[-1].predicted_end_xy_m)) < least_m:
                steps, least_m = found, away_m
            if least_m < WELL_M:
                break
    reaches = least_m <= goal.tolerance_m
    return problem.plan_of(steps, "continuous", reaches, began)


def _allowed(problem: PlanningProblem, positions: Tensor, direction: Tensor) -> Tensor:
    """Whether chains (B,) are reachable and keep the object on the table; positions: (B, K, 2)."""
    xy = np.array(problem.start_xy_m)
    ends = xy + positions.numpy()
    begins = np.concatenate([np.broadcast_to(xy, ends[:, :1].shape), ends[:, :-1]], axis=1)
    within = problem.reachable(begins.reshape(-1, 2), direction.reshape(-1).numpy())
    inside = on_table(ends, problem.effects.radius_m)
    return torch.from_numpy((inside & within.reshape(direction.shape)).all(axis=1))


def _best_chain(
    problem: PlanningProblem,
    value: Objective,
    target: Tensor,
    size: tuple[int, int],
    rng: np.random.Generator,
    trace: list[tuple[Tensor, Tensor, Tensor]] | None,
) -> list[tuple[float, Tensor, Tensor]]:
    """Costs [m] and actions (1, K) of the best of n chains, best first; size: (n, K)."""
    stops_early, (n, n_actions) = problem.mode.partial, size

    def costs(direction, phase):
        expected, positions = value((direction, phase))
        cost = expected.sqrt() + ACTION_COST_M * n_actions
        return torch.where(_allowed(problem, positions, direction), cost, torch.inf)

    direction, phase = starts(problem, target, n_actions, n, rng)
    cost = costs(direction, phase) if len(direction) else direction.new_zeros(0)
    order = cost.argsort()[: int(cost.isfinite().sum())]
    if problem.obstacles and len(order):
        order = order[:N_CHECKED]
        order = order[free(problem, (direction[order], phase[order]), last=True)]
    order = order[:N_REFINED]
    if not len(order):
        return []
    direction, phase, cost = direction[order], phase[order], cost[order]
    # A single action that ends at the goal has no free parameter left to optimise.
    if n_actions > 1:
        after = _descend(value, (direction, phase), stops_early)
        lower = costs(*after)
        if problem.obstacles:
            lower = torch.where(free(problem, after), lower, torch.inf)
        cost = torch.cat([cost, lower])
        direction, phase = torch.cat([direction, after[0]]), torch.cat([phase, after[1]])
    if trace is not None:
        trace.append((direction, phase, cost))
    best = cost.argsort(stable=True)[: N_REFINED if problem.obstacles else 1].tolist()
    return [(float(cost[k]), direction[k : k + 1], phase[k : k + 1]) for k in best]
