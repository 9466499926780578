"""Chains of actions on an effect map: where they lead, how sure that is, and as steps of a plan."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
import torch

from affordlib.planning.modes import PATH_SAMPLES
from affordlib.types import Step

if TYPE_CHECKING:
    from collections.abc import Sequence

    from torch import Tensor

    from affordlib.planning.effect_map import EffectMap


def roll_out(
    effects: EffectMap, direction_rad: Tensor, phase: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Positions (B, K, 2) [m] and turns (B, K) [rad] after each action, and the variance (B,) [m²].

    direction_rad, phase: (B, K), of chains that start at the origin. The variance is the trace of
    the covariance of the last position: what each action adds, and what an unsure turn makes of
    the actions that follow.
    """
    n, k_max = direction_rad.shape
    position, turned = direction_rad.new_zeros(n, 2), direction_rad.new_zeros(n)
    covariance = direction_rad.new_zeros(n, 3, 3)
    positions, turns = [], []
    nearby = torch.tensor([0.0, -0.02, 0.02], dtype=direction_rad.dtype)
    for k in range(k_max):
        angle = direction_rad[:, k]
        told, std = effects((angle - turned)[:, None] + nearby, phase[:, k, None].expand(n, 3))
        slope = (told[:, 2] - told[:, 1]) / (nearby[2] - nearby[1])
        c, s = angle.cos(), angle.sin()
        turn = torch.stack([torch.stack([c, -s], -1), torch.stack([s, c], -1)], -2)
        effect, std = told[:, 0], std[:, 0]
        position = position + (turn @ effect[:, :2, None])[..., 0]
        turned = turned + effect[:, 2]
        carry = torch.eye(3, dtype=angle.dtype).repeat(n, 1, 1)
        carry[:, :2, 2] = -(turn @ slope[:, :2, None])[..., 0]
        carry[:, 2, 2] = 1 - slope[:, 2]
        covariance = carry @ covariance @ carry.transpose(1, 2)
        added = torch.zeros_like(covariance)
        added[:, :2, :2] = turn @ torch.diag_embed(std[:, :2] ** 2) @ turn.transpose(1, 2)
        added[:, 2, 2] = std[:, 2] ** 2
        covariance = covariance + added
        positions.append(position)
        turns.append(turned)
    variance = covariance[:, 0, 0] + covariance[:, 1, 1]
    return torch.stack(positions, dim=1), torch.stack(turns, dim=1), variance


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
    positions, turns, _ = roll_out(effects, direction, phase)
    ends, turned = foreseen or (positions[0], turns[0])
    ends, turned = np.asarray(start_xy_m) + ends.numpy(), turned.tolist()
    shares = torch.linspace(0, 1, PATH_SAMPLES, dtype=phase.dtype)
    steps, place, before = [], np.asarray(start_xy_m, dtype=float), 0.0
    for k, (angle, stop) in enumerate(chain.tolist()):
        way = effects(torch.full_like(shares, angle - before), stop * shares)[0][:, :2].numpy()
        c, s = math.cos(angle), math.sin(angle)
        path = place + way @ np.array([[c, s], [-s, c]])
        variance = roll_out(effects, direction[:, : k + 1], phase[:, : k + 1])[2]
        place, before = ends[k], turned[k]
        steps.append(
            Step(
                effects.kind.towards(angle),
                stop,
                (float(place[0]), float(place[1])),
                path,
                std_m=float(variance.sqrt()),
                predicted_turn_rad=before,
            )
        )
    return tuple(steps)
