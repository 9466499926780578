"""Predictors without a network, to see what the network adds; each says what it knows.

    constant          the action's direction, and the mean course of all training interactions
    nearest           size and yaw of the object as they truly are: the course of the most alike one
    gaussian_process  the same, with a Gaussian process of exact inference (Rasmussen and Williams,
                      Gaussian processes for machine learning, 2006, algorithm 2.1)
    logistic          of a grasp: its success from the three true sizes alone

Networks must read size and yaw from the image; nearest and gaussian_process are told. All see the
effect in the frame of the action, which networks in the frame of the table do not.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import torch
import xarray as xr
from torch import Tensor

from affordlib.interactions.batches import TrainingArrays, observe_action, plane_of, turn
from affordlib.models.frame import heading, inverse, turn_prediction
from affordlib.types import Prediction

Forecast = tuple[Tensor, Tensor]
"""Mean and σ (N, T, C) of the effect at some samples."""

_FAMILY_GAP = 3.0


def features(data: xr.Dataset) -> Tensor:
    """What is known of objects, near unit size: (N, 3 + 2 + families) sizes, yaw, family.

    Yaw is that of the object against the action (against the table where the action has no
    direction), as cosine and sine of twice the angle, since half a turn changes nothing; round
    objects have none.
    """
    size = torch.from_numpy(data["size"].values).float()
    yaw = torch.from_numpy(data["start_pose"].values[:, 2].copy())
    if "theta" in data:
        yaw = yaw - torch.from_numpy(data["theta"].values)
    names = data["family"].attrs["flag_meanings"].split()
    family = torch.from_numpy(data["family"].values).long()
    turns = torch.tensor([name in ("cuboid", "prism", "lying_cylinder") for name in names])
    angle = torch.stack([(2 * yaw).cos(), (2 * yaw).sin()], dim=-1).float()
    kind = torch.nn.functional.one_hot(family, len(names)).float()
    return torch.cat(
        [(size - 0.06) / 0.012, 1.5 * angle * turns[family, None], _FAMILY_GAP * kind], dim=1
    )


def _has_direction(arrays: TrainingArrays) -> bool:
    return bool(plane_of(arrays.action_channels) and plane_of(arrays.effect_channels))


def _along(arrays: TrainingArrays, at: Tensor) -> Tensor:
    """True effects (N, T, C) in the frame of the action."""
    effect, channels = arrays.effect[:, at], (arrays.action_channels, arrays.effect_channels)
    if not _has_direction(arrays):
        return effect
    back = inverse(heading(observe_action(arrays), *channels))[:, None]
    return turn(effect, arrays.effect_channels, back, absolute_yaw=False)


def _in_table(arrays: TrainingArrays, at: Tensor, mean: Tensor, std: Tensor) -> Forecast:
    """What was foreseen in the frame of the action, in the table's."""
    std = std.expand_as(mean)
    if not _has_direction(arrays):
        return mean, std
    channels = arrays.action_channels, arrays.effect_channels
    action = arrays.action[:, at]
    told = Prediction(action, torch.zeros_like(action), mean, std)
    told = turn_prediction(told, heading(observe_action(arrays), *channels), *channels)
    return told.effect_mean, told.effect_std


def constant(train: TrainingArrays, test: TrainingArrays, at: Tensor, *_: Tensor) -> Forecast:
    """The mean course in the direction of the action; σ is the spread about it."""
    course = _along(train, at)
    mean = course.mean(dim=0)
    if _has_direction(train):
        mean[:, plane_of(train.effect_channels)[1]] = 0.0
    std = (course - mean).square().mean(dim=0).sqrt()
    return _in_table(test, at, mean.expand(len(test), -1, -1), _floor(std))


def nearest(
    train: TrainingArrays, test: TrainingArrays, at: Tensor, known: Tensor, asked: Tensor
) -> Forecast:
    """The course of the training interaction whose object is most alike; σ from leaving one out."""
    course = _along(train, at)
    among = torch.cdist(known, known).fill_diagonal_(math.inf)
    std = (course[among.argmin(dim=1)] - course).square().mean(dim=0).sqrt()
    mean = course[torch.cdist(asked, known).argmin(dim=1)]
    return _in_table(test, at, mean, _floor(std))


