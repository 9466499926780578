"""Will a grasp lift its object? Table 2 of the paper, and other thresholds than its own.

Success is a gain in height above 0.1 m. The paper predicts it where μ_z(1) > 0.1 m, which is where
P(z > 0.1 m) > ½. TP is the share of the successes that are predicted, TN that of the failures, with
Wilson's 95 % intervals, folds together.
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
"""Shares of the successes and failures that we would like to be predicted."""


def auc(score: np.ndarray, truth: np.ndarray, fold: np.ndarray) -> float | None:
    """The share of (success, failure) pairs that the score puts in order; None without pairs.

    Pairs are of one fold each: models of different folds are not on one scale.
    """
    pairs = truth[:, None] & ~truth & (fold[:, None] == fold)
    if not pairs.any():
        return None
    order = (score[:, None] > score) + (score[:, None] == score) / 2
    return float(order[pairs].mean())


def success_probability(mean_z: np.ndarray, std_z: np.ndarray) -> np.ndarray:
    """P(z > 0.1 m) (N,) of Gaussians; above one half exactly where their mean is above 0.1 m."""
    return (1 + erf(np.subtract(mean_z, Grasp.success_m) / (math.sqrt(2) * np.asarray(std_z)))) / 2


def _held_out(grasps: pd.DataFrame) -> Iterator[tuple[dict[str, Any], bool, pd.DataFrame]]:
    """Held-out grasps of each model, what can roll and what cannot, with `score` and `lifted`.

    Of the first seed alone: another cross-validation tests the same grasps again.
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
    """The paper's Table 2, by its rule; grasps: predictions with the jobs' arguments as columns."""
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
    """True positive and true negative rates (T,) of a score (N,) above thresholds (T,)."""
    success, failure = np.sort(score[lifted]), np.sort(score[~lifted])
    tp = 1 - np.searchsorted(success, thresholds, side="right") / len(success)
    return tp, np.searchsorted(failure, thresholds, side="right") / len(failure)


def best_threshold(score: np.ndarray, lifted: np.ndarray) -> float:
    """The threshold at which the lesser margin of TP and TN over their goals is largest."""
    known = np.unique(score)
    between = (known[1:] + known[:-1]) / 2
    tp, tn = rates(score, lifted, between)
    return float(between[np.argmax(np.minimum(tp - GOAL_TP, tn - GOAL_TN))])


def threshold_rows(grasps: pd.DataFrame) -> Rows:
    """Table 2 again, with the threshold that suits the other folds' held-out grasps best.

    Predictions of a fold decide nothing about its own threshold.
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
    """The receiver operating characteristic: TP and TN over the whole range of thresholds.

    Only from sets of 1,000 grasps; with 100, a curve has only a few steps.
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
    """TP in per cent of the successes, TN of the failures, with intervals; None of nothing."""
    columns: dict[str, Any] = {}
    for rate, those in (("tp", lifted), ("tn", ~lifted)):
        n, k = int(those.sum()), int((predicted == lifted)[those].sum())
        interval = stats.binomtest(k, n).proportion_ci(method="wilson") if n else (None, None)
        shares = (k / n if n else None, *interval)
        for end, share in zip(("", "_low", "_high"), shares, strict=True):
            columns[f"{rate}{end}_percent"] = share and 100 * share
    return columns | {"n_success": int(lifted.sum()), "n_failure": int((~lifted).sum())}
