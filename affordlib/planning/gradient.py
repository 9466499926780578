"""The paper's continuous planner (Section 3.4, Algorithm 1), its two slips mended.

    direction ← random point on the circle of radius 0.2 m
    repeat    loss ← mean square of (target - predicted effect at t = 1 | e_1 = direction)
              direction ← direction - gradient step              until it no longer changes
    query the whole action and effect trajectory; stop at the phase of least distance to the target

In the printed pseudo-code `index` never grows and the object's pose never advances; here they do.
The decoded action trajectory is what the robot executes; `snap` replaces it by the push in the same
direction.
"""

from __future__ import annotations

import math
import time
from typing import TYPE_CHECKING

import numpy as np
import torch

from affordlib.models.protocol import observe_final_effect
from affordlib.planning.modes import PATH_SAMPLES, PlanMode, encode_image, mode_named, plane
from affordlib.primitives import Push
from affordlib.types import Goal, Plan, Step, check_on_table

if TYPE_CHECKING:
    from collections.abc import Sequence

    from affordlib.models.protocol import EffectModel

START_RADIUS_M = 0.2
LEARNING_RATE_M = 0.005
CONVERGED_M = 1e-5
MAX_ITERATIONS = 400
SUCCESS_M = 0.002


def descend(
    model: EffectModel,
    features: torch.Tensor,
    target_xy_m: np.ndarray,
    generator: np.random.Generator,
    trace: list[tuple[np.ndarray, float]] | None = None,
) -> tuple[torch.Tensor, int]:
    """The effect input (1, C_e) whose predicted effect at t = 1 is nearest to the target (2,).

    Descends the gradient of the mean square error with Adam, on the input alone. trace, if given,
    receives each iteration's input (2,) [m] and loss [m²].
    """
    angle = generator.uniform(0, 2 * math.pi)
    columns = plane(model)
    effect = torch.zeros(1, len(model.effect_channels))
    effect[0, columns] = START_RADIUS_M * torch.tensor([math.cos(angle), math.sin(angle)])
    effect.requires_grad_()
    target = torch.as_tensor(target_xy_m, dtype=torch.float32)
    optimiser = torch.optim.Adam([effect], lr=LEARNING_RATE_M)
    at_end = torch.ones(1, 1)
    iterations = 0
    while iterations < MAX_ITERATIONS:
        iterations += 1
        prediction = model.predict(features, observe_final_effect(model, effect), at_end)
        loss = (prediction.effect_mean[0, 0, columns] - target).square().mean()
        (effect.grad,) = torch.autograd.grad(loss, [effect])
        before = effect.detach().clone()
        if trace is not None:
            trace.append((before[0, columns].numpy().copy(), float(loss.detach())))
        optimiser.step()
        if float((effect.detach() - before).norm()) < CONVERGED_M:
            break
    return effect.detach(), iterations


def plan_gradient(
    model: EffectModel,
    image: np.ndarray,
    start_xy_m: Sequence[float],
    goal: Goal,
    mode: str | PlanMode = "multi_partial",
    samples: int = 100,
    seed: int = 0,
    snap: bool = False,
) -> Plan:
    """Plan from the object's position [m] and depth image (2, 48, 48) to a goal, by gradient.

    samples: number of phases at which the trajectory is queried; it bounds how finely an action
    can be cut. snap: execute Push(theta) instead of the decoded action trajectory.
    """
    began = time.perf_counter()
    mode = mode_named(mode)
    start = check_on_table("start_xy_m", start_xy_m)
    if isinstance(samples, bool) or not isinstance(samples, int) or samples < 2:
        raise ValueError(f"samples must be a whole number of at least 2, got {samples!r}")
    columns = plane(model)
    a_columns = [model.action_channels.index(name) for name in ("x", "y")]
    features = encode_image(model, image)
    generator = np.random.default_rng(seed)
    xy, target = np.asarray(start), np.asarray(goal.xy_m)
    steps: list[Step] = []
    iterations = 0
    t = torch.linspace(0, 1, samples)
    while len(steps) < mode.max_steps and np.hypot(*(target - xy)) > SUCCESS_M:
        effect, n = descend(model, features, target - xy, generator)
        iterations += n
        with torch.no_grad():
            prediction = model.predict(features, observe_final_effect(model, effect), t[None])
        path = prediction.effect_mean[0, :, columns].numpy().astype(float)
        action = prediction.action_mean[0, :, a_columns].numpy().astype(float)
        std = prediction.effect_std[0, :, columns].norm(dim=-1).numpy()
        stop = samples - 1
        if mode.partial:
            stop = int(np.argmin(np.hypot(*(xy + path - target).T)))
        if stop == 0:
            break
        # A model's path need not begin exactly at rest; what counts is how far it carries.
        end = xy + path[stop]
        shown = np.linspace(0, stop, min(PATH_SAMPLES, stop + 1)).round().astype(int)
        heading = action[-1] - action[0]
        push = Push.towards(math.atan2(heading[1], heading[0]))
        decoded = None if snap else action[: stop + 1]
        steps.append(
            Step(
                push,
                float(t[stop]),
                tuple(end.tolist()),
                xy + path[shown],
                decoded,
                float(std[stop]),
            )
        )
        xy = end
        if stop < samples - 1:
            break
    reached = bool(np.hypot(*(target - xy)) <= goal.tolerance_m)
    name = "gradient_snapped" if snap else "gradient"
    return Plan(goal, start, tuple(steps), name, reached, iterations, time.perf_counter() - began)
