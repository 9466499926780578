"""The frame of the push: everything turned so that the direction of the push is always 0.

The table does not mind in which direction it is pushed over, so a model that sees every push from
behind need not learn what turning does. Image, action and effect are turned into the frame,
predictions are turned back. A frame is given by its heading (cos θ, sin θ), one per query.
"""

from __future__ import annotations

from dataclasses import replace

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from affordlib.geometry import rotate_channels, xy_columns
from affordlib.types import Observations, Prediction

FRAMES = ("table", "push")
_SHORTEST_M = 1e-3

Channels = tuple[str, ...]


def heading(
    observations: Observations, action_channels: Channels, effect_channels: Channels
) -> Float[Tensor, "b 2"]:
    """Directions (B, 2), as unit vectors, that the observations tell; differentiable.

    Of the action: its travel from the first to the last observation, or else the way from its first
    observation through the object's centre. Where no action is observed (the inverse question) it
    is the direction of the last observed effect. Vectors below 1 mm tell nothing; where none does,
    the frame is the table's.
    """
    o = observations
    action, effect = (
        o.action[..., xy_columns(action_channels)],
        o.effect[..., xy_columns(effect_channels)],
    )
    acts = o.action_mask & (o.weight > 0)[:, None]
    shifts = o.effect_mask & (o.weight < 1)[:, None]
    first, last = _at_end(action, o.action_t, acts, -1), _at_end(action, o.action_t, acts, 1)
    direction = torch.zeros_like(first)
    direction[:, 0] = 1
    for vector in (_at_end(effect, o.effect_t, shifts, 1), -first, last - first):
        tells = vector.detach().norm(dim=-1, keepdim=True) > _SHORTEST_M
        direction = torch.where(tells, vector, direction)
    return direction / direction.norm(dim=-1, keepdim=True)


def _at_end(
    values: Float[Tensor, "b n 2"], t: Float[Tensor, "b n"], seen: Bool[Tensor, "b n"], sign: int
) -> Float[Tensor, "b 2"]:
    """The value seen last (sign 1) or first (sign -1); zero where none is."""
    at = (sign * t).masked_fill(~seen, -torch.inf).argmax(dim=1)
    value = values[torch.arange(len(values), device=values.device), at]
    return torch.where(seen.any(dim=1, keepdim=True), value, 0.0)


def inverse(heading: Tensor) -> Tensor:
    """The heading (B, 2) that turns back."""
    return torch.stack([heading[..., 0], -heading[..., 1]], dim=-1)


def turn_image(image: Float[Tensor, "#b 2 n n"], heading: Tensor) -> Float[Tensor, "b 2 n n"]:
    """Images (B or 1, 2, n, n) turned by the headings (B, 2), bilinearly; beyond the edge, table.

    The covered area changes by less than 1 % as long as the object keeps within the inscribed
    circle; quarter turns are exact.
    """
    cos, sin = heading.unbind(-1)
    # From the turned image's coordinates to where to look it up; rows run along -y.
    rows = [torch.stack([cos, -sin], -1), torch.stack([sin, cos], -1)]
    matrix = F.pad(torch.stack(rows, dim=1), (0, 1))
    image = image.expand(len(heading), -1, -1, -1)
    grid = F.affine_grid(matrix, list(image.shape), align_corners=False)
    return F.grid_sample(image, grid, padding_mode="border", align_corners=False)


def turn_observations(
    observations: Observations,
    heading: Tensor,
    action_channels: Channels,
    effect_channels: Channels,
) -> Observations:
    """Observations turned by the headings (B, 2)."""
    h = heading[:, None]
    return replace(
        observations,
        action=rotate_channels(observations.action, action_channels, h, absolute_yaw=True),
        effect=rotate_channels(observations.effect, effect_channels, h, absolute_yaw=False),
    )


def turn_prediction(
    prediction: Prediction, heading: Tensor, action_channels: Channels, effect_channels: Channels
) -> Prediction:
    """A prediction turned by the headings (B, 2).

    σ of x and y become those of the turned Gaussian's marginals; that x and y are then correlated
    is not told.
    """
    p, h = prediction, heading[:, None]
    return Prediction(
        rotate_channels(p.action_mean, action_channels, h, absolute_yaw=True),
        _turn_std(p.action_std, action_channels, h),
        rotate_channels(p.effect_mean, effect_channels, h, absolute_yaw=False),
        _turn_std(p.effect_std, effect_channels, h),
    )


def _turn_std(std: Tensor, channels: Channels, heading: Tensor) -> Tensor:
    cos2, sin2 = heading.square().unbind(-1)
    columns = list(std.unbind(-1))
    i, j = xy_columns(channels)
    u, v = columns[i].square(), columns[j].square()
    columns[i], columns[j] = (cos2 * u + sin2 * v).sqrt(), (sin2 * u + cos2 * v).sqrt()
    return torch.stack(columns, dim=-1)
