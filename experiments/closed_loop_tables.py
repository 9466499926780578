"""The tables of the closed loop, made of the records of its trials."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

import numpy as np

from affordlib.evaluation.metrics import error_row

WITHIN_M, WITHIN_HEIGHT_M, WITHIN_TURN_RAD = 0.005, 0.005, math.radians(3)


def _share(chosen: Sequence[dict], good: Callable[[dict], bool]) -> float | None:
    return 100 * float(np.mean([good(r) for r in chosen])) if chosen else None


def _mean(values: Iterable[float]) -> float | None:
    values = list(values)
    return float(np.mean(values)) if values else None


def _groups(records: Sequence[dict], *by: str) -> Iterator[tuple[dict[str, Any], list[dict]]]:
    """All records, and those of each value of some columns."""
    yield dict.fromkeys(by, "all"), list(records)
    for name in by:
        for value in dict.fromkeys(r[name] for r in records):
            about = dict.fromkeys(by, "all") | {name: value}
            yield about, [r for r in records if r[name] == value]


def _endings(chosen: Sequence[dict]) -> dict[str, int]:
    names = ("reached", "unreachable", "gave_up", "lost")
    return {name: sum(r["ending"] == name for r in chosen) for name in names}


def pose_rows(records: Sequence[dict], column: str, within: float, unit: str) -> list[dict]:
    """Rows of `height` or `orientation`: how many feasible goals are hit, and how far off.

    Hit is within 5 mm of the place, and besides within of the height [m] or turn [rad]; how far
    off are those that say they reached it.
    """
    rows = []
    for about, chosen in _groups(records, "object_class"):
        feasible = [r for r in chosen if r["feasible"]]
        reached = [r for r in feasible if r["ending"] == "reached"]
        spread = error_row(np.array([abs(r[column]) for r in reached])) if reached else {}
        rows.append(
            {
                **about,
                "n": len(chosen),
                "feasible": len(feasible),
                **_endings(chosen),
                "within_percent": _share(
                    feasible, lambda r: r["distance_m"] <= WITHIN_M and abs(r[column]) <= within
                ),
                **{
                    f"off_{unit}_{name}": spread.get(f"{name}_m")
                    for name in ("mean", "sem", "median", "p95")
                },
                "distance_m_mean": _mean(r["distance_m"] for r in reached),
                "actions_mean": _mean(r["actions"] for r in reached),
            }
        )
    return rows


def disturbance_rows(records: Sequence[dict]) -> list[dict]:
    """Rows of `disturbances`: endings, and the error with and without what went wrong, paired."""
    rows = []
    for about, chosen in _groups(records, "kind", "object_class"):
        feasible = [r for r in chosen if r["feasible"]]
        both = [r for r in feasible if r["ending"] == r["undisturbed"]["ending"] == "reached"]
        apart = np.array([r["distance_m"] - r["undisturbed"]["distance_m"] for r in both])
        rows.append(
            {
                **about,
                "n": len(chosen),
                "feasible": len(feasible),
                **_endings(chosen),
                "within_percent": _share(feasible, lambda r: r["distance_m"] <= WITHIN_M),
                "disturbed_mean_m": _mean(r["distance_m"] for r in both),
                "undisturbed_mean_m": _mean(r["undisturbed"]["distance_m"] for r in both),
                "apart_mean_m": _mean(apart),
                "apart_sem_m": float(apart.std(ddof=1) / math.sqrt(len(apart)))
                if len(apart) > 1
                else None,
                "actions_mean": _mean(r["actions"] for r in feasible),
                "undisturbed_actions_mean": _mean(r["undisturbed"]["actions"] for r in feasible),
            }
        )
    return rows


def judged_right(record: dict) -> bool:
    """A plan that was carried out, or 'unreachable' where the oracle agrees."""
    if record["feasible"]:
        return record["ending"] == "reached"
    return record["ending"] == "unreachable"


def reachability_rows(records: Sequence[dict]) -> list[dict]:
    """Rows of `reachability`: both rates, goals on the rim apart."""
    rows = []
    for where, of_where in (
        ("all", records),
        ("off the rim", [r for r in records if not r["on_the_rim"]]),
        ("on the rim", [r for r in records if r["on_the_rim"]]),
    ):
        for about, chosen in _groups(of_where, "object_class"):
            if not chosen or (where != "all" and about["object_class"] != "all"):
                continue
            yes = [r for r in chosen if r["feasible"]]
            no = [r for r in chosen if not r["feasible"]]
            rows.append(
                {
                    "goals": where,
                    **about,
                    "n": len(chosen),
                    "feasible": len(yes),
                    **_endings(chosen),
                    "right_percent": _share(chosen, judged_right),
                    "feasible_reached_percent": _share(yes, judged_right),
                    "infeasible_refused_percent": _share(no, judged_right),
                    "moved_for_nothing_percent": _share(no, lambda r: r["moved"]),
                    "vetoes_mean": float(np.mean([r["vetoes"] for r in chosen])),
                    "actions_mean": float(np.mean([r["actions"] for r in yes])) if yes else 0.0,
                }
            )
    return rows


ROWS: dict[str, Callable[[Sequence[dict]], list[dict]]] = {
    "height": lambda records: pose_rows(records, "height_error_m", WITHIN_HEIGHT_M, "m"),
    "orientation": lambda records: pose_rows(records, "turn_error_rad", WITHIN_TURN_RAD, "rad"),
    "disturbances": disturbance_rows,
    "reachability": reachability_rows,
}
