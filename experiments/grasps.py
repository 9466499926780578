"""Will a grasp lift its object? Table 2 of the paper, and what its rule leaves on the table.

Success is a gain in height above 0.1 m. The paper foresees it where μ_z(1) > 0.1 m, which is where
P(z > 0.1 m) > ½. TP is the share of the true successes that are foreseen, TN that of the true
failures, with Wilson's 95 % intervals, folds pooled.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from affordlib.evaluation.predictions import final_error
from affordlib.primitives import Grasp
from experiments.pooled import Part, by_model
from experiments.units import Unit

AIM_TP, AIM_TN = 0.90, 0.95
"""Shares of the true successes and failures that we would have foreseen."""


def wilson(k: int, n: int, z: float = 1.959964) -> tuple[float, float]:
    """Wilson's 95 % interval of a share of which k of n were seen (JASA 22, 1927)."""
    if not 0 <= k <= n or n < 1:
        raise ValueError(f"k of n must be 0 ≤ k ≤ n, n ≥ 1, got {k} of {n}")
    centre = (k + z * z / 2) / (n + z * z)
    half = z / (n + z * z) * math.sqrt(k * (n - k) / n + z * z / 4)
    return max(0.0, centre - half), min(1.0, centre + half)


def auc(score: np.ndarray, truth: np.ndarray, fold: np.ndarray) -> float | None:
    """The share of (success, failure) pairs that the score puts in order; None without pairs.

    Pairs are of one fold each: models of different folds are not on one scale.
    """
    pairs = truth[:, None] & ~truth & (fold[:, None] == fold)
    if not pairs.any():
        return None
    order = (score[:, None] > score) + (score[:, None] == score) / 2
    return float(order[pairs].mean())


@dataclass(frozen=True)
class Held:
    """Held-out grasps of all folds (N,): P(z > 0.1 m); whether it was lifted, can roll; fold."""

    score: np.ndarray
    lifted: np.ndarray
    rolls: np.ndarray
    fold: np.ndarray

    def __getitem__(self, chosen: np.ndarray) -> Held:
        return Held(*(getattr(self, f.name)[chosen] for f in fields(self)))


def _held(group: list[Part]) -> Held:
    told = [part["fold_test"] for part in group]
    return Held(
        np.concatenate([success_probability(t) for t in told]),
        np.concatenate([t["truth"]["z"] for t in told]) > Grasp.success_m,
        np.concatenate([t["rollable"] for t in told]),
        np.repeat(np.arange(len(told)), [len(t["rollable"]) for t in told]),
    )


def _of_one_seed(parts: list[tuple[Unit, Part]]) -> Iterable[tuple[dict, list[Part]]]:
    """By model, of the first seed alone: another cross-validation tests the same grasps again."""
    first = min((unit.seed for unit, _ in parts), default=0)
    return by_model([(unit, part) for unit, part in parts if unit.seed == first], "grasp")


def grasp_rows(parts: list[tuple[Unit, Part]]) -> list[dict[str, Any]]:
    """The paper's Table 2, by its rule: what can roll and what cannot, apart."""
    rows = []
    for about, group in _of_one_seed(parts):
        held, error = _held(group), None
        if "mean" in group[0]["fold_test"]:
            error = np.concatenate([final_error(part["fold_test"]) for part in group])
        for rollable in (False, True):
            chosen = held.rolls == rollable
            if not chosen.any():
                continue
            one = held[chosen]
            row = about | {"rollable": rollable, "n": int(chosen.sum())}
            row["error_mean_m"] = None if error is None else float(error[chosen].mean())
            row["error_median_m"] = None if error is None else float(np.median(error[chosen]))
            row |= confusion_columns(one.score > 0.5, one.lifted)
            brier = float(np.square(one.score - one.lifted).mean())
            rows.append(row | {"auc": auc(one.score, one.lifted, one.fold), "brier": brier})
    return rows


