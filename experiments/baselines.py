"""Baselines without a network, to show what the network adds, and the information they get.

    constant          the action's direction, and the mean trajectory of all training interactions
    nearest           the object's true size and yaw: the trajectory of the most similar object
    gaussian_process  the same, with a Gaussian process of exact inference (Rasmussen and Williams,
                      Gaussian processes for machine learning, 2006, algorithm 2.1)

Networks must infer size and yaw from the image; nearest and gaussian_process get the true values.
All work in the frame of the action, unlike networks in the frame of the table.
"""

import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
import xarray as xr
from sklearn.exceptions import ConvergenceWarning
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel
from sklearn.neighbors import NearestNeighbors
from torch import Tensor

from affordlib.geometry import xy_columns
from affordlib.interactions import InteractionTensors
from affordlib.interactions.dataset import valid_interactions
from affordlib.models.base import EffectModel, rotate_prediction
from affordlib.models.evaluation import EVERY, effects_at
from affordlib.types import Prediction
from affordlib.world import category_named
from experiments.last_pose import action_direction, in_action_frame

Forecast = tuple[Tensor, Tensor]  # mean and σ (N, T, C) of the effect at some samples

LEAST_STD = 1e-5


def steps_of(arrays: InteractionTensors) -> Tensor:
    """Sample numbers of the paper's 25 steps, the last of which is t = 1."""
    return torch.arange(EVERY, len(arrays.phase), EVERY)


def network_record(model: EffectModel, data: xr.Dataset, queried: np.ndarray) -> dict[str, Any]:
    """Predictions of a network for interactions: see `prediction_record`."""
    kept = valid_interactions(data, queried)
    channels = model.action_channels, model.effect_channels
    arrays = InteractionTensors.from_dataset(data, kept, *channels)
    phases = (steps_of(arrays) / (len(arrays.phase) - 1)).tolist()
    return prediction_record(data, kept, arrays, *effects_at(model, arrays, phases)[1:])


def about_objects(data: xr.Dataset, kept: np.ndarray) -> dict[str, Any]:
    """Number of each interaction, category of its object, and whether the object rolls."""
    names = np.array(data["category"].attrs["flag_meanings"].split())
    columns = {name: data[name].values[kept] for name in ("interaction", "category", "rollable")}
    columns["category"] = names[columns["category"]]
    return {name: column.tolist() for name, column in columns.items()}


def prediction_record(
    data: xr.Dataset, kept: np.ndarray, arrays: InteractionTensors, mean: Tensor, std: Tensor
) -> dict[str, Any]:
    """Ground truth, mean and σ at t = 1 by channel, and mean errors of the whole trajectory.

    kept: numbers (N,) of the interactions in `data`; mean, std: (N, 25, C), at `steps_of(arrays)`.
    """
    truth, names = arrays.effect[:, steps_of(arrays)], arrays.effect_channels
    columns = xy_columns(names) or [0]
    error = (mean - truth)[..., columns].norm(dim=-1)
    record = about_objects(data, kept) | {"trajectory_error": error.mean(dim=1).tolist()}
    for name, values in (("truth", truth), ("mean", mean), ("std", std)):
        record[name] = {c: values[:, -1, k].tolist() for k, c in enumerate(names)}
    return record


def baseline_predictions(
    baseline: Callable[..., Forecast],
    channels: tuple[tuple[str, ...], tuple[str, ...]],
    data: xr.Dataset,
    train_on: np.ndarray,
    other: xr.Dataset,
    queried: np.ndarray,
) -> dict[str, Any]:
    """Fit a baseline to interactions of `data`; predict those `queried` of `other`."""
    known, kept = valid_interactions(data, train_on), valid_interactions(other, queried)
    training = InteractionTensors.from_dataset(data, known, *channels)
    arrays = InteractionTensors.from_dataset(other, kept, *channels)
    both = features(data.isel(interaction=known)), features(other.isel(interaction=kept))
    forecast = baseline(training, arrays, steps_of(arrays), *both)
    return prediction_record(other, kept, arrays, *forecast)


