"""Cross-validation of effect prediction: jobs that train and test on one fold.

A job is a model, a data set, its size, a fold and a seed. It trains on the training part, stops
early on the validation part, and predicts the effects of the test part from the image and the
commanded action at t = 0 and t = 1. `experiments.effect_prediction` runs the jobs and makes the
tables.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
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
from experiments.baselines import BASELINES, about_objects, baseline_predictions, network_record
from experiments.lever_training import Symmetry, augment_by_symmetry
from experiments.published import PUBLISHED
from experiments.runner import Job, open_once
from experiments.shipped import CHECKPOINT_SPECS, GRASP_SYMMETRIES, HALF_TURNS

VERSION = 2
N_FOLDS = 10
STEPS_ON_100 = 800  # number of training steps on the sets of 100 interactions

LARGE = "_x10"  # suffix of the names of sets of ten times the size, which are not shipped


@dataclass(frozen=True)
class Task:
    """Channels of action and effect with which models of a primitive are compared.

    all_effects: effect channels of all models except the paper's network.
    symmetries: (quarter turns, mirrored) under which the primitive is invariant; None for those
    with a direction, whose training augments the data itself. test_set: a second test set.
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

    FiLM uses the checkpoint trained on the same set, if there is one; the sets of 100 grasps and
    100 rotations use fewer steps.
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
    probability = regression.predict_proba(other["size"].values[kept])[:, 1]
    height = other["effect"].values[kept, -1, 2].tolist()
    record = about_objects(other, kept) | {"probability": probability.tolist()}
    return record | {"truth": {"z": height}}


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
