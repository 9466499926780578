"""`data/results/effect_prediction.json`: how well effects are predicted, cross-validated.

    python -m experiments.effect_prediction --models film,cnp --sets push --folds 3

runs the jobs that are missing, then makes the tables from all results, and from the studies of
`experiments.studies`; without options it makes the tables alone.

Means and standard errors are over objects, an object's errors by several trainings averaged first;
`all` is the mean over categories with equal weights. Medians and 95th percentiles are over all
predictions, of each object by each training.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable, Sequence
from itertools import product
from pathlib import Path

import numpy as np
import pandas as pd

from affordlib.commands import command, count_type, names_type, whole_type
from affordlib.evaluation.predictions import calibration
from affordlib.results import write_results
from experiments import reported, runner, studies
from experiments.cross_validation import (
    LARGE,
    MODELS,
    N_FOLDS,
    NETWORKS,
    PLANE,
    SETS,
    TASKS,
    add_errors,
    by_model,
    job,
)
from experiments.grasps import grasp_rows, roc_rows, threshold_rows
from experiments.runner import FOLDER, Result, Rows, frame, read

NAME = "effect_prediction"
SAME_TRUTH = 1e-6
"""Results of one data set may differ by so much [m or rad] in the effects that were recorded: a set
collected again, by another processor, has another hash, but the same effects."""

CALIBRATION = ["coverage_50", "coverage_90", "std_mean", "nll"]


def sorted_results(folder: str | Path = FOLDER) -> list[Result]:
    """All results in the order of sets, models, sizes, seeds and folds.

    ValueError if results are stale, or do not agree about the effects of an interaction.
    """
    results = read(NAME, job, folder)
    results.sort(key=lambda r: (r[0]["data"], MODELS.index(r[0]["model"]),
                                str(r[0]["n"]), r[0]["seed"], r[0]["fold"]))  # fmt: skip
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


def mean_sem(group: pd.DataFrame, column: str) -> tuple[float, float]:
    """Mean and standard error over objects; categories have equal weights."""
    objects = group.groupby(["category", "interaction"])[column].mean()
    each = objects.groupby("category")
    sems = each.sem().fillna(0)
    return float(each.mean().mean()), float(np.sqrt(sems.pow(2).sum()) / len(sems))


def error_rows(table: pd.DataFrame, primitive: str) -> Rows:
    """Rows of errors by model and category; the yaw only of cuboids, which others have not.

    table: of predictions, or of decoded pushes that were executed, which have an error in θ.
    """
    unit, name = ("m", "final_error") if primitive in PLANE else ("rad", "error")
    rows = []
    for about, group in by_model(table):
        yaw_predicted = "yaw_error" in group and group["yaw_error"].notna().all()
        for category, some in [("all", group), *group.groupby("category")]:
            row = about | {"object_class": category, "n": some["interaction"].nunique()}
            mean, sem = mean_sem(some, "final_error")
            median, p95 = some["final_error"].quantile([0.5, 0.95])
            for told, value in (("mean", mean), ("sem", sem), ("median", median), ("p95", p95)):
                row[f"{name}_{told}_{unit}"] = float(value)
            if "theta_error" in some:
                row["theta_error_mean_rad"] = mean_sem(some, "theta_error")[0]
            else:
                each = [mean_sem(v, "final_error")[0] for _, v in some.groupby(["seed", "fold"])]
                row[f"trainings_sd_{unit}"] = float(np.std(each, ddof=1)) if each[1:] else None
                for key in ("trajectory_error", "after_contact_error"):
                    row[f"{key}_mean_{unit}"] = mean_sem(some, key)[0]
            if primitive == "push":
                turns = yaw_predicted and category == "cuboid"
                row["yaw_error_mean_rad"] = mean_sem(some, "yaw_error")[0] if turns else None
            rows.append(row)
    return rows


def calibration_rows(results: list[Result]) -> Rows:
    """Coverage and likelihood at t = 1 by channel: folds together, and on the fixed test set."""
    rows = []
    for primitive in TASKS:
        table = predictions_of(results, primitive, "fixed_calibration")
        fixed = {tuple(about.values()): group for about, group in by_model(table)}
        for about, group in by_model(predictions_of(results, primitive, "fold_test")):
            channels = [c[4:] for c in group.filter(like="std_") if group[c].notna().all()]
            together = {k: {c: group[f"{k}_{c}"].tolist() for c in channels}
                        for k in ("truth", "mean", "std")}  # fmt: skip
            columns = {"data": primitive, **about}
            rows += [columns | {"test": "folds"} | row for row in calibration(together)]
            if (trainings := fixed.get(tuple(about.values()))) is not None:
                for channel, some in trainings.groupby("channel", sort=False):
                    test = {
                        "test": "push_test",
                        "channel": channel,
                        "n": int(some["n_values"].max()),
                    }
                    rows.append(columns | test | some[CALIBRATION].mean().to_dict())
    return rows


FRAMES = {
    "cnp": {"network": "cnp", "frame": "table"},
    "cnp_push_frame": {"network": "cnp", "frame": "push"},
    "film_table_frame": {"network": "film", "frame": "table"},
    "film": {"network": "film", "frame": "push"},
}


def of_shared_folds(results: list[Result], models: Iterable[str], part: str) -> pd.DataFrame:
    """Tests of some models of all pushes, of the folds and seeds that all of them have."""
    folds: dict[str, dict[tuple[int, int], Result]] = {m: {} for m in MODELS if m in models}
    for about, result in results:
        if about["model"] in folds and (about["data"], about["n"]) == ("push", "all"):
            folds[about["model"]][about["fold"], about["seed"]] = about, result
    shared = set.intersection(*map(set, folds.values()))
    every = [of[key] for of in folds.values() for key in of if key in shared]
    return predictions_of(every, "push", part)


def frame_rows(results: list[Result]) -> Rows:
    """Two networks in two frames, from the same folds of the same pushes, on the fixed test set."""
    rows = error_rows(of_shared_folds(results, FRAMES, "fixed_test"), "push")
    return [FRAMES[row["model"]] | row for row in rows]


def ensemble_rows(results: list[Result]) -> Rows:
    """One network and several as one, on the fixed test set: errors, and calibration of (x, y)."""
    both = "film", "ensemble"
    plane = of_shared_folds(results, both, "fixed_calibration").query("channel in ('x', 'y')")
    calibrated = plane.groupby("model")[["coverage_50", "coverage_90", "nll"]].mean()
    rows = error_rows(of_shared_folds(results, both, "fixed_test"), "push")
    return [row | calibrated.loc[row["model"]].to_dict() for row in rows]


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
        "inverse": errors("push", "inverse"),
        "calibration": calibration_rows(results),
    }
    tables["frames"], tables["ensemble"] = frame_rows(results), ensemble_rows(results)
    tables |= studies.tables(NAME, folder)
    trained = sum(about["model"] in NETWORKS for about, _ in results)
    return write_results(out_dir, NAME, {"jobs": len(results), "trained": trained}, tables)


@command(OSError, ValueError)
def main(argv: Sequence[str] | None = None) -> int:
    """Train and test models in folds, and make the tables; what is there is not made again."""
    parser = runner.parser(NAME, main.__doc__)
    models, sets = (f"of {','.join(known)}" for known in (MODELS, SETS))
    parser.add_argument("--models", type=names_type(MODELS), default=[], help=models)
    parser.add_argument("--sets", type=names_type(SETS), default="push", help=sets)
    parser.add_argument("--n", type=count_type, help="interactions that are used (default: all)")
    parser.add_argument("--folds", type=whole_type(1, N_FOLDS), default=N_FOLDS, help="of the ten")
    parser.add_argument("--seeds", type=count_type, default=1)
    options = parser.parse_args(argv)
    chosen = product(options.sets, range(options.seeds), range(options.folds), options.models)
    jobs = [job(model, data, options.n or "all", fold, seed) for data, seed, fold, model in chosen]
    return runner.make(jobs, NAME, options, write_tables)


if __name__ == "__main__":
    sys.exit(main())
