"""Prediction of grasp success: Table 2 of the paper.

Success is a gain in height above 0.1 m. The paper predicts success if μ_z(1) > 0.1 m, i.e. if
P(z > 0.1 m) > ½. TP is the sensitivity (share of successes that are predicted), TN the specificity
(share of failures that are predicted), with Wilson's 95 % intervals over all folds.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np
import pandas as pd
from scipy import stats
from scipy.special import erf

from affordlib.primitives import Grasp
from experiments.cross_validation import by_model
from experiments.runner import Rows


def auc(score: np.ndarray, truth: np.ndarray, fold: np.ndarray) -> float | None:
    """Return the area under the ROC curve, None if there are no (success, failure) pairs.

    Pairs are taken within folds, because scores of different folds' models are not comparable.
    """
    pairs = truth[:, None] & ~truth & (fold[:, None] == fold)
    if not pairs.any():
        return None
    order = (score[:, None] > score) + (score[:, None] == score) / 2
    return float(order[pairs].mean())


def success_probability(mean_z: np.ndarray, std_z: np.ndarray) -> np.ndarray:
    """Return P(z > 0.1 m) (N,) of Gaussians, which exceeds ½ exactly if the mean exceeds 0.1 m."""
    return (1 + erf(np.subtract(mean_z, Grasp.success_m) / (math.sqrt(2) * np.asarray(std_z)))) / 2


def _held_out(grasps: pd.DataFrame) -> Iterator[tuple[dict[str, Any], bool, pd.DataFrame]]:
    """Yield held-out grasps by model and rollability, with columns `score` and `lifted`.

    Only the first seed is used, because cross-validations with other seeds test the same grasps.
    """
    if grasps.empty:
        return
    for about, group in by_model(grasps[grasps["seed"] == grasps["seed"].min()]):
        if about["model"] == "logistic":
            score = group["probability"]
        else:
            score = success_probability(group["mean_z"], group["std_z"])
        group = group.assign(score=score, lifted=group["truth_z"] > Grasp.success_m)
        for rollable, some in group.groupby("rollable"):
            yield about, bool(rollable), some


def grasp_rows(grasps: pd.DataFrame) -> Rows:
    """Return the paper's Table 2; grasps: predictions with the jobs' arguments as columns."""
    rows = []
    for about, rollable, some in _held_out(grasps):
        score, lifted = some["score"].to_numpy(), some["lifted"].to_numpy()
        known = about["model"] != "logistic"
        row = about | {"rollable": rollable, "n": len(some)}
        row["error_mean_m"] = float(some["final_error"].mean()) if known else None
        row |= confusion_columns(score > 0.5, lifted)
        rows.append(row | {"auc": auc(score, lifted, some["fold"].to_numpy())})
    return rows


def confusion_columns(predicted: np.ndarray, lifted: np.ndarray) -> dict[str, Any]:
    """Return TP and TN in per cent with intervals, None without successes or failures."""
    columns: dict[str, Any] = {}
    for rate, those in (("tp", lifted), ("tn", ~lifted)):
        n, k = int(those.sum()), int((predicted == lifted)[those].sum())
        interval = stats.binomtest(k, n).proportion_ci(method="wilson") if n else (None, None)
        shares = (k / n if n else None, *interval)
        for end, share in zip(("", "_low", "_high"), shares, strict=True):
            columns[f"{rate}{end}_percent"] = share and 100 * share
    return columns | {"n_success": int(lifted.sum()), "n_failure": int((~lifted).sum())}
