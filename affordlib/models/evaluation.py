"""Predictions beside the ground truth: their errors, and the calibration of σ.

With a calibrated Gaussian half of the ground truth lies in the central 50 % interval μ ± 0.674 σ.
Variance scaling multiplies σ of an effect channel by s; the maximum-likelihood value is s² = mean
((e - μ) / σ)² (a temperature: Guo et al., On calibration of modern neural networks, ICML 2017).

σ covers the noise in the training data, not the novelty of an object (notebook 08).
"""

import json
import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from affordlib.geometry import xy_columns
from affordlib.interactions import InteractionTensors, condition_on_recorded_action
from affordlib.interactions.dataset import check_fits, check_numbers, valid_interactions
from affordlib.models.base import EffectModel, EffectNetwork

if TYPE_CHECKING:
    import xarray

AFTER_CONTACT = (0.8, 0.9, 1.0)
"""Phases at which every push has moved its object; before contact the effect is always zero."""

EVERY = 12  # samples: one of the paper's 25 steps of 150 ms


@torch.no_grad()
def effects_at(
    model: EffectModel, tensors: InteractionTensors, phases: Sequence[float]
) -> tuple[Tensor, Tensor, Tensor]:
    """Ground truth, mean and σ of the effects, (N, T, C) each, given image and action."""
    check_fits("tensors", tensors, model)
    at = (torch.tensor(phases) * (len(tensors.phase) - 1)).round().long()
    predicted = model.predict(
        model.encode(tensors.image), condition_on_recorded_action(tensors), tensors.phases(at)
    )
    return tensors.effect[:, at], predicted.effect_mean, predicted.effect_std


def final_errors_m(model: EffectModel, tensors: InteractionTensors) -> Float[Tensor, " n"]:
    """Distance [m] of predicted and true (x, y) at t = 1; without x, y, of all channels."""
    truth, mean, _ = effects_at(model, tensors, (1.0,))
    columns = xy_columns(tensors.effect_channels) or list(range(len(tensors.effect_channels)))
    return (mean - truth)[:, 0, columns].norm(dim=-1)


def coverage(
    truth: Float[Tensor, "*s"], mean: Float[Tensor, "*s"], std: Float[Tensor, "*s"], level: float
) -> float:
    """Share of the values inside the central interval of the given level, such as 0.9."""
    if not 0 < level < 1:
        raise ValueError(f"level must lie in (0, 1), got {level!r}")
    if not truth.shape == mean.shape == std.shape:
        shapes = tuple(truth.shape), tuple(mean.shape), tuple(std.shape)
        raise ValueError(f"truth, mean and std must have one shape, got {shapes}")
    half = math.sqrt(2) * float(torch.erfinv(torch.tensor(level, dtype=torch.float64)))
    return float(((truth - mean).abs() <= half * std).double().mean())


def fit_sigma_scale(model: EffectNetwork, validation: InteractionTensors) -> tuple[float, ...]:
    """Set and return the maximum-likelihood sigma_scale (C_e,); x and y share one factor."""
    model.sigma_scale.fill_(1.0)
    truth, mean, std = effects_at(model, validation, AFTER_CONTACT)
    squared = ((truth - mean) / std).square().mean(dim=(0, 1))
    plane = xy_columns(model.effect_channels)
    squared[plane] = squared[plane].mean()
    model.sigma_scale.copy_(squared.clamp_min(1e-6).sqrt())
    return tuple(model.sigma_scale.tolist())


def network_predictions(
    model: EffectModel, data: "xarray.Dataset", interactions: np.ndarray
) -> dict[str, Any]:
    """Ground truth, mean and σ at t = 1 by channel, and category, of the valid interactions."""
    kept = valid_interactions(data, interactions)
    channels = model.action_channels, model.effect_channels
    tensors = InteractionTensors.from_dataset(data, kept, *channels)
    names = data["category"].attrs["flag_meanings"].split()
    record = {"category": [names[k] for k in data["category"].values[kept]]}
    parts = "truth", "mean", "std"
    for part, values in zip(parts, effects_at(model, tensors, (1.0,)), strict=True):
        record[part] = {c: values[:, 0, k].tolist() for k, c in enumerate(channels[1])}
    return record


def final_error(record: dict[str, Any]) -> np.ndarray:
    """Error (N,) of the predicted effect at t = 1: of (x, y) [m], or else of z or yaw alone."""
    mean, truth = record["mean"], record["truth"]
    names = "xy" if {"x", "y"} <= {*mean} else list(mean)[:1]
    return np.linalg.norm([np.subtract(mean[name], truth[name]) for name in names], axis=0)


def refuse_seen(about: dict[str, Any], data: "xarray.Dataset", interactions: np.ndarray) -> None:
    """Raise ValueError if a checkpoint was trained on these interactions.

    about: the second value that `load_checkpoint` returns, from `about_training`.
    """
    check_numbers("interactions", interactions)
    if not {"seen_interactions", "recipe"} <= about.keys():
        raise ValueError(f"about must be what about_training returns, got {about!r:.200}")
    seen = {*about["seen_interactions"]} & {*data["interaction"].values[interactions].tolist()}
    recipes = json.loads(about["recipe"]), json.loads(data.attrs["recipe"])
    decisive = ("seed", "families", "size_range_m", "height_range_m")  # for a recipe's objects
    if seen and all(recipes[0].get(name) == recipes[1].get(name) for name in decisive):
        raise ValueError(
            f"interactions: the model was trained or tuned on {len(seen)} of them (such as "
            f"{sorted(seen)[:5]}); evaluate it on the test part of its split or on another data set"
        )