def rates(score: np.ndarray, lifted: np.ndarray, thresholds: np.ndarray) -> tuple[np.ndarray, ...]:
    """True positive and true negative rates (T,) of a score (N,) above thresholds (T,)."""
    success, failure = np.sort(score[lifted]), np.sort(score[~lifted])
    tp = 1 - np.searchsorted(success, thresholds, side="right") / len(success)
    return tp, np.searchsorted(failure, thresholds, side="right") / len(failure)


def best_threshold(score: np.ndarray, lifted: np.ndarray) -> float:
    """The threshold at which the lesser of the margins of TP and TN over their aims is largest."""
    known = np.unique(score)
    between = (known[1:] + known[:-1]) / 2
    tp, tn = rates(score, lifted, between)
    return float(between[np.argmax(np.minimum(tp - AIM_TP, tn - AIM_TN))])


def threshold_rows(parts: list[tuple[Unit, Part]]) -> list[dict[str, Any]]:
    """Table 2 again, the threshold not ½ but what suits the other folds' held-out grasps best.

    What is foreseen of a fold decides nothing about its own threshold.
    """
    rows = []
    for about, group in _of_one_seed(parts):
        if about["folds"] == 1 or about["model"] == "constant":
            continue
        held = _held(group)
        for rollable in (False, True):
            one = held[held.rolls == rollable]
            chosen = {}
            for fold in np.unique(one.fold):
                others = one[one.fold != fold]
                chosen[fold] = best_threshold(others.score, others.lifted)
            threshold = np.array([chosen[fold] for fold in one.fold])
            row = about | {"rollable": rollable, "n": len(threshold)}
            row |= {"threshold_median": float(np.median(list(chosen.values())))}
            rows.append(row | confusion_columns(one.score > threshold, one.lifted))
    return rows


def roc_rows(parts: list[tuple[Unit, Part]], n_points: int = 51) -> list[dict[str, Any]]:
    """The receiver operating characteristic: TP and TN over the whole range of thresholds.

    Of sets of 1,000 grasps; of 100, a curve is a few steps.
    """
    rows = []
    for about, group in _of_one_seed(parts):
        if about["n_interactions"] < 1000 or about["model"] == "constant":
            continue
        held = _held(group)
        for rollable in (False, True):
            one = held[held.rolls == rollable]
            known = np.unique(one.score)
            tp, tn = rates(one.score, one.lifted, np.concatenate([[-np.inf], known]))
            kept = np.unique(np.linspace(0, len(tp) - 1, n_points).round().astype(int))
            for k in kept:
                shown = {"tp_percent": round(100 * tp[k], 2), "tn_percent": round(100 * tn[k], 2)}
                rows.append(about | {"rollable": rollable} | shown)
    return rows


def success_probability(answers: dict[str, Any]) -> np.ndarray:
    """P(z > 0.1 m) (N,); above one half exactly where a Gaussian's mean is above 0.1 m."""
    if "probability" in answers:
        return np.array(answers["probability"])
    mean, std = np.array(answers["mean"]["z"]), np.array(answers["std"]["z"])
    standard = (mean - Grasp.success_m) / (std * math.sqrt(2))
    return np.array([(1 + math.erf(v)) / 2 for v in standard])


def confusion_columns(foreseen: np.ndarray, truth: np.ndarray) -> dict[str, Any]:
    """TP and FN in per cent of the true successes, TN and FP of the true failures; intervals."""
    columns: dict[str, Any] = {}
    for right, wrong, those in (("tp", "fn", truth), ("tn", "fp", ~truth)):
        n, k = int(those.sum()), int((foreseen == truth)[those].sum())
        low, high = wilson(k, n) if n else (None, None)
        columns |= {
            f"{right}_percent": 100 * k / n if n else None,
            f"{right}_low_percent": None if low is None else 100 * low,
            f"{right}_high_percent": None if high is None else 100 * high,
            f"{wrong}_percent": 100 * (n - k) / n if n else None,
        }
    return columns | {"n_success": int(truth.sum()), "n_failure": int((~truth).sum())}
