"""The tables of the closed loop, made of the records of its trials."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from itertools import islice
from typing import Any

import pandas as pd

from affordlib.evaluation.metrics import error_row

WITHIN_M, WITHIN_HEIGHT_M, WITHIN_TURN_RAD = 0.005, 0.005, math.radians(3)
STATUSES = ("reached", "unreachable", "gave_up", "lost")
Rows = list[dict[str, Any]]


def _groups(table: pd.DataFrame, *by: str) -> Iterator[tuple[dict[str, Any], pd.DataFrame]]:
    """All records, and those of each value of some columns, with the columns that all have."""
    groups = [({}, table)]
    groups += [({k: value}, some) for k in by for value, some in table.groupby(k, sort=False)]
    for about, some in groups:
        row = dict.fromkeys(by, "all") | about | {"n": len(some)}
        if "status" in some:
            row["feasible"] = int(some.feasible.sum())
            row |= {name: int((some.status == name).sum()) for name in STATUSES}
        yield row, some


def _percent(good: pd.Series) -> float | None:
    return 100 * float(good.mean()) if len(good) else None


def _mean(values: pd.Series) -> float | None:
    return float(values.mean()) if len(values) else None


def pose_rows(records: Sequence[dict], column: str, within: float, unit: str) -> Rows:
    """Rows of `height` or `orientation`: how many feasible goals are hit, and with what error.

    Hit is within 5 mm of the position, and also within so much of the height [m] or turn [rad]; the
    errors are of those that say they reached it.
    """
    rows = []
    for row, some in _groups(pd.DataFrame(records), "object_class"):
        feasible = some[some.feasible]
        reached = feasible[feasible.status == "reached"]
        hit = (feasible.distance_m <= WITHIN_M) & (feasible[column].abs() <= within)
        spread = error_row(reached[column].abs().to_numpy(float)) if len(reached) else {}
        row["within_percent"] = _percent(hit)
        for name in ("mean", "sem", "median", "p95"):
            row[f"pose_error_{unit}_{name}"] = spread.get(f"{name}_m")
        row["distance_m_mean"] = _mean(reached.distance_m)
        rows.append(row | {"actions_mean": _mean(reached.actions)})
    return rows


def disturbance_rows(records: Sequence[dict]) -> Rows:
    """Rows of `disturbances`: how trials ended, and errors with and without disturbance, paired."""
    rows = []
    table = pd.json_normalize(list(records), sep="_")
    for row, some in _groups(table, "kind", "object_class"):
        feasible = some[some.feasible]
        both = feasible[(feasible[["status", "undisturbed_status"]] == "reached").all(axis=1)]
        apart = both.distance_m - both.undisturbed_distance_m
        row["within_percent"] = _percent(feasible.distance_m <= WITHIN_M)
        row["disturbed_mean_m"] = _mean(both.distance_m)
        row["undisturbed_mean_m"] = _mean(both.undisturbed_distance_m)
        row["apart_mean_m"] = _mean(apart)
        row["apart_sem_m"] = float(apart.sem()) if len(apart) > 1 else None
        row["actions_mean"] = _mean(feasible.actions)
        rows.append(row | {"undisturbed_actions_mean": _mean(feasible.undisturbed_actions)})
    return rows


def reachability_rows(records: Sequence[dict]) -> Rows:
    """Rows of `reachability`: both rates, goals on the rim of what can be reached apart.

    Right is a plan that was carried out, or 'unreachable' where the kinematics agrees.
    """
    table, rows = pd.DataFrame(records), []
    table["right"] = table.status == table.feasible.map({True: "reached", False: "unreachable"})
    rim = table.on_the_rim
    for goals, some in {"all": table, "off the rim": table[~rim], "on the rim": table[rim]}.items():
        groups = _groups(some, "object_class")
        for row, group in groups if goals == "all" else islice(groups, min(1, len(some))):
            yes, no = group[group.feasible], group[~group.feasible]
            row["right_percent"] = _percent(group.right)
            row["feasible_reached_percent"] = _percent(yes.right)
            row["infeasible_refused_percent"] = _percent(no.right)
            row["moved_for_nothing_percent"] = _percent(no.actions > 0)
            row["ik_rejections_mean"] = _mean(group.ik_rejections)
            rows.append({"goals": goals} | row | {"actions_mean": _mean(yes.actions) or 0.0})
    return rows


def open_loop_rows(records: Sequence[dict], within: float, unit: str) -> Rows:
    """Rows of plans that are executed open loop: for each planner, all categories and each.

    Hit is within 5 mm of the position as well; of the height or turn alone, *pose within*.
    """
    rows = []
    for planner, of_planner in pd.DataFrame(records).groupby("planner", sort=False):
        for row, some in _groups(of_planner, "object_class"):
            good, spread = some.pose_error <= within, error_row(some.distance_m.to_numpy())
            row |= {k: int(some[k].sum()) for k in ("predicted_reached", "arm_refused")}
            row["within_percent"] = _percent(good & (some.distance_m <= WITHIN_M))
            row["pose_within_percent"] = _percent(good)
            row[f"pose_error_{unit}_median"] = float(some.pose_error.median())
            for name in ("mean", "sem", "median", "p95"):
                row[f"distance_m_{name}"] = spread[f"{name}_m"]
            rows.append({"planner": planner} | row | {"actions_mean": _mean(some.actions)})
    return rows


ROWS: dict[str, Callable[[Sequence[dict]], Rows]] = {
    "height": partial(pose_rows, column="height_error_m", within=WITHIN_HEIGHT_M, unit="m"),
    "orientation": partial(pose_rows, column="turn_error_rad", within=WITHIN_TURN_RAD, unit="rad"),
    "disturbances": disturbance_rows,
    "reachability": reachability_rows,
}
OPEN_LOOP_ROWS: dict[str, Callable[[Sequence[dict]], Rows]] = {
    "orientation": partial(open_loop_rows, within=WITHIN_TURN_RAD, unit="rad"),
    "height": partial(open_loop_rows, within=WITHIN_HEIGHT_M, unit="m"),
}
