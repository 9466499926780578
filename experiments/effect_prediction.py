"""`data/results/effect_prediction.json`: how well effects are predicted, cross-validated.

    python -m experiments.effect_prediction --models film,cnp --sets push --folds 3

runs the jobs that are missing, then makes the tables from all results, and from the studies of
`experiments.studies`; without options it makes the tables alone.

Means and standard errors are over objects, an object's errors by several trainings averaged first;
`all` is the mean over categories with equal weights. Medians and 95th percentiles are over all
predictions, of each object by each training.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterable, Iterator, Sequence
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from affordlib.commands import command, count_type, names_type, whole_type
from affordlib.evaluation.baselines import BASELINES
from affordlib.evaluation.predictions import calibration
from affordlib.results import write_results
from affordlib.workers import dask_client
from experiments import reported, studies
from experiments.cross_validation import (
    LARGE,
    MODELS,
    N_FOLDS,
    NETWORKS,
    PLANE,
    SETS,
    add_errors,
    job,
)
from experiments.grasps import grasp_rows, roc_rows, threshold_rows
from experiments.runner import FOLDER, Result, frame, read, run

NAME = "effect_prediction"
KNOWN_TO = dict.fromkeys(BASELINES, "size, yaw and category of the object, direction of the action")
KNOWN_TO |= {"constant": "direction of the action, where it has one", "logistic": "size"}
SAME_TRUTH = 1e-6
"""Results of one data set may differ by so much [m or rad] in the effects that were recorded: a set
collected again, by another processor, has another hash, but the same effects."""

Rows = list[dict[str, Any]]


def sorted_results(folder: str | Path = FOLDER) -> list[Result]:
    """All results in the order of sets, models, sizes, seeds and folds.

    ValueError if results are stale, or do not agree about the effects of an interaction.
    """
    results = read(NAME, job, folder)
    order = ["data", "model", "n", "seed", "fold"]
    results.sort(key=lambda r: [MODELS.index(v) if k == "model" else str(v) if k == "n" else v
                                for k, v in ((k, r[0][k]) for k in order)])  # fmt: skip
    tests = frame(results, "fold_test")
    truth = tests.filter(like="truth_").groupby([tests["data"], tests["interaction"]])
    apart = (truth.max() - truth.min()).max(axis=1)
    if apart.max() > SAME_TRUTH:
        data, number = apart.idxmax()
        raise ValueError(
            f"{NAME}: results of {data!r} differ in the effect of interaction {number}"
        )
    return results


def predictions_of(results: Iterable[Result], primitive: str, part: str) -> pd.DataFrame:
    """Test interactions of a primitive, a row each; part: `fold_test`, `fixed_test`, `inverse`."""
    results = [(about | {"n": result["n_interactions"]}, result) for about, result in results
               if about["data"].removesuffix(LARGE) == primitive]  # fmt: skip
    table = frame(results, part)
    if part == "fold_test" and len(table):
        add_errors(table, primitive)
    return table


def by_model(table: pd.DataFrame) -> Iterator[tuple[dict[str, Any], pd.DataFrame]]:
    """The rows of each model and size of set, with the columns that say which they are."""
    if table.empty:
        return
    for (_, model, n), group in table.groupby(["data", "model", "n"], sort=False):
        about = {"model": model, "n_interactions": int(n)}
        counts = {f"{key}s": group[key].nunique() for key in ("fold", "seed")}
        yield about | counts, group


def by_category(group: pd.DataFrame) -> Iterator[tuple[str, pd.DataFrame]]:
    """All rows, then those of each category."""
    yield "all", group
    yield from group.groupby("category")


def mean_sem(group: pd.DataFrame, column: str) -> tuple[float, float]:
    """Mean and standard error over objects; categories have equal weights."""
    each = []
    for _, some in group.groupby("category"):
        number, error = some["interaction"].to_numpy(), some[column].to_numpy()
        order = np.argsort(number, kind="stable")
        trainings = np.split(error[order], np.flatnonzero(np.diff(number[order])) + 1)
        each.append(np.array([errors.mean() for errors in trainings]))
    sems = [v.std(ddof=1) / np.sqrt(len(v)) if len(v) > 1 else 0.0 for v in each]
    sem = np.sqrt(np.square(sems).sum()) / len(sems)
    return float(np.mean([v.mean() for v in each])), float(sem)


def spread(group: pd.DataFrame, column: str, name: str, unit: str) -> dict[str, float]:
    """Columns of a table: mean and standard error, median, 95th percentile."""
    mean, sem = mean_sem(group, column)
    values = group[column].to_numpy()
    median, p95 = float(np.median(values)), float(np.quantile(values, 0.95))
    statistics = {"mean": mean, "sem": sem, "median": median, "p95": p95}
    return {f"{name}_{statistic}_{unit}": value for statistic, value in statistics.items()}


def error_rows(table: pd.DataFrame, primitive: str) -> Rows:
    """Rows of final, trajectory and yaw errors; the yaw only of cuboids, which others have not."""
    unit, name = ("m", "final_error") if primitive in PLANE else ("rad", "error")
    rows = []
    for about, group in by_model(table):
        yaw_predicted = "yaw_error" in group and group["yaw_error"].notna().all()
        for category, some in by_category(group):
            row = about | {"object_class": category, "n": some["interaction"].nunique()}
            row |= spread(some, "final_error", name, unit)
            each = [mean_sem(one, "final_error")[0] for _, one in some.groupby(["seed", "fold"])]
            row[f"trainings_sd_{unit}"] = float(np.std(each, ddof=1)) if len(each) > 1 else None
            for key in ("trajectory_error", "after_contact_error"):
                row[f"{key}_mean_{unit}"] = mean_sem(some, key)[0]
            if primitive == "push":
                turned = some["yaw_error"] if yaw_predicted and category == "cuboid" else None
                mean = None if turned is None else mean_sem(some, "yaw_error")[0]
                median = None if turned is None else float(np.median(turned))
                row |= {"yaw_error_mean_rad": mean, "yaw_error_median_rad": median}
            rows.append(row)
    return rows


def inverse_rows(results: list[Result]) -> Rows:
    """Pushes decoded from wanted effects, executed."""
    rows = []
    for about, group in by_model(predictions_of(results, "push", "inverse")):
        for category, some in by_category(group):
            row = about | {"object_class": category, "n": some["interaction"].nunique()}
            row |= spread(some, "final_error", "final_error", "m")
            row["theta_error_mean_rad"] = mean_sem(some, "theta_error")[0]
            cuboids = category == "cuboid"
            row["yaw_error_mean_rad"] = mean_sem(some, "yaw_error")[0] if cuboids else None
            rows.append(row)
    return rows


def calibration_rows(results: list[Result]) -> Rows:
    """Coverage and likelihood at t = 1 by channel: folds together, and on the fixed test set."""
    rows = []
    for primitive in ("push", "drag", "grasp", "rotate"):
        table = predictions_of(results, primitive, "fixed_calibration")
        fixed = {tuple(about.values()): group for about, group in by_model(table)}
        for about, group in by_model(predictions_of(results, primitive, "fold_test")):
            channels = [c for c in ("x", "y", "z", "yaw") if group.get(f"std_{c}") is not None
                        and group[f"std_{c}"].notna().all()]  # fmt: skip
            together = {k: {c: group[f"{k}_{c}"].tolist() for c in channels}
                        for k in ("truth", "mean", "std")}  # fmt: skip
            columns = {"data": primitive, **about}
            rows += [columns | {"test": "folds"} | row for row in calibration(together)]
            if tuple(about.values()) in fixed:
                rows += [columns | {"test": "push_test"} | row
                         for row in mean_calibration(fixed[tuple(about.values())])]  # fmt: skip
    return rows


def mean_calibration(group: pd.DataFrame) -> Rows:
    """The calibration of each channel, averaged over trainings."""
    rows = []
    for channel, some in group.groupby("channel", sort=False):
        keys = ("coverage_50", "coverage_90", "std_mean", "nll")
        mean = {key: float(np.mean(some[key].to_numpy())) for key in keys}
        rows.append({"channel": channel, "n": int(some["n_values"].iloc[0])} | mean)
    return rows


def baseline_rows(tables: dict[str, Rows]) -> Rows:
    """What each baseline knows and its error, beside the networks, all categories together."""
    rows = []
    for data in ("push", "drag", "rotate"):
        for row in tables[data]:
            if row["object_class"] == "all":
                about = {"data": data, **{key: row[key] for key in ("model", "folds", "n")}}
                about["knows"] = KNOWN_TO.get(row["model"], "image, action at t = 0 and t = 1")
                about["error_mean_m"] = row.get("final_error_mean_m")
                about["error_mean_rad"] = row.get("error_mean_rad")
                rows.append(about)
    return rows


FRAMES = {
    "cnp": {"network": "cnp", "frame": "table"},
    "cnp_push_frame": {"network": "cnp", "frame": "push"},
    "film_table_frame": {"network": "film", "frame": "table"},
    "film": {"network": "film", "frame": "push"},
}


def of_shared_folds(results: list[Result], models: Iterable[str]) -> list[Result]:
    """The results of some models of all pushes, of the folds and seeds that all of them have."""
    every = [r for r in results if r[0]["model"] in models and r[0]["data"] == "push"]
    every = [r for r in every if r[0]["n"] == "all"]
    folds = {model: {(a["fold"], a["seed"]) for a, _ in every if a["model"] == model}
             for model in models}  # fmt: skip
    shared = set.intersection(*folds.values())
    return [r for r in every if (r[0]["fold"], r[0]["seed"]) in shared]


def frame_rows(results: list[Result]) -> Rows:
    """Two networks in two frames, from the same folds of the same pushes, on the fixed test set."""
    table = predictions_of(of_shared_folds(results, FRAMES), "push", "fixed_test")
    rows = error_rows(table, "push")
    return [FRAMES[row["model"]] | row for row in rows]


def ensemble_rows(results: list[Result]) -> Rows:
    """One network and several as one, on the fixed test set: errors, and calibration of (x, y)."""
    both, calibrated = of_shared_folds(results, ("film", "ensemble")), {}
    for about, group in by_model(predictions_of(both, "push", "fixed_calibration")):
        plane = group[group["channel"].isin(("x", "y"))]
        keys = ("coverage_50", "coverage_90", "nll")
        calibrated[about["model"]] = {key: float(np.mean(plane[key].to_numpy())) for key in keys}
    rows = error_rows(predictions_of(both, "push", "fixed_test"), "push")
    return [row | calibrated[row["model"]] for row in rows]


def write_tables(folder: str | Path = FOLDER, out_dir: str | Path = "data/results") -> Path:
    """Write `effect_prediction.json` from the results of a folder and the studies beside them."""
    results = sorted_results(folder)
    if not results:
        raise FileNotFoundError(f"folder: there are no results in {folder}; run some jobs first")

    def errors(primitive: str, part: str) -> Rows:
        return error_rows(predictions_of(results, primitive, part), primitive)

    grasps = predictions_of(results, "grasp", "fold_test")
    grasp = grasp_rows(grasps)
    tables = {
        "push": errors("push", "fold_test"),
        "push_test": errors("push", "fixed_test"),
        "drag": errors("drag", "fold_test"),
        "grasp": [*reported.grasp_rows(grasp[0]), *grasp] if grasp else [],
        "grasp_threshold": threshold_rows(grasps),
        "grasp_roc": roc_rows(grasps),
        "rotate": errors("rotate", "fold_test"),
        "inverse": inverse_rows(results),
        "calibration": calibration_rows(results),
    }
    tables["baselines"] = baseline_rows(tables)
    tables["frames"], tables["ensemble"] = frame_rows(results), ensemble_rows(results)
    tables |= studies.tables(NAME, folder)
    trained = sum(about["model"] in NETWORKS for about, _ in results)
    return write_results(out_dir, NAME, {"jobs": len(results), "trained": trained}, tables)


@command(OSError, ValueError)
def main(argv: Sequence[str] | None = None) -> int:
    """Train and test models in folds, and make the tables; what is there is not made again."""
    parser = argparse.ArgumentParser(
        prog="python -m experiments.effect_prediction", description=main.__doc__
    )
    models, sets = (f"of {','.join(known)}" for known in (MODELS, SETS))
    parser.add_argument("--models", type=names_type(MODELS), default=[], help=models)
    parser.add_argument("--sets", type=names_type(SETS), default="push", help=sets)
    parser.add_argument("--n", type=count_type, help="interactions that are used (default: all)")
    parser.add_argument("--folds", type=whole_type(1, N_FOLDS), default=N_FOLDS, help="of the ten")
    parser.add_argument("--seeds", type=count_type, default=1)
    parser.add_argument("--raw", default=FOLDER, help="the folder of the jobs' results")
    parser.add_argument("--out", default="data/results")
    parser.add_argument("--scheduler", help="address of a Dask scheduler")
    parser.add_argument("--workers", type=count_type, default=1, help="processes of this machine")
    options = parser.parse_args(argv)
    chosen = product(options.sets, range(options.seeds), range(options.folds), options.models)
    jobs = [job(model, data, options.n or "all", fold, seed) for data, seed, fold, model in chosen]
    with dask_client(options.workers, options.scheduler) as client:
        run(jobs, NAME, client, options.raw)
    print(write_tables(options.raw, options.out))
    return 0


if __name__ == "__main__":
    sys.exit(main())
