"""Cross-validated errors of effect prediction: makes `data/results/effect_prediction.json`.

    python -m experiments.effect_prediction --only model=film,cnp data=push

runs these jobs if they are missing, then makes the tables from all results and from the studies of
`experiments.studies`. A job is a model, a data set, its size, a fold and a seed. It trains on the
training part, stops early on the validation part, and predicts the effects of the test part from
the image and the commanded action at t = 0 and t = 1. Missing jobs on sets of ten times the size
require these sets, which are not shipped. Means and standard errors are over objects, after
averaging each object's errors over trainings; `all` is the mean over categories with equal weights.
Medians and 95th percentiles are over all predictions.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr
from sklearn.linear_model import LogisticRegression
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler

from affordlib.interactions import sample_mixed, split_interactions
from affordlib.interactions.dataset import valid_interactions
from affordlib.models.cnp import CNPConfig
from affordlib.models.film import FiLMConfig
from affordlib.models.training import train_model
from affordlib.primitives import Grasp
from experiments import reported, runner, studies
from experiments.baselines import BASELINES, about_objects, baseline_predictions, network_record
from experiments.lever_up import Symmetry, augment_by_symmetry
from experiments.published import PUBLISHED
from experiments.runner import FOLDER, Job, Result, Rows, frame, open_once, read, shares
from experiments.shipped import CHECKPOINT_SPECS, GRASP_SYMMETRIES, HALF_TURNS

NAME, VERSION = "effect_prediction", 2
SAME_TRUTH = 1e-6
"""Largest difference [m or rad] in recorded effects between results of one data set: a set that is
collected again on another processor has another hash, but nearly the same effects."""
N_FOLDS = 10
STEPS_ON_100 = 800  # number of training steps on the sets of 100 interactions

LARGE = "_x10"  # suffix of the names of sets of ten times the size, which are not shipped


@dataclass(frozen=True)
class Task:
    """Channels of action and effect with which models of a primitive are compared.

    all_effects: of all models except the paper's network. symmetries: of the primitive; None with a
    direction, whose training augments the data itself. test_set: a second test set.
    """

    action_channels: tuple[str, ...]
    effect_channels: tuple[str, ...]
    all_effects: tuple[str, ...]
    symmetries: tuple[Symmetry, ...] | None = None
    test_set: str | None = None


TASKS: dict[str, Task] = {
    "push": Task(("x", "y"), ("x", "y"), ("x", "y", "yaw"), test_set="push_test"),
    "drag": Task(("x", "y"), ("x", "y"), ("x", "y")),
    "grasp": Task(("z", "gripper"), ("z",), ("z",), GRASP_SYMMETRIES),
    "rotate": Task(("yaw", "gripper"), ("yaw",), ("yaw",), HALF_TURNS),
}
PLANE = ("push", "drag")  # primitives whose effect is a displacement in the table's plane

NETWORKS = {
    "cnp": (CNPConfig, "cnp_500", "table"),
    "film": (FiLMConfig, "film_500", "push"),
    "cnp_push_frame": (CNPConfig, "cnp_500", "push"),
    "film_table_frame": (FiLMConfig, "film_500", "table"),
    "cnp_published": (CNPConfig, "cnp_published", "table"),
}
"""Networks to compare: their type, the shipped checkpoint with their training, their frame."""

MODELS = (*NETWORKS, *BASELINES, "logistic")


def task_of(data: str) -> Task:
    """Return the task of a data set of either size."""
    return TASKS[data.removesuffix(LARGE)]


def network_and_training(model: str, data: str, n: int | str = "all") -> tuple[Any, ...]:
    """Return the configurations of a network and its training, those of a shipped checkpoint.

    That of FiLM is trained on the same set, if there is one; sets of 100 use fewer steps.
    """
    task, (config, checkpoint, frame) = task_of(data), NETWORKS[model]
    training = CHECKPOINT_SPECS[checkpoint].training
    if config is FiLMConfig and n == "all":
        specs = [s for s in CHECKPOINT_SPECS.values() if isinstance(s.network, FiLMConfig)]
        training = next((s.training for s in specs if s.data == data), training)
    if model == "cnp_published":
        training = replace(PUBLISHED, patience=20)
    elif task.symmetries is not None:
        steps = training.steps if data.endswith(LARGE) else STEPS_ON_100
        training, frame = replace(training, augment=False, steps=steps), "table"
    effects = task.effect_channels if config is CNPConfig else task.all_effects
    channels = {"action_channels": task.action_channels, "effect_channels": effects}
    return config(**channels, frame=frame), training


def job(model: str, data: str, n: int | str = "all", fold: int = 0, seed: int = 0) -> Job:
    """Return the job of one training and its tests; n interactions are split into ten folds."""
    task = task_of(data)
    settings = network_and_training(model, data, n) if model in NETWORKS else ()
    arguments = {"model": model, "data": data, "n": n, "fold": fold, "seed": seed}
    sets = (data, task.test_set) if task.test_set else (data,)
    return Job(cross_validate, arguments, (task, settings), sets, version=VERSION)


def cross_validate(
    model: str, data: str, n: int | str, fold: int, seed: int, resume_checkpoint: Path
) -> dict[str, Any]:
    """Return columns of predictions on the test part, errors on test_set."""
    interactions, task = open_once(data), task_of(data)
    size = interactions.sizes["interaction"] if n == "all" else int(n)
    split = split_interactions(size, seed, fold, N_FOLDS)
    result: dict[str, Any] = {"n_interactions": size}
    known = interactions, split.train
    if model in NETWORKS:
        config, training = network_and_training(model, data, n)
        sampler = CHECKPOINT_SPECS[NETWORKS[model][1]].sampler
        symmetries = task.symmetries if sampler is sample_mixed else None
        augment = partial(augment_by_symmetry, symmetries=symmetries or ())
        how = replace(training, seed=seed), config, augment, resume_checkpoint, sampler
        network, _ = train_model(interactions, split, *how)

    def predicted(test_set: xr.Dataset, rows: np.ndarray) -> dict[str, Any]:
        if model in NETWORKS:
            found = network_record(network, test_set, rows)
        elif model == "logistic":
            found = logistic_predictions(*known, test_set, rows)
        else:
            channels = task.action_channels, task.all_effects
            found = baseline_predictions(BASELINES[model], channels, *known, test_set, rows)
        return pd.json_normalize(found, sep="_").iloc[0].to_dict()  # truth_x, mean_x, std_x, …

    result["fold_test"] = predicted(interactions, split.test)
    if task.test_set:
        other = open_once(task.test_set)
        found = predicted(other, np.arange(other.sizes["interaction"]))
        add_errors(table := pd.DataFrame(found), data.removesuffix(LARGE))
        errors = table.filter(like="_error").to_dict("list").items()
        errors = {name: [float(f"{e:.4g}") for e in each] for name, each in errors}
        result["fixed_test"] = {key: found[key] for key in ("interaction", "category")} | errors
    return result


def logistic_predictions(
    data: xr.Dataset, train_on: np.ndarray, other: xr.Dataset, queried: np.ndarray
) -> dict[str, Any]:
    """Return a grasp's probability of success by object size, and the ground-truth heights."""
    known, kept = valid_interactions(data, train_on), valid_interactions(other, queried)
    lifted = data["effect"].values[known, -1, 2] > Grasp.success_m
    regression = make_pipeline(StandardScaler(), LogisticRegression())
    regression.fit(data["size"].values[known], lifted)
    probability = regression.predict_proba(other["size"].values[kept])[:, 1].tolist()
    truth = {"z": other["effect"].values[kept, -1, 2].tolist()}
    return about_objects(other, kept) | {"probability": probability, "truth": truth}


