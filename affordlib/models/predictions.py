"""Predictions from image and commanded action with the ground truth, and rows of their errors."""

import json
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from affordlib.geometry import xy_columns
from affordlib.interactions import InteractionTensors
from affordlib.interactions.dataset import check_numbers, valid_interactions
from affordlib.models.calibration import effects_at
from affordlib.models.protocol import EffectModel
from affordlib.types import check_array

if TYPE_CHECKING:
    import xarray

EVERY = 12
"""Every twelfth sample is one of the paper's 25 steps of 150 ms."""

CONTACT_M = 0.001
"""Displacement [m] (or rotation [rad]) from which on an object counts as touched."""

_DECIDE_OBJECTS = ("seed", "families", "size_range_m", "height_range_m")
"""The fields of a stored recipe that decide its objects."""


def steps_of(arrays: InteractionTensors) -> torch.Tensor:
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
    mean: torch.Tensor,
    std: torch.Tensor,
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

    def last(values):
        return {name: values[:, -1, k].tolist() for k, name in enumerate(names)}

    return about_objects(data, kept) | {
        "truth": last(truth),
        "mean": last(mean),
        "std": last(std),
        "trajectory_error": error.mean(dim=1).tolist(),
        "after_contact_error": after.tolist(),
    }


def final_error(record: dict[str, Any]) -> np.ndarray:
    """Error (N,) of the predicted effect at t = 1: of (x, y) [m], or else of z or yaw alone."""
    mean, truth = record["mean"], record["truth"]
    if "x" in mean:
        return np.hypot(*(np.subtract(mean[name], truth[name]) for name in "xy"))
    name = next(iter(mean))
    return np.abs(np.subtract(mean[name], truth[name]))


def error_row(errors_m: np.ndarray, **columns: Any) -> dict[str, Any]:
    """One row of a table: the given columns, then n, mean, standard error, median, 95th percentile.

    errors_m: (n,) distances [m], one per independent object.
    """
    errors = check_array("errors_m", errors_m)
    if errors.ndim != 1:
        raise ValueError(
            f"errors_m must be finite distances of shape (n,), n ≥ 1, got shape {errors.shape}"
        )
    sem = float(errors.std(ddof=1) / np.sqrt(len(errors))) if len(errors) > 1 else 0.0
    return {
        **columns,
        "n": len(errors),
        "mean_m": float(errors.mean()),
        "sem_m": sem,
        "median_m": float(np.median(errors)),
        "p95_m": float(np.quantile(errors, 0.95)),
    }


def refuse_seen(about: dict[str, Any], data: "xarray.Dataset", interactions: np.ndarray) -> None:
    """Raise ValueError if a checkpoint was trained on these interactions, or does not say so.

    about: the second value that `load_checkpoint` returns.
    """
    try:
        recipes = [json.loads(text) for text in (about["recipe"], data.attrs["recipe"])]
        objects = [[recipe[name] for name in _DECIDE_OBJECTS] for recipe in recipes]
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
