"""Cross-validation of models on a user's own log, always with all baselines for comparison."""

import warnings
from collections.abc import Sequence
from typing import Any

import joblib
import numpy as np
import pandas as pd
import torch
from scipy.stats import norm

from affordlib.logs.fit import BASELINES, MODELS, FittedModel, PushModel, folds_of
from affordlib.logs.log import LoggedPushes
from affordlib.types import check_choice, check_count

MOST_PUSHES = 3000  # the time of a Gaussian process grows with its cube


def cross_validate(
    data: LoggedPushes,
    models: Sequence[str] = ("np",),
    folds: int = 5,
    within: str = "group",
    seed: int = 0,
) -> pd.DataFrame:
    """Errors of models and of all baselines, one row per model and push; see `summary`.

    models: names of `MODELS`; folds: number of folds of each group, each tested once; within:
    "group" trains on the other folds of the same group, "all" on those of all groups. Columns:
    model, group, number of the push, n_train, position_m and yaw_rad, the errors, the shares of x,
    y and yaw inside the 50 and 90 % intervals, and the largest of their errors over σ.
    """
    folds = check_count("folds", folds, 2)
    check_choice("within", within, ("group", "all"))
    for name in models:
        check_choice("models", name, MODELS)
    names, counts = np.unique(data.groups, return_counts=True)
    if counts.min() < 2 * folds or len(data) > MOST_PUSHES:
        raise ValueError(
            f"data must hold at least {2 * folds} pushes of each group for {folds} folds and "
            f"at most {MOST_PUSHES}, got {dict(zip(names.tolist(), counts.tolist(), strict=True))}"
        )
    fold = folds_of(data.groups, folds, check_count("seed", seed, least=0))
    pools = [True] if within == "all" else [data.groups == name for name in names]
    jobs = [(pool & (fold != k), pool & (fold == k)) for pool in pools for k in range(folds)]
    known = [n for n in (*BASELINES, *models) if "feet" in data.context or "feet" not in n]
    parts = joblib.Parallel(n_jobs=min(len(jobs), joblib.cpu_count()))(
        joblib.delayed(errors_of)(data, *job, known, seed) for job in jobs
    )
    return pd.concat(parts, ignore_index=True)


def summary(errors: pd.DataFrame, by: Sequence[str] = ("model",)) -> list[dict[str, Any]]:
    """Summarise errors per push: a row for each value of the columns `by`.

    The number of pushes, mean, standard error (sem) and median of the errors, and coverage.
    """
    if not by or not {"position_m", "yaw_rad", "inside_50", "inside_90", *by} <= {*errors}:
        made = f"errors, a table of cross_validate ({', '.join(map(str, errors))})"
        raise ValueError(f"by must be columns of {made}, got {by!r}")
    rows = []
    for key, part in errors.groupby([*by], sort=False):
        row = dict(zip(by, key, strict=True)) | {"n": len(part)}
        for how in ("mean", "sem", "median"):
            row[f"position_{how}_m"] = part["position_m"].agg(how)
        row |= {f"yaw_{how}_rad": part["yaw_rad"].agg(how) for how in ("mean", "sem")}
        rows.append(row | {f"coverage_{p}": part[f"inside_{p}"].mean() for p in (50, 90)})
    return rows


def errors_of(
    data: LoggedPushes, trained: np.ndarray, tested: np.ndarray, names: Sequence[str], seed: int = 0
) -> pd.DataFrame:
    """Errors of models trained on some pushes of a log at others; trained, tested: masks (n,)."""
    train, test, threads, parts = *map(data.select, (trained, tested)), torch.get_num_threads(), []
    torch.set_num_threads(1)  # the folds run side by side
    try:
        for name in names:
            errors = forecast_errors(FittedModel(name, train, {"seed": np.array(seed)}), test)
            parts.append(errors.assign(model=name, push=np.flatnonzero(tested)))
    finally:
        torch.set_num_threads(threads)
    return pd.concat(parts, ignore_index=True).assign(n_train=trained.sum())


def forecast_errors(model: PushModel, test: LoggedPushes) -> pd.DataFrame:
    """One row per push: errors, and the shares of x, y and yaw in the 50 and 90 % intervals."""
    with warnings.catch_warnings():  # the longest push of all is tested too
        warnings.simplefilter("ignore", UserWarning)
        mean, std = model.predict(test)
    off = np.abs(mean - np.column_stack([test.displacement_m, test.turn_rad]))
    inside = {f"inside_{p}": (off < norm.ppf(0.5 + p / 200) * std).mean(axis=1) for p in (50, 90)}
    errors = {"position_m": np.hypot(off[:, 0], off[:, 1]), "yaw_rad": off[:, 2]}
    over = np.divide(off, std, out=np.where(off > 0, np.inf, 0.0), where=std > 0)
    inside["error_over_std"] = over.max(axis=1)
    return pd.DataFrame({"group": test.groups} | errors | inside)
