"""Predictions from image and commanded action with the ground truth, as plain lists."""

from typing import Any

import numpy as np
import torch

from affordlib.geometry import xy_columns
from affordlib.interactions import InteractionTensors
from affordlib.interactions.dataset import valid_interactions
from affordlib.models.calibration import effects_at
from affordlib.models.protocol import EffectModel

EVERY = 12
"""Every twelfth sample is one of the paper's 25 steps of 150 ms."""

CONTACT_M = 0.001
"""Displacement [m] (or rotation [rad]) from which on an object counts as touched."""


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
    names = data["family"].attrs["flag_meanings"].split()
    return {
        "interaction": data["interaction"].values[kept].tolist(),
        "family": [names[k] for k in data["family"].values[kept]],
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

    def last(values: torch.Tensor) -> dict[str, list[float]]:
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
