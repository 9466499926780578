"""A study: one shared network for push, drag, grasp and rotate, compared with one network each.

The shared network observes all five action channels and predicts x, y, z and yaw. The commanded
action identifies the primitive: a push starts beside the object, a drag ends beside it, a grasp
ends high above it and a rotation ends rotated. The network works in the push frame, which is the
table's frame for actions without a direction.

Both are trained on the same training parts of the same folds and tested on the same test parts; the
shared one is trained for about as many steps as the four together. Its early stopping uses the
geometric mean of the final errors, each divided by its primitive's RMS effect, so that halving any
of them counts the same (an arithmetic mean is dominated by the validation part's ten grasps).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch

from affordlib.interactions import InteractionTensors, split_interactions
from affordlib.interactions.dataset import Symmetry, augment_by_symmetry
from affordlib.models.base import EffectNetwork
from affordlib.models.calibration import effects_at
from affordlib.models.film import FiLMConfig
from affordlib.models.predictions import error_row, network_predictions
from affordlib.models.training import train, untrained
from experiments.cross_validation import TASKS, add_errors, job, prediction_columns
from experiments.runner import Rows, open_once, plain, run, study
from experiments.shipped import CHECKPOINT_SPECS

PRIMITIVES = ("push", "drag", "grasp", "rotate")
NETWORK = FiLMConfig(
    action_channels=("x", "y", "z", "yaw", "gripper"), effect_channels=("x", "y", "z", "yaw")
)
TRAINING = replace(CHECKPOINT_SPECS["film_500"].training, steps=9600, augment=False)
MIRRORED: tuple[Symmetry, ...] = ((0, False), (0, True))
"""Symmetries of pushes and drags; rotations add no new data in the push frame."""

FOLDS = 3
SEPARATE_JOBS = {
    name: [job("film", name, fold=fold) for fold in range(FOLDS)] for name in PRIMITIVES
}
SHARED, SEPARATE = "shared network", "separate networks"


def with_copies(arrays: InteractionTensors, primitive: str) -> InteractionTensors:
    """Augment interactions by the symmetries of their primitive.

    Pushes and drags are mirrored with their actions; the action of a primitive without a direction
    is unchanged (see `augment_by_symmetry`).
    """
    symmetries = TASKS[primitive].symmetries
    if symmetries is not None:
        return augment_by_symmetry(arrays, symmetries)
    first, *others = (arrays.rotated_and_mirrored(*symmetry) for symmetry in MIRRORED)
    return first.joined(*others)


def _part(primitive: str, fold: int, part: str) -> InteractionTensors:
    data = open_once(primitive)
    rows = getattr(split_interactions(data.sizes["interaction"], 0, fold), part)
    return InteractionTensors.from_dataset(
        data, rows, NETWORK.action_channels, NETWORK.effect_channels
    )


def shares(
    validation: dict[str, InteractionTensors],
) -> Callable[[EffectNetwork, InteractionTensors], torch.Tensor]:
    """Return a score for `train`: geometric mean of errors relative to a primitive's RMS effect."""

    @torch.no_grad()
    def score(model: EffectNetwork, _: InteractionTensors) -> torch.Tensor:
        model.eval()
        relative = []
        for primitive, arrays in validation.items():
            kept = [NETWORK.effect_channels.index(c) for c in TASKS[primitive].effect_channels]
            truth, mean, _ = (v[:, 0, kept] for v in effects_at(model, arrays, (1.0,)))
            error = (mean - truth).norm(dim=-1).mean()
            relative.append(error / truth.norm(dim=-1).square().mean().sqrt())
        model.train()
        return torch.stack(relative).log().mean(dim=0, keepdim=True).exp()

    return score


def train_shared(fold: int, resume_checkpoint: Path | None = None) -> EffectNetwork:
    """Train the shared network on a fold of all four sets."""
    copies = [with_copies(_part(name, fold, "train"), name) for name in PRIMITIVES]
    validation = {name: _part(name, fold, "validation") for name in PRIMITIVES}
    training = copies[0].joined(*copies[1:])
    model = untrained(NETWORK, training, TRAINING.seed)
    first, *others = validation.values()
    everything = first.joined(*others)
    train(model, training, everything, TRAINING, resume_checkpoint, score=shares(validation))
    return model


_SEPARATE = [j.settings for jobs in SEPARATE_JOBS.values() for j in jobs]


@study(*PRIMITIVES, "push_test", settings=(NETWORK, TRAINING, _SEPARATE))
def shared_network(resume_checkpoint: Path) -> Rows:
    """Return errors by primitive and effect; separate networks are jobs of `cross_validation`."""
    tests: dict[tuple[str, str], list[pd.DataFrame]] = {}
    for fold in range(FOLDS):
        path = resume_checkpoint.with_name(f"{resume_checkpoint.name}{fold}")
        model = train_shared(fold, path)
        for name in PRIMITIVES:
            (result,) = run([SEPARATE_JOBS[name][fold]], "effect_prediction", progress=False)
            data = open_once(name)
            rows = split_interactions(data.sizes["interaction"], 0, fold).test
            pair = _pair(model, name, data, rows, result["fold_test"])
            tests.setdefault((name, "folds"), []).append(pair)
            if test_set := TASKS[name].test_set:
                other = open_once(test_set)
                rows = np.arange(other.sizes["interaction"])
                pair = _pair(model, name, other, rows, result["fixed_test"])
                tests.setdefault((name, test_set), []).append(pair)
    rows = []
    for (name, test), pairs in tests.items():
        table = pd.concat(pairs)
        if test != "folds":  # an object's error is the mean over the networks of the folds
            table = table.groupby(["model", "interaction"], sort=False).mean(numeric_only=True)
            table = table.reset_index()
        effect, unit = {"grasp": ("z", "m"), "rotate": ("yaw", "rad")}.get(name, ("x, y", "m"))
        about = {"primitive": name, "effect": effect, "test": test, "folds": len(pairs)}
        rows += _rows(table, "final_error", about, unit)
        if name == "push":
            rows += _rows(table, "yaw_error", about | {"effect": "yaw"}, "rad")
    return plain(rows)


def _pair(
    model: EffectNetwork, primitive: str, data: Any, rows: np.ndarray, separate: dict[str, Any]
) -> pd.DataFrame:
    """Return errors of both networks on the same interactions, in two blocks of rows."""
    shared = pd.DataFrame(prediction_columns(network_predictions(model, data, rows)))
    add_errors(shared, primitive)
    alone = pd.DataFrame(separate)
    if "final_error" not in alone:
        add_errors(alone, primitive)
    if shared["interaction"].tolist() != alone["interaction"].tolist():
        raise ValueError(f"{primitive}: the separate network was tested on other interactions")
    return pd.concat([shared.assign(model=SHARED), alone.assign(model=SEPARATE)])


def _rows(table: pd.DataFrame, column: str, about: dict[str, Any], unit: str) -> Rows:
    """Return a row of errors per model, with the difference of the shared network to the others."""
    error = {model: group[column].to_numpy() for model, group in table.groupby("model")}
    more = error_row(error[SHARED] - error[SEPARATE])
    about |= {"n": more["n"]}
    rows = [
        {"model": model, **about, f"error_mean_{unit}": float(error[model].mean())}
        for model in (SHARED, SEPARATE)
    ]
    rows[0] |= {f"more_{name}_{unit}": more[f"{name}_m"] for name in ("mean", "sem")}
    return rows
