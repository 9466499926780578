"""How good are the predicted effects? Errors, and a predictor without an image to beat."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    import torch
    import xarray as xr

    from affordlib.interactions.batches import TrainingArrays


def error_row(errors_m: np.ndarray, **columns: Any) -> dict[str, Any]:
    """One row of a table: the given columns, then n, mean, standard error, median, 95th percentile.

    errors_m: (n,) distances [m], one per independent object.
    """
    errors = np.asarray(errors_m, dtype=float)
    if errors.ndim != 1 or len(errors) == 0 or not np.isfinite(errors).all():
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


def mean_length_errors_m(training: TrainingArrays, test: TrainingArrays) -> torch.Tensor:
    """Final position errors (N,) [m] of knowing only the direction and the mean length."""

    def direction(arrays: TrainingArrays) -> torch.Tensor:
        travel = arrays.action[:, -1, :2] - arrays.action[:, 0, :2]
        return travel / travel.norm(dim=-1, keepdim=True)

    length = (training.effect[:, -1, :2] * direction(training)).sum(dim=-1).mean()
    return (length * direction(test) - test.effect[:, -1, :2]).norm(dim=-1)


def refuse_seen(about: dict[str, Any], data: xr.Dataset, interactions: np.ndarray) -> None:
    """Raise if a checkpoint was trained on any of these interactions of a data set.

    about: what `load_checkpoint` returned beside the model. An interaction is told by its recipe
    and number, of however many the recipe has.
    """
    theirs, mine = (json.loads(text) for text in (about["recipe"], data.attrs["recipe"]))
    if theirs | {"n_interactions": 0} != mine | {"n_interactions": 0}:
        return
    numbers = data["interaction"].values[interactions]
    seen = sorted(set(about["seen_interactions"]) & {int(i) for i in numbers})
    if seen:
        raise ValueError(
            f"interactions: the model was trained or tuned on {len(seen)} of them (such as "
            f"{seen[:5]}); evaluate it on the test part of its split or on another data set"
        )
