"""Rows of error statistics, and the check that a model is not tested on its training data."""

from typing import Any

import numpy as np

from affordlib.interactions.dataset import check_numbers
from affordlib.interactions.recipes import Recipe
from affordlib.types import check_array


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
        recipes = [Recipe.from_json(text) for text in (about["recipe"], data.attrs["recipe"])]
        trained_on = {int(number) for number in about["seen_interactions"]}
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(
            f"about does not say which interactions the model was trained on ({error!r}); "
            "save the checkpoint with the recipe and seen_interactions of its training"
        ) from error
    check_numbers("interactions", interactions)
    numbers = data["interaction"].values[interactions]
    seen = sorted(trained_on & {int(i) for i in numbers})
    objects = [(r.seed, r.categories, r.size_range_m, r.height_range_m) for r in recipes]
    if objects[0] == objects[1] and seen:
        raise ValueError(
            f"interactions: the model was trained or tuned on {len(seen)} of them (such as "
            f"{seen[:5]}); evaluate it on the test part of its split or on another data set"
        )
