"""Predictions beside the ground truth: their errors, and the calibration of σ.

With a calibrated Gaussian half of the ground truth lies in the central 50 % interval μ ± 0.674 σ.
Variance scaling multiplies σ of an effect channel by s; the maximum-likelihood value is s² = mean
((e - μ) / σ)² (a temperature: Guo et al., On calibration of modern neural networks, ICML 2017).

σ covers the noise in the training data, not the novelty of an object (notebook 08).
"""

import json
import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from affordlib.geometry import xy_columns
from affordlib.interactions.dataset import (
    InteractionTensors,
    check_fits,
    check_numbers,
    valid_interactions,
)
from affordlib.interactions.sampling import condition_on_recorded_action
from affordlib.models.base import EffectModel
from affordlib.types import check_array, check_within

if TYPE_CHECKING:
    import xarray

AFTER_CONTACT = (0.8, 0.9, 1.0)
"""Phases at which every push has moved its object; before contact the effect is always zero."""

EVERY = 12
"""Every twelfth sample is one of the paper's 25 steps of 150 ms."""

CONTACT_M = 0.001
"""Displacement [m] (or rotation [rad]) from which on an object counts as touched."""


@torch.no_grad()
def effects_at(
    model: EffectModel, tensors: InteractionTensors, phases: Sequence[float]
) -> tuple[Tensor, Tensor, Tensor]:
    """Ground truth, mean and σ of the effects, (N, T, C) each, given image and action."""
    phases = [check_within("phases", phase, 0.0, 1.0) for phase in phases]
    if not phases:
        raise ValueError("phases must hold at least one phase in [0, 1], got none")
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


@runtime_checkable
class HasSigmaScale(EffectModel, Protocol):
    """A model whose σ of the effect channels is multiplied by sigma_scale (C_e,)."""

    sigma_scale: Tensor


def fit_sigma_scale(
    model: HasSigmaScale,
    validation: InteractionTensors,
    phases: Sequence[float] = AFTER_CONTACT,
) -> tuple[float, ...]:
    """Set and return the maximum-likelihood sigma_scale (C_e,); x and y share one factor."""
    model.sigma_scale.fill_(1.0)
    truth, mean, std = effects_at(model, validation, phases)
    squared = ((truth - mean) / std).square().mean(dim=(0, 1))
    plane = xy_columns(model.effect_channels)
    squared[plane] = squared[plane].mean()
    model.sigma_scale.copy_(squared.clamp_min(1e-6).sqrt())
    return tuple(model.sigma_scale.tolist())


def steps_of(arrays: InteractionTensors) -> Tensor:
    """Sample numbers of the 25 steps, the last of which is t = 1."""
    return torch.arange(EVERY, len(arrays.phase), EVERY)


def network_predictions(
    model: EffectModel, data: "xarray.Dataset", interactions: np.ndarray
) -> dict[str, Any]:
    """Predictions of a network for interactions: see `prediction_record`."""
    kept = valid_interactions(data, interactions)
    arrays = InteractionTensors.from_dataset(
        data, kept, model.action_channels, model.effect_channels
    )
    phases = (steps_of(arrays) / (len(arrays.phase) - 1)).tolist()
    return prediction_record(data, kept, arrays, *effects_at(model, arrays, phases)[1:])


def about_objects(data: "xarray.Dataset", kept: np.ndarray) -> dict[str, Any]:
    """Number of each interaction, category of its object, and whether the object rolls."""
    names = data["category"].attrs["flag_meanings"].split()
    return {
        "interaction": data["interaction"].values[kept].tolist(),
        "category": [names[k] for k in data["category"].values[kept]],
        "rollable": data["rollable"].values[kept].tolist(),
    }


def prediction_record(
    data: "xarray.Dataset",
    kept: np.ndarray,
    arrays: InteractionTensors,
    mean: Tensor,
    std: Tensor,
) -> dict[str, Any]:
    """Ground truth, mean and σ at t = 1 by channel, and mean errors of the whole trajectory.

    kept: the numbers (N,) in `data` of the interactions of `arrays`; mean, std: (N, 25, C), at
    `steps_of(arrays)`.
    """
    truth, names = arrays.effect[:, steps_of(arrays)], arrays.effect_channels
    columns = xy_columns(names) or [0]
    error = (mean - truth)[..., columns].norm(dim=-1)
    touched = truth[..., columns].norm(dim=-1) > CONTACT_M
    after = (error * touched).sum(dim=1) / touched.sum(dim=1).clamp_min(1)
    record = about_objects(data, kept)
    for name, values in (("truth", truth), ("mean", mean), ("std", std)):
        record[name] = {c: values[:, -1, k].tolist() for k, c in enumerate(names)}
    return record | {
        "trajectory_error": error.mean(dim=1).tolist(),
        "after_contact_error": after.tolist(),
    }


def final_error(record: dict[str, Any]) -> np.ndarray:
    """Error (N,) of the predicted effect at t = 1: of (x, y) [m], or else of z or yaw alone."""
    mean, truth = record["mean"], record["truth"]
    names = "xy" if "x" in mean else list(mean)[:1]
    return np.linalg.norm([np.subtract(mean[name], truth[name]) for name in names], axis=0)


def error_row(errors_m: np.ndarray, **columns: Any) -> dict[str, Any]:
    """One row of a table: the given columns, then n, mean, standard error, median, 95th percentile.

    errors_m: (n,) distances [m], one per independent object.
    """
    errors = check_array("errors_m", errors_m, np.size(errors_m))
    return {
        **columns,
        "n": len(errors),
        "mean_m": float(errors.mean()),
        "sem_m": float(errors.std(ddof=min(1, len(errors) - 1)) / math.sqrt(len(errors))),
        "median_m": float(np.median(errors)),
        "p95_m": float(np.quantile(errors, 0.95)),
    }


def refuse_seen(about: dict[str, Any], data: "xarray.Dataset", interactions: np.ndarray) -> None:
    """Raise ValueError if a checkpoint was trained on these interactions, or does not say so.

    about: the second value that `load_checkpoint` returns.
    """
    decisive = ("seed", "families", "size_range_m", "height_range_m")  # for the objects of a recipe
    try:
        recipes = [json.loads(text) for text in (about["recipe"], data.attrs["recipe"])]
        objects = [[recipe[name] for name in decisive] for recipe in recipes]
        trained_on = {int(number) for number in about["seen_interactions"]}
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(
            f"about does not say which interactions the model was trained on ({error!r}); "
            "save the checkpoint with the recipe and seen_interactions of its training"
        ) from error
    check_numbers("interactions", interactions)
    numbers = data["interaction"].values[interactions]
    seen = sorted(trained_on & {int(i) for i in numbers})
    if objects[0] == objects[1] and seen:
        raise ValueError(
            f"interactions: the model was trained or tuned on {len(seen)} of them (such as "
            f"{seen[:5]}); evaluate it on the test part of its split or on another data set"
        )
