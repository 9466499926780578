"""What the paper reports, to stand beside what was measured here: its Tables 1 to 3.

In its own simulator, with its own objects, gripper and data, so it is context and no opponent.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

LEVER_UP_CM = {
    "reported": (0.340, 0.352, 0.364, 0.375, 0.387),
    "reported_lstm": (1.02, 1.00, 0.96, 1.01, 0.91),
}
"""Table 1: the error [cm] of 1 to 5 steps ahead, of the paper's network and a recurrent one."""

GRASP = {
    False: {"error_mean_m": 0.273, "tp_percent": 79.62, "tn_percent": 91.43, "fp_percent": 8.57},
    True: {"error_mean_m": 0.277, "tp_percent": 71.72, "tn_percent": 89.52, "fp_percent": 10.48},
}
"""Table 2, by whether the object can roll. False negatives are printed as 21.38 and 28.28 %, the
first of which makes 101 % with the true positives; they are left out."""

PLANNING_M = {
    "reported_astar": ((0.020, 0.002), (0.013, 0.002), (0.013, 0.002)),
    "reported_gradient_100": ((0.0074, 0.0017), (0.0077, 0.0016), (0.0077, 0.0013)),
    "reported_gradient_300": ((0.0021, 0.00044), (0.0022, 0.00068), (0.0022, 0.00046)),
}
"""Table 3: distance from the goal and its ± [m], which the paper does not name: single full, single
partial, multi partial."""


def lever_up_rows() -> list[dict[str, Any]]:
    """Table 1 with the columns of our summary of windows; what the paper does not tell is None."""
    return [
        {"model": name, "folds": 5, "epochs": None, "n": None}
        | {f"step_{k}_mean_cm": error for k, error in enumerate(errors, 1)}
        for name, errors in LEVER_UP_CM.items()
    ]


def grasp_rows(columns: Iterable[str]) -> list[dict[str, Any]]:
    """Table 2 with the columns of our table of grasps; what the paper does not tell is None."""
    return [
        dict.fromkeys(columns)
        | {"model": "reported", "n_interactions": 100, "rollable": can}
        | told
        for can, told in GRASP.items()
    ]


def planning_rows() -> list[dict[str, Any]]:
    """Table 3 with the columns of our summary of planners, its own objects as a group."""
    modes = ("single_full", "single_partial", "multi_partial")
    return [
        {"planner": name, "model": "reported", "world": "reported", "object_class": "reported"}
        | {
            f"{mode}_{statistic}_m": value
            for mode, pair in zip(modes, told, strict=True)
            for statistic, value in zip(("mean", "sem"), pair, strict=True)
        }
        for name, told in PLANNING_M.items()
    ]