def features(data: xr.Dataset) -> Tensor:
    """Features of objects, scaled to about 1: (N, 3 + 2 + categories) sizes, yaw, category.

    Yaw is relative to the action (to the table if that has no direction), as cosine and sine of
    twice the angle, since objects are symmetric under 180°; round objects have none.
    """
    size = torch.from_numpy(data["size"].values).float()
    yaw = torch.from_numpy(data["start_pose"].values[:, 2].copy())
    if "theta" in data:
        yaw = yaw - torch.from_numpy(data["theta"].values)
    names = data["category"].attrs["flag_meanings"].split()
    category = torch.from_numpy(data["category"].values).long()
    has_yaw = torch.tensor([category_named(name).has_yaw for name in names])
    angle = torch.stack([(2 * yaw).cos(), (2 * yaw).sin()], dim=-1).float()
    one_hot = torch.nn.functional.one_hot(category, len(names)).float()
    scaled = (size - 0.06) / 0.012, 1.5 * angle * has_yaw[category, None]
    return torch.cat([*scaled, 3.0 * one_hot], dim=1)  # categories are farther apart than 1


def constant(
    train: InteractionTensors, test: InteractionTensors, at: Tensor, *_: Tensor
) -> Forecast:
    """Predict the mean trajectory in the direction of the action; σ is the spread about it."""
    effect = in_action_frame(train, at)
    mean = effect.mean(dim=0)
    if action_direction(train) is not None:
        mean[:, xy_columns(train.effect_channels)[1]] = 0.0
    std = (effect - mean).square().mean(dim=0).sqrt()
    return _in_table_frame(test, at, mean.expand(len(test), -1, -1), std.clamp_min(LEAST_STD))


def nearest(
    train: InteractionTensors, test: InteractionTensors, at: Tensor, known: Tensor, queried: Tensor
) -> Forecast:
    """Predict the training trajectory of the most similar object; σ is the leave-one-out error."""
    effect, neighbours = in_action_frame(train, at), NearestNeighbors(n_neighbors=1).fit(known)
    both = (neighbours.kneighbors(x, return_distance=False) for x in (None, queried))
    left_out, found = (rows[:, 0] for rows in both)
    std = (effect[left_out] - effect).square().mean(dim=0).sqrt()
    return _in_table_frame(test, at, effect[found], std.clamp_min(LEAST_STD))


def gaussian_process(
    train: InteractionTensors, test: InteractionTensors, at: Tensor, known: Tensor, queried: Tensor
) -> Forecast:
    """Predict by one exact Gaussian process per effect channel.

    k(x, x') = s² exp(-½ Σ (x - x')² / l²) + noise; s, l and noise maximise the likelihood of the
    last sample, and are used for all samples.
    """
    effect = in_action_frame(train, at).double()
    centre, scale = effect.mean(dim=0), effect.std(dim=0).clamp_min(LEAST_STD)
    target = (effect - centre) / scale
    prior = ConstantKernel() * RBF([3.0] * known.shape[1], (1e-2, 1e9))
    prior += WhiteKernel(0.1, (1e-9, 1e3))
    mean, std = torch.empty(2, len(queried), *target.shape[1:], dtype=torch.double)
    for c in range(target.shape[-1]):
        with warnings.catch_warnings():  # the length scale of an irrelevant feature hits its bound
            warnings.simplefilter("ignore", ConvergenceWarning)
            kernel = GaussianProcessRegressor(prior).fit(known, target[:, -1, c]).kernel_
        process = GaussianProcessRegressor(kernel, optimizer=None).fit(known, target[..., c])
        both = process.predict(queried, return_std=True)  # without its axis T where T is 1
        mean[..., c], std[..., c] = (torch.from_numpy(v).reshape(mean.shape[:2]) for v in both)
    return _in_table_frame(test, at, (centre + scale * mean).float(), (scale * std).float())


def _in_table_frame(arrays: InteractionTensors, at: Tensor, mean: Tensor, std: Tensor) -> Forecast:
    """Rotate predictions from the frame of the action to the table's."""
    std, action, direction = std.expand_as(mean), arrays.action[:, at], action_direction(arrays)
    if direction is None:
        return mean, std
    turned = Prediction(action, torch.zeros_like(action), mean, std)
    turned = rotate_prediction(turned, direction, arrays.action_channels, arrays.effect_channels)
    return turned.effect_mean, turned.effect_std


BASELINES = {each.__name__: each for each in (constant, nearest, gaussian_process)}
