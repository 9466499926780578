"""The push-aligned frame: everything is rotated so that the push direction is always angle 0.

Pushing works the same in all directions on the table, so a model in this frame need not learn
rotations. Image, action and effect are rotated into the frame, predictions are rotated back. A
rotation is given by (cos α, sin α), one per query.
"""

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


def push_direction(
    observations: Observations, action_channels: Channels, effect_channels: Channels
) -> Float[Tensor, "b 2"]:
    """Directions (B, 2), as unit vectors, of the observed pushes; differentiable.

    An action's direction is from its first to its last observation, or else from its first
    observation through the object's centre. Without an observed action (the inverse query) it is
    the direction of the last observed effect. Vectors below 1 mm have no direction; if all are
    shorter, the frame is the table's.
    """
    o = observations
    action = o.action[..., xy_columns(action_channels)]
    effect = o.effect[..., xy_columns(effect_channels)]
    acts = o.action_mask & (o.weight > 0)[:, None]
    moves = o.effect_mask & (o.weight < 1)[:, None]
    first, last = _extreme(action, -o.action_t, acts), _extreme(action, o.action_t, acts)
    direction = torch.zeros_like(first)
    direction[:, 0] = 1
    for vector in (_extreme(effect, o.effect_t, moves), -first, last - first):
        long = vector.detach().norm(dim=-1, keepdim=True) > _SHORTEST_M
        direction = torch.where(long, vector, direction)
    return direction / direction.norm(dim=-1, keepdim=True)


def _extreme(
    values: Float[Tensor, "b n 2"], order: Float[Tensor, "b n"], seen: Bool[Tensor, "b n"]
) -> Float[Tensor, "b 2"]:
    """The observed value of greatest order; zero where nothing is observed."""
    at = order.masked_fill(~seen, -torch.inf).argmax(dim=1)
    value = values[torch.arange(len(values), device=values.device), at]
    return torch.where(seen.any(dim=1, keepdim=True), value, 0.0)


def inverse(rotation: Tensor) -> Tensor:
    """Inverse rotations (B, 2)."""
    return torch.stack([rotation[..., 0], -rotation[..., 1]], dim=-1)


def rotate_image(image: Float[Tensor, "#b 2 n n"], rotation: Tensor) -> Float[Tensor, "b 2 n n"]:
    """Rotate images (B or 1, 2, n, n) by (B, 2), bilinearly; border pixels are repeated outside."""
    cos, sin = rotation.unbind(-1)
    # This maps coordinates of the rotated image to those of the image; rows run along -y.
    rows = [torch.stack([cos, -sin], -1), torch.stack([sin, cos], -1)]
    matrix = F.pad(torch.stack(rows, dim=1), (0, 1))
    image = image.expand(len(rotation), -1, -1, -1)
    grid = F.affine_grid(matrix, list(image.shape), align_corners=False)
    return F.grid_sample(image, grid, padding_mode="border", align_corners=False)


def rotate_observations(
    observations: Observations,
    rotation: Tensor,
    action_channels: Channels,
    effect_channels: Channels,
) -> Observations:
    """Rotate observations by (B, 2)."""
    r = rotation[:, None]
    return replace(
        observations,
        action=rotate_channels(observations.action, action_channels, r, absolute_yaw=True),
        effect=rotate_channels(observations.effect, effect_channels, r, absolute_yaw=False),
    )


def rotate_prediction(
    prediction: Prediction, rotation: Tensor, action_channels: Channels, effect_channels: Channels
) -> Prediction:
    """Rotate a prediction by (B, 2); the correlation of x and y that this introduces is dropped."""
    p, r = prediction, rotation[:, None]
    return Prediction(
        rotate_channels(p.action_mean, action_channels, r, absolute_yaw=True),
        _rotate_std(p.action_std, action_channels, r),
        rotate_channels(p.effect_mean, effect_channels, r, absolute_yaw=False),
        _rotate_std(p.effect_std, effect_channels, r),
    )


def _rotate_std(std: Tensor, channels: Channels, rotation: Tensor) -> Tensor:
    cos2, sin2 = rotation.square().unbind(-1)
    columns = list(std.unbind(-1))
    i, j = xy_columns(channels)
    u, v = columns[i].square(), columns[j].square()
    columns[i], columns[j] = (cos2 * u + sin2 * v).sqrt(), (sin2 * u + cos2 * v).sqrt()
    return torch.stack(columns, dim=-1)
