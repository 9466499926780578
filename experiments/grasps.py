"""Prediction of grasp success: Table 2 of the paper, and other thresholds than the paper's.

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

GOAL_TP, GOAL_TN = 0.90, 0.95
"""Target sensitivity and specificity."""


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


def rates(score: np.ndarray, lifted: np.ndarray, thresholds: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return TP and TN rates (T,) when scores (N,) above thresholds (T,) predict success."""
    success, failure = np.sort(score[lifted]), np.sort(score[~lifted])
    tp = 1 - np.searchsorted(success, thresholds, side="right") / len(success)
    return tp, np.searchsorted(failure, thresholds, side="right") / len(failure)


def best_threshold(score: np.ndarray, lifted: np.ndarray) -> float:
    """Return the threshold that maximises the smaller margin of TP and TN over their targets."""
    known = np.unique(score)
    between = (known[1:] + known[:-1]) / 2
    tp, tn = rates(score, lifted, between)
    return float(between[np.argmax(np.minimum(tp - GOAL_TP, tn - GOAL_TN))])


def threshold_rows(grasps: pd.DataFrame) -> Rows:
    """Return Table 2 with thresholds chosen on the held-out grasps of the other folds.

    Predictions of a fold are not used for its own threshold.
    """
    rows = []
    for about, rollable, some in _held_out(grasps):
        if about["folds"] == 1 or about["model"] == "constant":
            continue
        score, lifted, fold = (some[name].to_numpy() for name in ("score", "lifted", "fold"))
        chosen = {k: best_threshold(score[fold != k], lifted[fold != k]) for k in np.unique(fold)}
        row = about | {"rollable": rollable, "n": len(some)}
        rows.append(row | confusion_columns(score > [chosen[k] for k in fold], lifted))
    return rows


def roc_rows(grasps: pd.DataFrame, n_points: int = 51) -> Rows:
    """Return the receiver operating characteristic: TP and TN over all thresholds.

    Only sets of 1,000 grasps are used, since a curve of 100 has only a few steps.
    """
    rows = []
    for about, rollable, some in _held_out(grasps):
        if about["n_interactions"] < 1000 or about["model"] == "constant":
            continue
        score = some["score"].to_numpy()
        thresholds = np.concatenate([[-np.inf], np.unique(score)])
        tp, tn = rates(score, some["lifted"].to_numpy(), thresholds)
        for k in np.unique(np.linspace(0, len(tp) - 1, n_points).round().astype(int)):
            shown = {"tp_percent": round(100 * tp[k], 2), "tn_percent": round(100 * tn[k], 2)}
            rows.append(about | {"rollable": rollable} | shown)
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
