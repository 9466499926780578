"""Prediction of grasp success: Table 2 of the paper.

Success is a gain in height above 0.1 m. The paper predicts success if μ_z(1) > 0.1 m. TP is the
sensitivity (share of successes that are predicted), TN the specificity (share of failures that are
predicted), with Wilson's 95 % intervals over all folds.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd

from affordlib.primitives import Grasp
from experiments.cross_validation import by_model
from experiments.runner import Rows, shares


def grasp_rows(grasps: pd.DataFrame) -> Rows:
    """Return the paper's Table 2; grasps: predictions with the jobs' arguments as columns.

    Only the first seed is used, because cross-validations with other seeds test the same grasps.
    """
    rows = []
    for about, group in by_model(grasps[grasps["seed"] == grasps["seed"].min()]):
        known = about["model"] != "logistic"
        lifts = group["mean_z"] > Grasp.success_m if known else group["probability"] > 0.5
        group = group.assign(predicted=lifts, lifted=group["truth_z"] > Grasp.success_m)
        for rollable, some in group.groupby("rollable"):
            row = about | {"rollable": bool(rollable), "n": len(some)}
            row["error_mean_m"] = float(some["final_error"].mean()) if known else None
            predicted, lifted = some["predicted"].to_numpy(), some["lifted"].to_numpy()
            rows.append(row | confusion_columns(predicted, lifted))
    return rows


def confusion_columns(predicted: np.ndarray, lifted: np.ndarray) -> dict[str, Any]:
    """Return TP and TN in per cent with intervals, None without successes or failures."""
    columns: dict[str, Any] = {}
    for rate, those in (("tp", lifted), ("tn", ~lifted)):
        n, k = int(those.sum()), int((predicted == lifted)[those].sum())
        names = (f"{rate}{end}_percent" for end in ("", "_low", "_high"))
        columns |= zip(names, shares(k, n), strict=True)
    return columns | {"n_success": int(lifted.sum()), "n_failure": int((~lifted).sum())}
