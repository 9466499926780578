"""What models foresee of interactions beside what happened: the answers, and errors read off them.

Models see the image and the commanded action at t = 0 and t = 1, and no effect. Answers are plain
lists, one entry an interaction, so that they can be stored as they are.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
import xarray as xr

from affordlib.evaluation.baselines import Forecast, features, logistic
from affordlib.interactions import TrainingArrays
from affordlib.interactions.batches import believable, observe_action, plane_of
from affordlib.models.calibration import LEVELS, coverage
from affordlib.models.ensemble import Ensemble
from affordlib.models.network import EffectNetwork, gaussian_nll
from affordlib.primitives import Grasp
from affordlib.world.objects import FAMILIES

EVERY = 12
"""Every twelfth sample is one of the paper's 25 steps of 150 ms."""

CONTACT_M = 0.001
"""From where on an object counts as touched: moved by this much (or turned by as many rad)."""


def steps_of(arrays: TrainingArrays) -> torch.Tensor:
    """Sample numbers of the 25 steps, the last of them t = 1."""
    return torch.arange(EVERY, len(arrays.phase), EVERY)


@torch.no_grad()
def network_predictions(
    model: EffectNetwork | Ensemble, data: xr.Dataset, interactions: np.ndarray
) -> dict[str, Any]:
    """What a network foresees of interactions."""
    kept = believable(data, interactions)
    arrays = TrainingArrays.from_dataset(data, kept, model.action_channels, model.effect_channels)
    at = steps_of(arrays)
    told = model.predict(
        model.encode(arrays.image),
        observe_action(arrays),
        arrays.phases(at),
    )
    return _answers(data, kept, arrays, at, told.effect_mean, told.effect_std)


def baseline_predictions(
    baseline: Callable[..., Forecast],
    channels: tuple[tuple[str, ...], tuple[str, ...]],
    data: xr.Dataset,
    train_on: np.ndarray,
    other: xr.Dataset,
    asked: np.ndarray,
) -> dict[str, Any]:
    """What a baseline, fitted to interactions of `data`, foresees of those `asked` of `other`."""
    known, kept = believable(data, train_on), believable(other, asked)
    training = TrainingArrays.from_dataset(data, known, *channels)
    arrays = TrainingArrays.from_dataset(other, kept, *channels)
    there, here = data.isel(interaction=known), other.isel(interaction=kept)
    at = steps_of(arrays)
    mean, std = baseline(training, arrays, at, features(there), features(here))
    return _answers(other, kept, arrays, at, mean, std)


def logistic_predictions(
    data: xr.Dataset, train_on: np.ndarray, other: xr.Dataset, asked: np.ndarray
) -> dict[str, Any]:
    """The probability of a grasp's success, from the object's size alone, and the true heights."""
    known, kept = believable(data, train_on), believable(other, asked)
    lifted = data["effect"].values[known, -1, 2] > Grasp.success_m
    told = logistic(data["size"].values[known], lifted, other["size"].values[kept])
    height = other["effect"].values[kept, -1, 2]
    about = _objects(other, kept)
    return about | {"truth": {"z": height.tolist()}, "probability": told.tolist()}


def _objects(data: xr.Dataset, kept: np.ndarray) -> dict[str, Any]:
    names = data["family"].attrs["flag_meanings"].split()
    return {
        "interaction": data["interaction"].values[kept].tolist(),
        "family": [names[k] for k in data["family"].values[kept]],
        "rollable": data["rollable"].values[kept].tolist(),
    }


def _answers(
    data: xr.Dataset,
    kept: np.ndarray,
    arrays: TrainingArrays,
    at: torch.Tensor,
    mean: torch.Tensor,
    std: torch.Tensor,
) -> dict[str, Any]:
    """Truth, mean and σ at t = 1 by channel, and mean errors of the whole course."""
    truth, names = arrays.effect[:, at], arrays.effect_channels
    columns = plane_of(names) or [0]
    error = (mean - truth)[..., columns].norm(dim=-1)
    begun = truth[..., columns].norm(dim=-1) > CONTACT_M
    after = (error * begun).sum(dim=1) / begun.sum(dim=1).clamp_min(1)

    def last(values: torch.Tensor) -> dict[str, list[float]]:
        return {name: values[:, -1, k].tolist() for k, name in enumerate(names)}

    return _objects(data, kept) | {
        "truth": last(truth),
        "mean": last(mean),
        "std": last(std),
        "trajectory_error": error.mean(dim=1).tolist(),
        "after_contact_error": after.tolist(),
    }


def final_error(answers: dict[str, Any]) -> np.ndarray:
    """Distance (N,) between the foreseen and the true end: of (x, y) [m], or of z or yaw alone."""
    off = _off(answers)
    return np.hypot(off["x"], off["y"]) if "x" in off else np.abs(next(iter(off.values())))


def yaw_error(answers: dict[str, Any]) -> np.ndarray | None:
    """Distance (N,) [rad] between the foreseen and the true turn; None if none is foreseen."""
    off = _off(answers)
    return np.abs((off["yaw"] + np.pi) % (2 * np.pi) - np.pi) if "yaw" in off else None


def _off(answers: dict[str, Any]) -> dict[str, np.ndarray]:
    mean, truth = answers["mean"], answers["truth"]
    return {name: np.subtract(mean[name], truth[name]) for name in mean}


def calibration(answers: dict[str, Any]) -> list[dict[str, Any]]:
    """Per effect channel at t = 1: n, coverage of the central intervals, mean σ and NLL."""
    rows = []
    for channel, values in answers["std"].items():
        truth, mean, std = (
            torch.tensor(v, dtype=torch.float64)
            for v in (answers["truth"][channel], answers["mean"][channel], values)
        )
        covered = {f"coverage_{v:.0%}"[:-1]: coverage(truth, mean, std, v) for v in LEVELS}
        nll = float(gaussian_nll(truth, mean, std).mean())
        row = {"channel": channel, "n": len(truth), **covered, "std_mean": float(std.mean())}
        rows.append(row | {"nll": nll})
    return rows


def summary(answers: dict[str, Any]) -> dict[str, Any]:
    """Errors and calibration alone, for a large test set."""
    yaw = yaw_error(answers)
    errors = {"final_error": final_error(answers), "yaw_error": yaw}
    errors |= {k: np.array(answers[k]) for k in ("trajectory_error", "after_contact_error")}
    plain = {k: None if v is None else [float(f"{e:.4g}") for e in v] for k, v in errors.items()}
    return {"family": answers["family"], **plain, "calibration": calibration(answers)}


def stored(part: dict[str, Any]) -> dict[str, Any]:
    """As a part is written: rounded, and families by their numbers in `FAMILIES`."""
    number = {name: k for k, name in enumerate(FAMILIES)}

    def written(name: str, value: Any) -> Any:
        if name == "family":
            return [number[v] for v in value]
        return stored(value) if isinstance(value, dict) else rounded(value)

    return {name: written(name, value) for name, value in part.items()}


def rounded(value: Any) -> Any:
    """The same, with six significant digits of every float."""
    if isinstance(value, dict):
        return {k: rounded(v) for k, v in value.items()}
    if isinstance(value, list):
        return [rounded(v) for v in value]
    return float(f"{value:.6g}") if isinstance(value, float) else value
