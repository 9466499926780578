"""The paper's continuous planner (Section 3.4, Algorithm 1), with two errors corrected.

    direction ← random point on a circle
    repeat    loss ← mean square of (target - predicted effect at t = 1 | e_1 = direction)
              direction ← direction - rate · gradient         until the direction is still
    query the action and effect trajectory in that direction; stop where it is nearest the target

The pseudo-code never updates `index` and the object's pose; this does. As in the paper, actions are
predicted for the object as its image shows it, and executed as decoded (drags as primitives).
"""

import math
import time
import warnings
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import torch
from torch.nn.functional import normalize

from affordlib.geometry import xy_columns
from affordlib.models.base import condition_on_final_effect
from affordlib.models.domain import OutOfRangeWarning
from affordlib.planning.effect_map import EffectMap
from affordlib.planning.free_space import N_POSES
from affordlib.planning.problem import PlanningProblem
from affordlib.primitives import Drag
from affordlib.types import Checked, Plan, Step, check_choice, check_count, count, number, parameter

DESCENTS = {"gradient": (torch.optim.SGD, 0.3), "adam": (torch.optim.Adam, 0.003)}
"""Optimiser and its rate, the best on the validation goals (`RATES` of `experiments.planning`)."""

STILL = {"direction": 1e-3, "point": 1e-4}
"""Change per iteration, of the direction [rad] or the point [m], below which it is still."""

STILL_ITERATIONS, MAX_ITERATIONS, MAX_DRAWS = 10, 300, 5
CIRCLE_M, SUCCESS_M, NEARER_M = 0.2, 0.002, 0.0005


@dataclass(frozen=True)
class Reading(Checked):
    """A reading of Algorithm 1; the defaults are *as printed* in our tables.

    descent: by the "gradient" or by "adam"; rate: its rate. start: on the "ring" of effects that
    full actions have, or on the "circle" of 0.2 m where pushes start. finds: the "direction" in
    which the trajectory is then queried, or the "point" itself. starts: random starts; the best
    that is reachable and leads nearer to the goal is used.
    """

    descent: str = parameter(partial(check_choice, known=DESCENTS), "gradient")
    start: str = parameter(partial(check_choice, known=("ring", "circle")), "ring")
    finds: str = parameter(partial(check_choice, known=STILL), "direction")
    rate: float | None = number(1e-9, 1e3, default=None)
    starts: int = count(1, 1, 100)


def descend(
    effects: EffectMap,
    target_xy_m: np.ndarray,
    generator: np.random.Generator,
    reading: Reading = Reading(),
    trace: list[tuple[np.ndarray, np.ndarray]] | None = None,
) -> torch.Tensor:
    """Effects (starts, 2) that, given to the model, are predicted nearest a target: best first.

    trace, if given, receives each iteration's inputs (starts, 2) [m] and losses (starts,) [m²].
    """
    ring_m = float(effects.grid[0][:, -1, :2].norm(dim=-1).mean())
    angle = torch.tensor(generator.uniform(0, 2 * math.pi, reading.starts), dtype=torch.float32)
    xy = torch.stack([angle.cos(), angle.sin()], dim=1)
    xy *= ring_m if reading.start == "ring" else CIRCLE_M
    method, usual_rate = DESCENTS[reading.descent]
    optimiser = method([xy], lr=reading.rate or usual_rate)
    target, still = torch.as_tensor(target_xy_m, dtype=torch.float32), 0
    frame = normalize if reading.finds == "direction" else torch.clone
    for _ in range(MAX_ITERATIONS):
        xy.requires_grad_()
        losses = (decoded(effects, xy, torch.ones(1))[1][:, 0] - target).square().mean(dim=-1)
        (xy.grad,) = torch.autograd.grad(losses.sum(), [xy])
        before, now = xy.detach().clone(), xy.detach()
        if trace is not None:
            trace.append((before.numpy(), losses.detach().numpy()))
        optimiser.step()
        change = (frame(now) - frame(before)).norm(dim=-1).max()
        still = still + 1 if float(change) < STILL[reading.finds] else 0
        if still == STILL_ITERATIONS:
            break
    found = ring_m * normalize(now) if reading.finds == "direction" else now
    return found[losses.detach().argsort(stable=True)]


