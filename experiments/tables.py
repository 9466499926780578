"""`data/results/effect_prediction.json` from the parts that units wrote.

    python -m experiments.tables

Means and standard errors are over objects, an object's errors by several trainings meaned first;
`all` is the mean over object classes with equal weights. Medians and 95th percentiles are over all
predictions, of each object by each training. A part whose hash is not its unit's is refused; the
sets of ten times the size need not be here, if their parts agree (see `data_of`).
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from affordlib.commands import command
from affordlib.evaluation.predictions import calibration, final_error, yaw_error
from affordlib.results import write_results
from experiments import reported
from experiments.grasps import grasp_rows, roc_rows, threshold_rows
from experiments.pooled import Part, by_model, data_of, pool, read_parts
from experiments.studies import FOLDER as STUDIES_FOLDER
from experiments.studies import STUDIES, read_study
from experiments.units import NETWORKS, PARTS, Unit

NAME = "effect_prediction"
KNOWS = {
    "constant": "direction of the action, where it has one",
    "nearest": "true size, yaw and family, direction of the action",
    "gaussian_process": "true size, yaw and family, direction of the action",
    "logistic": "true size",
}
PLANE = ("push", "drag")


def error_rows(parts: list[tuple[Unit, Part]], data: str, test: str) -> list[dict[str, Any]]:
    """Rows of final, trajectory and yaw errors; test: "fold_test" or "fixed_test"."""

    def final(told: dict) -> Any:
        return told["final_error"] if "final_error" in told else final_error(told)

    def yaw(told: dict) -> Any:
        return told["yaw_error"] if "yaw_error" in told else yaw_error(told)

    unit = "m" if data in PLANE else "rad"
    first = "final_error" if data in PLANE else "error"
    rows = []
    for about, group in by_model(parts, data):
        told = [part[test] for part in group if test in part]
        if not told:
            continue
        pooled = {first: pool(told, final)}
        pooled |= {name: pool(told, name) for name in ("trajectory_error", "after_contact_error")}
        turned = pool(told, yaw) if data == "push" and yaw(told[0]) is not None else None
        for name in ("all", *sorted(set(pooled[first].classes))):
            row = about | {"object_class": name, "n": pooled[first].count(name)}
            row |= pooled[first].columns(first, unit, name)
            each = [pool([t], final) for t in told]
            each = [fold.mean_sem(name)[0] for fold in each if name in ("all", *fold.classes)]
            row[f"trainings_sd_{unit}"] = float(np.std(each, ddof=1)) if len(each) > 1 else None
            for key in ("trajectory_error", "after_contact_error"):
                row[f"{key}_mean_{unit}"] = pooled[key].mean_sem(name)[0]
            if data == "push":
                box = name == "cuboid" and turned is not None
                row["yaw_error_mean_rad"] = turned.mean_sem(name)[0] if box else None
                row["yaw_error_median_rad"] = float(np.median(turned.of(name))) if box else None
            rows.append(row)
    return rows


def inverse_rows(parts: list[tuple[Unit, Part]]) -> list[dict[str, Any]]:
    """Pushes decoded from wanted effects and carried out."""
    rows = []
    for about, group in by_model(parts, "push"):
        group = [part for part in group if "inverse" in part]
        if not group:
            continue
        told = [part["inverse"] for part in group]
        error, theta, yaw = (pool(told, f"{name}_error") for name in ("final", "theta", "yaw"))
        for name in ("all", *sorted(set(error.classes))):
            row = about | {"object_class": name, "n": error.count(name)}
            row |= error.columns("final_error", "m", name)
            row["theta_error_mean_rad"] = theta.mean_sem(name)[0]
            box = name == "cuboid"
            row["yaw_error_mean_rad"] = yaw.mean_sem(name)[0] if box else None
            rows.append(row)
    return rows


def calibration_table(parts: list[tuple[Unit, Part]]) -> list[dict[str, Any]]:
    """Coverage and likelihood at t = 1 by channel: folds together, and on the fixed test set."""
    rows = []
    for data in ("push", "drag", "grasp", "rotate"):
        for about, group in by_model(parts, data):
            told = [part["fold_test"] for part in group]
            if "std" not in told[0]:
                continue
            about = {"data": data, **about}
            together = {
                kind: {c: [v for t in told for v in t[kind][c]] for c in told[0]["std"]}
                for kind in ("truth", "mean", "std")
            }
            rows += [about | {"test": "folds"} | row for row in calibration(together)]
            fixed = [part["fixed_test"]["calibration"] for part in group if "fixed_test" in part]
            for channel in zip(*fixed, strict=True):
                mean = {
                    key: float(np.mean([row[key] for row in channel]))
                    for key in ("coverage_50", "coverage_90", "std_mean", "nll")
                }
                first = {key: channel[0][key] for key in ("channel", "n")}
                rows.append(about | {"test": "push_test"} | first | mean)
    return rows


def baseline_rows(tables: dict[str, list[dict[str, Any]]]) -> list[dict[str, Any]]:
    """What each baseline knows and how it does, beside the networks, all classes together."""
    rows = []
    for data in ("push", "drag", "rotate"):
        key = "final_error_mean_m" if data in PLANE else "error_mean_rad"
        for row in tables[data]:
            if row["object_class"] == "all":
                about = {"data": data, "model": row["model"], "folds": row["folds"], "n": row["n"]}
                about["knows"] = KNOWS.get(row["model"], "image, action at t = 0 and t = 1")
                about["error_mean_m"] = row[key] if data in PLANE else None
                about["error_mean_rad"] = None if data in PLANE else row[key]
                rows.append(about)
    return rows


def assemble(
    folder: str | Path = PARTS,
    out_dir: str | Path = "data/results",
    studies: str | Path = STUDIES_FOLDER,
) -> Path:
    """Write `effect_prediction.json` from all parts and studies of two folders; returns its path.

    A study that was not made has no table; one of other data or settings raises ValueError.
    """
    parts = read_parts(folder)
    if not parts:
        raise FileNotFoundError(f"folder: there are no parts in {folder}; run units first")
    grasps = grasp_rows(parts)
    tables = {
        "push": error_rows(parts, "push", "fold_test"),
        "push_test": error_rows(parts, "push", "fixed_test"),
        "drag": error_rows(parts, "drag", "fold_test"),
        "grasp": [*reported.grasp_rows(grasps[0]), *grasps] if grasps else [],
        "grasp_threshold": threshold_rows(parts),
        "grasp_roc": roc_rows(parts),
        "rotate": error_rows(parts, "rotate", "fold_test"),
        "inverse": inverse_rows(parts),
        "calibration": calibration_table(parts),
    }
    tables["baselines"] = baseline_rows(tables)
    tables["frames"] = frame_rows(parts)
    tables["ensemble"] = ensemble_rows(parts)
    made = {name: read_study(name, studies) for name in STUDIES if STUDIES[name].of == NAME}
    tables |= {name: rows for name, rows in made.items() if rows is not None}
    trained = sum(unit.model in NETWORKS for unit, _ in parts)
    parameters = {"units": len(parts), "trained": trained, "data_sha256": data_of(parts)}
    return write_results(out_dir, NAME, parameters, tables)


FRAMES = {
    "paper": ("paper", "table"),
    "paper_push_frame": ("paper", "push"),
    "film_table_frame": ("film", "table"),
    "film": ("film", "push"),
}


def of_shared_folds(
    parts: list[tuple[Unit, Part]], models: Iterable[str]
) -> list[tuple[Unit, Part]]:
    """The parts of some models of pushes, of the folds and seeds that all of them have."""
    every = [(u, p) for u, p in parts if u.model in models and u.data == "push" and u.n == "all"]
    shared = set.intersection(
        *({(u.fold, u.seed) for u, _ in every if u.model == model} for model in models)
    )
    return [(u, p) for u, p in every if (u.fold, u.seed) in shared]


def frame_rows(parts: list[tuple[Unit, Part]]) -> list[dict[str, Any]]:
    """Two networks in two frames, from the same folds of the same pushes, on the fixed test set."""
    told = []
    for row in error_rows(of_shared_folds(parts, FRAMES), "push", "fixed_test"):
        network, frame = FRAMES[row["model"]]
        told.append({"network": network, "frame": frame} | row)
    return told


def ensemble_rows(parts: list[tuple[Unit, Part]]) -> list[dict[str, Any]]:
    """One network and several as one, on the fixed test set: errors, and calibration of (x, y)."""
    both = of_shared_folds(parts, ("film", "ensemble"))
    calibrated = {}
    for about, group in by_model(both, "push"):
        of_plane = [
            row
            for part in group
            for row in part["fixed_test"]["calibration"]
            if row["channel"] in ("x", "y")
        ]
        keys = ("coverage_50", "coverage_90", "nll")
        calibrated[about["model"]] = {k: float(np.mean([r[k] for r in of_plane])) for k in keys}
    return [row | calibrated[row["model"]] for row in error_rows(both, "push", "fixed_test")]


@command(OSError, ValueError)
def main(argv: Sequence[str] | None = None) -> int:
    """Make the tables of effect prediction from the parts that units wrote."""
    parser = argparse.ArgumentParser(prog="python -m experiments.tables", description=main.__doc__)
    parser.add_argument("--parts", default=PARTS)
    parser.add_argument("--out", default="data/results")
    parser.add_argument("--studies", default=STUDIES_FOLDER)
    options = parser.parse_args(argv)
    print(assemble(options.parts, options.out, options.studies))
    return 0


if __name__ == "__main__":
    sys.exit(main())