def gaussian_process(
    train: TrainingArrays, test: TrainingArrays, at: Tensor, known: Tensor, asked: Tensor
) -> Forecast:
    """One exact Gaussian process per effect channel, its likeliest kernel chosen at the end."""
    course = _along(train, at).double()
    known, asked = known.double(), asked.double()
    mean, std = [], []
    for c in range(course.shape[-1]):
        y = course[..., c]
        centre, scale = y.mean(dim=0), _floor(y.std(dim=0))
        mu, sigma = _regress(known, (y - centre) / scale, asked)
        mean.append(centre + scale * mu)
        std.append(scale * sigma)
    return _in_table(test, at, torch.stack(mean, dim=-1).float(), torch.stack(std, dim=-1).float())


def _regress(x: Tensor, y: Tensor, asked: Tensor, steps: int = 150) -> tuple[Tensor, Tensor]:
    """Mean and σ (M, T) at `asked` (M, D) of courses y (N, T) at x (N, D), each standardised.

    k(x, x') = s² exp(-½ Σ (x - x')² / l²) + noise; s, l and noise maximise the likelihood of the
    last sample, and serve all.
    """
    length = torch.full((x.shape[1],), math.log(3.0), dtype=x.dtype, requires_grad=True)
    size = torch.tensor([0.0, math.log(0.3)], dtype=x.dtype, requires_grad=True)

    def kernel(a: Tensor, b: Tensor) -> Tensor:
        far = ((a / length.exp())[:, None] - (b / length.exp())[None]).square().sum(dim=-1)
        return (2 * size[0]).exp() * (-far / 2).exp()

    def factor() -> Tensor:
        noise = (2 * size[1]).exp() + 1e-6
        return torch.linalg.cholesky(kernel(x, x) + noise * torch.eye(len(x), dtype=x.dtype))

    optimiser = torch.optim.Adam([length, size], lr=0.05)
    target = y[:, -1:]
    for _ in range(steps):
        low = factor()
        fit = (target * torch.cholesky_solve(target, low)).sum() / 2 + low.diagonal().log().sum()
        optimiser.zero_grad()
        fit.backward()
        optimiser.step()
    with torch.no_grad():
        low, across = factor(), kernel(asked, x)
        mean = across @ torch.cholesky_solve(y, low)
        half = torch.linalg.solve_triangular(low, across.T, upper=False)
        variance = (2 * size[0]).exp() + (2 * size[1]).exp() - half.square().sum(dim=0)
        return mean, variance.clamp_min(1e-12).sqrt()[:, None].expand_as(mean)


def _floor(std: Tensor) -> Tensor:
    return std.clamp_min(1e-5)


def logistic(size: np.ndarray, success: np.ndarray, asked: np.ndarray) -> np.ndarray:
    """P(success) (M,) by logistic regression on sizes (N, 3), with a weak ridge."""
    centre, scale = size.mean(axis=0), size.std(axis=0)
    x = torch.from_numpy((size - centre) / scale).double()
    y = torch.from_numpy(success.astype(float))
    weight = torch.zeros(x.shape[1] + 1, dtype=torch.double, requires_grad=True)
    optimiser = torch.optim.LBFGS([weight], max_iter=200)

    def loss() -> Tensor:
        optimiser.zero_grad()
        z = x @ weight[1:] + weight[0]
        value = torch.nn.functional.binary_cross_entropy_with_logits(z, y, reduction="sum")
        value = value + weight[1:].square().sum() / 2
        value.backward()
        return value

    optimiser.step(loss)
    z = torch.from_numpy((asked - centre) / scale).double() @ weight[1:] + weight[0]
    return torch.sigmoid(z).detach().numpy()


BASELINES: dict[str, Callable[..., Forecast]] = {
    "constant": constant,
    "nearest": nearest,
    "gaussian_process": gaussian_process,
}