def add_errors(table: pd.DataFrame, primitive: str) -> None:
    """Add columns of errors at t = 1 to a table: in (x, y) [m], or in z or yaw; and in yaw."""
    names = [name.removeprefix("mean_") for name in table if name.startswith("mean_")]
    off = {name: table[f"mean_{name}"] - table[f"truth_{name}"] for name in names}
    if primitive in PLANE:
        table["final_error"] = np.hypot(off["x"], off["y"])
    else:
        table["final_error"] = abs(off.get(TASKS[primitive].effect_channels[0], np.nan))
    if "yaw" in off:
        table["yaw_error"] = abs((off["yaw"] + np.pi) % (2 * np.pi) - np.pi)


def by_model(table: pd.DataFrame) -> Iterator[tuple[dict[str, Any], pd.DataFrame]]:
    """Yield the rows of each model and set size, with the columns that identify them."""
    for (_, model, n), group in table.groupby(["data", "model", "n"], sort=False):
        about = {"model": model, "n_interactions": int(n)}
        counts = {f"{key}s": group[key].nunique() for key in ("fold", "seed")}
        yield about | counts, group


def sorted_results(folder: str | Path = FOLDER) -> list[Result]:
    """Return all results in order; raises ValueError if effects of an interaction differ."""
    results = read(NAME, job, folder)
    results.sort(key=lambda r: (r[0]["data"], MODELS.index(r[0]["model"]),
                                str(r[0]["n"]), r[0]["seed"], r[0]["fold"]))  # fmt: skip
    tests = frame(results, "fold_test")
    truth = tests.filter(like="truth_").groupby([tests["data"], tests["interaction"]])
    apart = (truth.max() - truth.min()).max(axis=1)
    if apart.max() > SAME_TRUTH:
        data, number = apart.idxmax()
        raise ValueError(f"{NAME}: results of {data!r} differ in effects of interaction {number}")
    return results


