"""Chains of actions on an effect map: predicted poses with σ, and conversion to a plan's steps."""

import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from affordlib.geometry import rotate, rotated
from affordlib.planning.effect_map import EffectMap
from affordlib.types import Step

PATH_SAMPLES = 25
"""Number of points of a step's predicted path, as in Section 4.3."""


def roll_out(
    effects: EffectMap, direction_rad: Tensor, phase: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Positions (B, K, 2) [m], turns (B, K) [rad] and variances (B, K) [m²] after each action.

    direction_rad, phase: (B, K), of chains that start at the origin. The variance is the trace of
    the position's covariance, to which the rotation's variance adds in later actions.
    """
    n, k_max = direction_rad.shape
    position, turned = direction_rad.new_zeros(n, 2), direction_rad.new_zeros(n)
    # The trace of the position's covariance, the turn's variance, and the covariance of the two.
    trace, turn_variance = torch.zeros_like(turned), torch.zeros_like(turned)
    covariance = torch.zeros_like(position)
    after = []
    nearby = torch.tensor([0.0, -0.02, 0.02], dtype=direction_rad.dtype)
    for k in range(k_max):
        angle = direction_rad[:, k]
        effect, std = effects((angle - turned)[:, None] + nearby, phase[:, k, None].expand(n, 3))
        slope = (effect[:, 1] - effect[:, 2]) / (nearby[2] - nearby[1])  # d effect / d turned
        effect, added = effect[:, 0], std[:, 0].square()
        swing = rotate(slope[:, :2], angle)
        trace = trace + (2 * covariance * swing).sum(dim=-1)
        trace = trace + turn_variance * swing.square().sum(dim=-1) + added[:, :2].sum(dim=-1)
        kept = 1 + slope[:, 2]
        covariance = kept[:, None] * (covariance + turn_variance[:, None] * swing)
        turn_variance = kept.square() * turn_variance + added[:, 2]
        position = position + rotate(effect[:, :2], angle)
        turned = turned + effect[:, 2]
        after.append((position, turned, trace))
    positions, turns, variances = (torch.stack(each, dim=1) for each in zip(*after, strict=True))
    return positions, turns, variances


def poses_along(
    effects: EffectMap, begins: np.ndarray, direction_rad: Tensor, phase: Tensor, n_poses: int
) -> np.ndarray:
    """Poses (n, n_poses, 3) of the object in n actions, from poses (n, 3): x, y [m], turn [rad]."""
    first = effects.kind.acts_from
    phases = first + (phase - first).clamp_min(0)[:, None] * torch.linspace(0, 1, n_poses)
    begins = torch.tensor(begins)
    effect = effects((direction_rad - begins[:, 2])[:, None].expand(phases.shape), phases)[0]
    moved = rotate(effect[..., :2], direction_rad[:, None])
    return (begins[:, None] + torch.cat([moved, effect[..., 2:]], dim=-1)).numpy()


def make_steps(
    effects: EffectMap,
    start_xy_m: Sequence[float],
    chain: Tensor,
    predicted: tuple[Tensor, Tensor] | None = None,
) -> tuple[Step, ...]:
    """Make steps of a chain (K, 2) of directions [rad] and phases, from a start (x, y) [m].

    predicted: positions (K, 2) and rotations (K,) after each action, relative to the start, if more
    accurate ones than the map's are known.
    """
    if not len(chain):
        return ()
    direction, phase = chain.T[:, None]
    positions, turns, variances = roll_out(effects, direction, phase)
    ends, turned = predicted or (positions[0], turns[0])
    ends, turned = np.asarray(start_xy_m) + ends.numpy(), turned.tolist()
    shares = torch.linspace(0, 1, PATH_SAMPLES, dtype=phase.dtype)
    relative = direction[0] - torch.tensor([0.0, *turned[:-1]], dtype=phase.dtype)
    relative, stops = torch.broadcast_tensors(relative[:, None], phase[0, :, None] * shares)
    paths = effects(relative, stops)[0][..., :2].numpy()
    steps, position = [], np.asarray(start_xy_m, dtype=float)
    for k, (angle, stop) in enumerate(chain.tolist()):
        path, position = position + rotated(paths[k], angle), ends[k]
        steps.append(
            Step(
                effects.kind.towards(angle),
                stop,
                tuple(position.tolist()),
                path,
                std_m=math.sqrt(variances[0, k]),
                predicted_turn_rad=turned[k],
            )
        )
    return tuple(steps)