def decoded(effects: EffectMap, xy: torch.Tensor, t: torch.Tensor) -> tuple[Any, ...]:
    """Prediction at phases (T,), with its x and y of effect and action, from effects (n, 2)."""
    model, columns = effects.model, xy_columns(effects.model.effect_channels)
    effect = torch.zeros(len(xy), len(model.effect_channels))
    effect[:, columns] = xy
    observed = condition_on_final_effect(model, effect)
    with warnings.catch_warnings(action="ignore", category=OutOfRangeWarning):  # a descent passes
        found = model.predict(effects.features, observed, t.expand(len(xy), -1))
    action = found.action_mean[..., xy_columns(model.action_channels)]
    return found, found.effect_mean[..., columns], action


def plan_gradient(
    problem: PlanningProblem, samples: int = 100, seed: int = 0, reading: Reading = Reading()
) -> Plan:
    """Plan by gradient descent; a trajectory is queried at a number of samples.

    Where no start leads nearer to the goal, they are drawn again, `MAX_DRAWS` times in a plan.
    """
    began = time.perf_counter()
    samples = check_count("samples", samples, 2, 10_000)
    generator = np.random.default_rng(check_count("seed", seed, least=0))
    goal, steps = problem.goal, []
    here, draws = np.array(problem.start_xy_m), 0
    while len(steps) < problem.mode.max_steps and goal.distance_m(here) > SUCCESS_M:
        found = descend(problem.effects, goal.xy_m - here, generator, reading)
        turned = steps[-1].predicted_turn_rad if steps else 0.0
        every = (_step(problem, xy, here, turned, samples) for xy in found)
        if step := next(filter(None, every), None):
            steps.append(step)
            here = np.array(step.predicted_end_xy_m)
        draws += step is None
        if draws == MAX_DRAWS or (step and step.stop_phase < 1):
            break
    reached = goal.distance_m(here) <= goal.tolerance_m
    if draws == MAX_DRAWS:
        n = reading.starts * MAX_DRAWS
        warnings.warn(f"none of {n} random starts led nearer to the goal", stacklevel=2)
    return problem.plan_of(tuple(steps), "gradient", reached, began)


def _step(
    problem: PlanningProblem, xy: torch.Tensor, here: np.ndarray, turned: float, samples: int
) -> Step | None:
    """Decode the action for an effect (2,); None if it is out of reach or leads no nearer."""
    effects, channels = problem.effects, problem.effects.model.effect_channels
    t = torch.linspace(0, 1, samples)
    with torch.no_grad():
        found, path, action = decoded(effects, xy[None], t)
    path, action = here + path[0].numpy().astype(float), action[0].numpy().astype(float)
    angle = math.atan2(*(action[-1] - action[0])[::-1])
    away = np.hypot(*(path - problem.goal.xy_m).T)
    stop = int(np.argmin(away)) if problem.mode.partial else samples - 1
    if away[stop] > SUCCESS_M and away[-1] - away[stop] < NEARER_M:
        stop = samples - 1  # only noise makes an earlier sample nearer
    nearer = stop > 0 and away[stop] < problem.goal.distance_m(here) - NEARER_M
    if not (nearer and problem.reachable(here[None], np.array([angle]))[0]):
        return None
    turns = np.full(samples, turned)
    if "yaw" in channels:
        turns += found.effect_mean[0, :, channels.index("yaw")].double().numpy()
    if problem.obstacles:
        shown = np.linspace(0, stop, N_POSES).round().astype(int)
        poses = np.column_stack([path, turns])[None, shown]
        kind, at = effects.kind.towards(angle), np.array([t[stop].item()])
        if problem.free_space.spare_m(kind, np.array([angle]), at, poses)[0] < 0:
            return None
    path_of_hand = None if effects.kind is Drag else action[: stop + 1]
    std_m = float(found.effect_std[0, stop, xy_columns(channels)].norm())
    primitive, end = effects.kind.towards(angle), tuple(path[stop].tolist())
    return Step(primitive, float(t[stop]), end, path[: stop + 1], path_of_hand, std_m, turns[stop])
