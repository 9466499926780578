"""The paper's continuous planner (Section 3.4, Algorithm 1), with two errors corrected.

    direction ← random point on the circle of radius 0.2 m
    repeat    loss ← mean square of (target - predicted effect at t = 1 | e_1 = direction)
              direction ← direction - gradient step              until it no longer changes
    query the whole action and effect trajectory; stop at the phase of least distance to the target

In the printed pseudo-code `index` and the object's pose are never updated; here they are. As in the
paper, only the position counts: each action is predicted for the object as its image shows it,
although earlier actions may rotate it (`predicted_turn_rad` is the rotation). The robot executes
the decoded action trajectory; `snap` replaces it by the push in the same direction.
"""

import math
import time
import warnings

import numpy as np
import torch

from affordlib.geometry import xy_columns
from affordlib.models.domain import OutOfRangeWarning
from affordlib.models.protocol import EffectModel, condition_on_final_effect
from affordlib.planning.effect_map import EffectMap
from affordlib.planning.problem import PlanningProblem
from affordlib.planning.rollout import PATH_SAMPLES
from affordlib.primitives import Drag
from affordlib.types import Plan, Prediction, Step, check_count

START_RADIUS_M = 0.2
LEARNING_RATE_M = 0.005
CONVERGED_M = 1e-4
STILL_ITERATIONS = 10
MAX_ITERATIONS = 300
SUCCESS_M = 0.002
NEARER_M = 0.0005


def descend(
    effects: EffectMap,
    target_xy_m: np.ndarray,
    generator: np.random.Generator,
    starts: int = 1,
    direction_only: bool = False,
    trace: list[tuple[np.ndarray, np.ndarray]] | None = None,
) -> torch.Tensor:
    """Find effect inputs (starts, C_e) whose predicted effect at t = 1 is near the target (2,).

    Descends the gradient of the mean square error with Adam, on the input alone, from several
    random starts in parallel; returns the best first. direction_only keeps the input on the circle
    of effects that full pushes have. trace, if given, receives each iteration's inputs (starts, 2)
    [m] and losses (starts,) [m²]. Without direction_only, as published, inputs may be effects that
    no push has; `OutOfRangeWarning` is suppressed.
    """
    model, features = effects.model, effects.features
    columns = xy_columns(model.effect_channels)
    radius = START_RADIUS_M
    if direction_only:
        full, _ = effects.query(np.arange(12) * (math.pi / 6), torch.ones(12, 1))
        radius = float(full[..., :2].norm(dim=-1).mean())
    angle = torch.as_tensor(generator.uniform(0, 2 * math.pi, size=starts), dtype=torch.float32)
    circle = radius * torch.stack([angle.cos(), angle.sin()], dim=1)
    sought = (angle if direction_only else circle).requires_grad_()
    optimiser = torch.optim.Adam([sought], lr=LEARNING_RATE_M / (radius if direction_only else 1))
    target = torch.as_tensor(target_xy_m, dtype=torch.float32)
    at_end = torch.ones(starts, 1)
    before = circle.detach()
    still = 0
    for _ in range(MAX_ITERATIONS):
        xy = radius * torch.stack([sought.cos(), sought.sin()], dim=1) if direction_only else sought
        effect = torch.zeros(starts, len(model.effect_channels))
        effect[:, columns] = xy
        prediction = _predict(model, features, effect, at_end)
        losses = (prediction.effect_mean[:, 0, columns] - target).square().mean(dim=-1)
        if trace is not None:
            trace.append((xy.detach().numpy().copy(), losses.detach().numpy().copy()))
        change = float((xy.detach() - before).norm(dim=-1).max())
        still = still + 1 if change < CONVERGED_M else 0
        if still == STILL_ITERATIONS:
            break
        before = xy.detach().clone()
        (sought.grad,) = torch.autograd.grad(losses.sum(), [sought])
        optimiser.step()
    return effect.detach()[losses.detach().argsort(stable=True)]


def _predict(
    model: EffectModel, features: torch.Tensor, effect: torch.Tensor, t: torch.Tensor
) -> Prediction:
    with warnings.catch_warnings(action="ignore", category=OutOfRangeWarning):
        return model.predict(features, condition_on_final_effect(model, effect), t)


def plan_gradient(
    problem: PlanningProblem,
    samples: int = 100,
    starts: int = 1,
    direction_only: bool = False,
    seed: int = 0,
    snap: bool = False,
) -> Plan:
    """Plan by gradient descent, as in the paper.

    samples: phases at which the trajectory is queried, which limit the resolution of the stop
    phase. starts: random starts of the descent; the paper has one, which fails if it lies opposite
    the goal. direction_only (ours): search on the circle of effects that actions have instead of
    the whole plane, where the network can be made to predict anything. snap: execute the primitive
    in the decoded direction instead of the decoded trajectory, as drags always are. The best start
    whose action is reachable is used; without one, the plan ends.
    """
    began = time.perf_counter()
    check_count("samples", samples, 2, 10_000)
    check_count("starts", starts, 1, 100)
    effects, (model, kind) = problem.effects, (problem.effects.model, problem.effects.kind)
    goal, mode = problem.goal, problem.mode
    columns = xy_columns(model.effect_channels)
    a_columns = [model.action_channels.index(name) for name in ("x", "y")]
    effects.query(np.zeros(1), torch.ones(1, 1))  # raises if the model is of other actions
    generator = np.random.default_rng(check_count("seed", seed, least=0))
    xy, target = np.asarray(problem.start_xy_m), np.asarray(goal.xy_m)
    steps: list[Step] = []
    turned = 0.0
    t = torch.linspace(0, 1, samples)
    while len(steps) < mode.max_steps and np.hypot(*(target - xy)) > SUCCESS_M:
        # Use the best start whose action is reachable.
        for effect in descend(effects, target - xy, generator, starts, direction_only):
            with torch.no_grad():
                prediction = _predict(model, effects.features, effect[None], t[None])
            action = prediction.action_mean[0, :, a_columns].numpy().astype(float)
            angle = math.atan2(*(action[-1] - action[0])[::-1])
            if problem.reachable(xy[None], np.array([angle]))[0]:
                break
        else:
            break
        path = prediction.effect_mean[0, :, columns].numpy().astype(float)
        std = prediction.effect_std[0, :, columns].norm(dim=-1).numpy()
        stop = samples - 1
        if mode.partial:
            distance = np.hypot(*(xy + path - target).T)
            stop = int(np.argmin(distance))
            if distance[stop] > SUCCESS_M and distance[-1] - distance[stop] < NEARER_M:
                stop = samples - 1  # only noise at the path's end: the goal lies beyond it
        if stop == 0:
            break
        xy_before, xy = xy, xy + path[stop]
        if "yaw" in model.effect_channels:
            turned += float(prediction.effect_mean[0, stop, model.effect_channels.index("yaw")])
        shown = np.linspace(0, stop, min(PATH_SAMPLES, stop + 1)).round().astype(int)
        steps.append(
            Step(
                kind.towards(angle),
                float(t[stop]),
                tuple(xy.tolist()),
                xy_before + path[shown],
                None if snap or kind is Drag else action[: stop + 1],
                float(std[stop]),
                turned,
            )
        )
        if stop < samples - 1:
            break
    reached = bool(np.hypot(*(target - xy)) <= goal.tolerance_m)
    name = "gradient" + "_direction" * direction_only + "_snapped" * snap
    return problem.plan_of(tuple(steps), name, reached, began)