def predictions_of(results: Iterable[Result], primitive: str, part: str) -> pd.DataFrame:
    """Return a row per test interaction; part: `fold_test` or `fixed_test`."""
    results = [(about | {"n": result["n_interactions"]}, result) for about, result in results
               if about["data"].removesuffix(LARGE) == primitive]  # fmt: skip
    table = frame(results, part)
    if part == "fold_test":
        add_errors(table, primitive)
    return table


def mean_sem(group: pd.DataFrame, column: str) -> tuple[float, float]:
    """Return mean and standard error over objects, with equal weights for all categories."""
    objects = group.groupby(["category", "interaction"])[column].mean()
    each = objects.groupby("category")
    sems = each.sem().fillna(0)
    return float(each.mean().mean()), float(np.sqrt(sems.pow(2).sum()) / len(sems))


def error_rows(table: pd.DataFrame, primitive: str) -> Rows:
    """Return rows of errors by model and category."""
    unit, name = ("m", "final_error") if primitive in PLANE else ("rad", "error")
    rows = []
    for about, group in by_model(table):
        for category, some in [("all", group), *group.groupby("category")]:
            row = about | {"object_class": category, "n": some["interaction"].nunique()}
            found = *mean_sem(some, "final_error"), *some["final_error"].quantile([0.5, 0.95])
            for what, value in zip(("mean", "sem", "median", "p95"), found, strict=True):
                row[f"{name}_{what}_{unit}"] = float(value)
            row[f"trajectory_error_mean_{unit}"] = mean_sem(some, "trajectory_error")[0]
            rows.append(row)
    return rows


def grasp_rows(grasps: pd.DataFrame) -> Rows:
    """Return the paper's Table 2: success, true or predicted, is a height above 0.1 m at t = 1."""
    rows = []
    for about, group in by_model(grasps):
        known = about["model"] != "logistic"
        lifts = group["mean_z"] > Grasp.success_m if known else group["probability"] > 0.5
        group = group.assign(predicted=lifts, lifted=group["truth_z"] > Grasp.success_m)
        for rollable, some in group.groupby("rollable"):
            row = about | {"rollable": bool(rollable), "n": len(some)}
            row["error_mean_m"] = float(some["final_error"].mean()) if known else None
            rows.append(row | confusion_columns(*some[["predicted", "lifted"]].to_numpy().T))
    return rows


def confusion_columns(predicted: np.ndarray, lifted: np.ndarray) -> dict[str, Any]:
    """Return TP and TN, shares [%] of successes and of failures that are predicted."""
    columns: dict[str, Any] = {}
    for rate, those in (("tp", lifted), ("tn", ~lifted)):
        n, k = int(those.sum()), int((predicted == lifted)[those].sum())
        names = (f"{rate}{end}_percent" for end in ("", "_low", "_high"))
        columns |= zip(names, shares(k, n), strict=True)
    return columns | {"n_success": int(lifted.sum()), "n_failure": int((~lifted).sum())}


def tables(folder: str | Path = FOLDER) -> dict[str, Rows]:
    """Return all tables from the results in a folder and the studies beside them."""
    results = sorted_results(folder)

    def errors(primitive: str, part: str) -> Rows:
        return error_rows(predictions_of(results, primitive, part), primitive)

    grasp = grasp_rows(predictions_of(results, "grasp", "fold_test"))
    return {
        "push": errors("push", "fold_test"),
        "push_test": errors("push", "fixed_test"),
        "drag": errors("drag", "fold_test"),
        "grasp": [*reported.grasp_rows(grasp[0]), *grasp],
        "rotate": errors("rotate", "fold_test"),
        **studies.tables(folder),
    }


COMPARED = (
    (("film", "cnp", *BASELINES), TASKS, range(10)),
    (("logistic",), ["grasp"], range(10)),
    (("film_table_frame",), ["push"], range(10)),
    (("cnp_push_frame",), ["push"], range(8)),
    (("film", "cnp", "logistic", *BASELINES), ["grasp_x10"], range(10)),
    (BASELINES, ["rotate_x10"], range(10)),
    (("film",), ["rotate_x10"], range(3)),
    (("cnp_published",), ["grasp"], [0]),
)
"""Models, data sets and folds of the tables."""

JOBS = [job(model, data, fold=fold) for those in COMPARED for model, data, fold in product(*those)]
JOBS += [
    job(model, data, seed=seed)
    for model in ("film", "cnp", "constant", "nearest")
    for data, seed in product(("push_x10", "drag_x10"), range(3))
]
JOBS += [job(model, "push_x10", 1500) for model in ("constant", "nearest")]

main = runner.command_of(NAME, __doc__, lambda: JOBS, tables)

if __name__ == "__main__":
    raise SystemExit(main())
