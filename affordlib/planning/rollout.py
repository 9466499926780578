"""Chains of actions on an effect map: where they lead, how sure that is, and as steps of a plan."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from affordlib.planning.effect_map import EffectMap
from affordlib.types import Step

PATH_SAMPLES = 25
"""Points of the predicted path that a step carries, as in Section 4.3."""


def roll_out(
    effects: EffectMap, direction_rad: Tensor, phase: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Positions (B, K, 2) [m], turns (B, K) [rad] and variances (B, K) [m²] after each action.

    direction_rad, phase: (B, K), of chains that start at the origin. The variance is the trace of
    the covariance of the position: what each action adds, and what an unsure turn makes of the
    actions that follow.
    """
    n, k_max = direction_rad.shape
    position, turned = direction_rad.new_zeros(n, 2), direction_rad.new_zeros(n)
    # Of the covariance: the trace of the position's part, the turn's variance, and what ties them.
    spread, turn_variance = torch.zeros_like(turned), torch.zeros_like(turned)
    tie = torch.zeros_like(position)
    told = []
    nearby = torch.tensor([0.0, -0.02, 0.02], dtype=direction_rad.dtype)
    for k in range(k_max):
        angle = direction_rad[:, k]
        effect, std = effects((angle - turned)[:, None] + nearby, phase[:, k, None].expand(n, 3))
        slope = (effect[:, 1] - effect[:, 2]) / (nearby[2] - nearby[1])  # by the turn before it
        effect, added = effect[:, 0], std[:, 0].square()
        swing = _turned(slope[:, :2], angle)
        spread = (
            spread
            + (2 * tie * swing).sum(dim=-1)
            + turn_variance * swing.square().sum(dim=-1)
            + added[:, :2].sum(dim=-1)
        )
        kept = 1 + slope[:, 2]
        tie = kept[:, None] * (tie + turn_variance[:, None] * swing)
        turn_variance = kept.square() * turn_variance + added[:, 2]
        position = position + _turned(effect[:, :2], angle)
        turned = turned + effect[:, 2]
        told.append((position, turned, spread))
    positions, turns, variances = (torch.stack(each, dim=1) for each in zip(*told, strict=True))
    return positions, turns, variances


def _turned(vector: Tensor, angle_rad: Tensor) -> Tensor:
    """Vectors (B, 2), turned by angles (B,)."""
    c, s = angle_rad.cos(), angle_rad.sin()
    x, y = vector.unbind(-1)
    return torch.stack([c * x - s * y, s * x + c * y], dim=-1)


@torch.no_grad()
def make_steps(
    effects: EffectMap,
    start_xy_m: Sequence[float],
    chain: Tensor,
    foreseen: tuple[Tensor, Tensor] | None = None,
) -> tuple[Step, ...]:
    """The steps of a chain (K, 2) of directions [rad] and phases, from a start (x, y) [m].

    foreseen: positions (K, 2) and turns (K,) after each action, relative to the start, where they
    are known better than the map tells them.
    """
    if not len(chain):
        return ()
    direction, phase = chain.T[:, None]
    positions, turns, variances = roll_out(effects, direction, phase)
    ends, turned = foreseen or (positions[0], turns[0])
    ends, turned = np.asarray(start_xy_m) + ends.numpy(), turned.tolist()
    shares = torch.linspace(0, 1, PATH_SAMPLES, dtype=phase.dtype)
    relative = direction[0] - torch.tensor([0.0, *turned[:-1]], dtype=phase.dtype)
    relative, stops = torch.broadcast_tensors(relative[:, None], phase[0, :, None] * shares)
    ways = effects(relative, stops)[0][..., :2].numpy()
    steps, place = [], np.asarray(start_xy_m, dtype=float)
    for k, (angle, stop) in enumerate(chain.tolist()):
        c, s = math.cos(angle), math.sin(angle)
        path = place + ways[k] @ np.array([[c, s], [-s, c]])
        place = ends[k]
        steps.append(
            Step(
                effects.kind.towards(angle),
                stop,
                (float(place[0]), float(place[1])),
                path,
                std_m=math.sqrt(variances[0, k]),
                predicted_turn_rad=turned[k],
            )
        )
    return tuple(steps)
