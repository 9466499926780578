"""A study: one network for push, drag, grasp and rotate, beside a network for each of them.

The one network sees all five action channels and foresees x, y, z and yaw. Which primitive is meant
it reads from the commanded action: a push starts beside the object, a drag ends beside it, a grasp
ends high above it and a rotation turned, so a switch would tell it nothing new. It is in the frame
of the push, which for an action without a direction is the table's.

Both learn from the same training parts of the same folds and are tested on the same test parts; the
one is trained for about as many steps as the four together. Its early stopping watches the final
errors, each as a share of its primitive's usual effect, by their geometric mean: to halve any of
them counts the same. (An arithmetic mean is that of the ten grasps that a validation part holds.)
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from affordlib.evaluation.predictions import final_error, network_predictions, summary, yaw_error
from affordlib.interactions import InteractionTensors, Scaler, split_interactions
from affordlib.interactions.dataset import Symmetry, augment_by_symmetry
from affordlib.interactions.sampling import condition_on_recorded_action
from affordlib.models.checkpoint import build
from affordlib.models.film import FiLMConfig
from affordlib.models.network import EffectNetwork
from affordlib.models.training import train
from affordlib.paths import resolve_out_dir
from affordlib.primitives import Grasp
from experiments.parts import open_once
from experiments.shipped import CHECKPOINT_SPECS
from experiments.units import PARTS, TASKS, Unit, configuration_sha256, read_part, run_unit

PRIMITIVES = ("push", "drag", "grasp", "rotate")
NETWORK = FiLMConfig(
    action_channels=("x", "y", "z", "yaw", "gripper"), effect_channels=("x", "y", "z", "yaw")
)
TRAINING = replace(CHECKPOINT_SPECS["film_500"].training, steps=9600, augment=False)
MIRRORED: tuple[Symmetry, ...] = ((0, False), (0, True))
"""Of pushes and drags; turning them is nothing new in the frame of the push."""

FOLDS = 3
FORMAT = 2
"""Counts the changes of code that change the numbers without changing a setting."""

ONE_FOR_ALL, ONE_EACH = "one for all", "one each"
HALFWAY = "runs/one_for_all"
Rows = list[dict[str, Any]]
Answers = dict[str, Any]


def settings() -> dict[str, Any]:
    """All that decides the study's numbers beside its data."""
    units = [_separate(name, fold) for name in PRIMITIVES for fold in range(FOLDS)]
    return {
        "format": FORMAT,
        "network": repr(NETWORK),
        "training": repr(replace(TRAINING, device="cpu")),
        "separate": {unit.file: configuration_sha256(unit) for unit in units},
    }


def _separate(primitive: str, fold: int) -> Unit:
    return Unit("film", primitive, fold=fold)


def with_copies(arrays: InteractionTensors, primitive: str) -> InteractionTensors:
    """Interactions and what they would be under the symmetries of their primitive.

    A push and a drag are mirrored with their action; the action of a primitive without a direction
    stays, see `augment_by_symmetry`.
    """
    symmetries = TASKS[primitive].symmetries
    if symmetries is not None:
        return augment_by_symmetry(arrays, symmetries)
    first, *others = (arrays.rotated_and_mirrored(*symmetry) for symmetry in MIRRORED)
    return first.joined(*others)


def _part(primitive: str, fold: int, which: str) -> InteractionTensors:
    data = open_once(primitive)
    rows = getattr(split_interactions(data.sizes["interaction"], 0, fold), which)
    return InteractionTensors.from_dataset(
        data, rows, NETWORK.action_channels, NETWORK.effect_channels
    )


def shares(
    validation: dict[str, InteractionTensors],
) -> Callable[[EffectNetwork, InteractionTensors], torch.Tensor]:
    """A score for `train`: of the primitives' final errors, as shares of their usual effects, the
    geometric mean.
    """

    @torch.no_grad()
    def score(model: EffectNetwork, _: InteractionTensors) -> torch.Tensor:
        model.eval()
        told = []
        for primitive, arrays in validation.items():
            kept = [NETWORK.effect_channels.index(c) for c in TASKS[primitive].effect_channels]
            end = torch.ones(len(arrays), 1)
            mean = model.predict(
                model.encode(arrays.image), condition_on_recorded_action(arrays), end
            )
            truth = arrays.effect[:, -1, kept]
            error = (mean.effect_mean[:, 0, kept] - truth).norm(dim=-1).mean()
            told.append(error / truth.norm(dim=-1).square().mean().sqrt())
        model.train()
        return torch.stack(told).log().mean(dim=0, keepdim=True).exp()

    return score


def train_one_for_all(fold: int, halfway: Path | None = None) -> EffectNetwork:
    """The one network, trained on a fold of all four sets; halfway: see `train`, checkpoint."""
    copies = [with_copies(_part(name, fold, "train"), name) for name in PRIMITIVES]
    validation = {name: _part(name, fold, "validation") for name in PRIMITIVES}
    training = copies[0].joined(*copies[1:])
    torch.manual_seed(TRAINING.seed)
    model = build(NETWORK, Scaler.fit(training))
    first, *others = validation.values()
    everything = first.joined(*others)
    train(model, training, everything, TRAINING, False, halfway, score=shares(validation))
    return model


def of_primitive(answers: Answers, primitive: str) -> Answers:
    """Answers about the effects alone that are asked of a primitive."""
    kept = TASKS[primitive].all_effects
    return answers | {
        kind: {name: answers[kind][name] for name in kept} for kind in ("truth", "mean", "std")
    }


def _rows(
    about: dict[str, Any], errors: dict[str, list[np.ndarray]], unit: str, **right: float
) -> Rows:
    """A row of each model's errors, and by how much the one network's exceed the others'."""
    pooled = {model: np.concatenate(values) for model, values in errors.items()}
    rows = []
    for model, error in pooled.items():
        more = error - pooled[ONE_EACH] if model == ONE_FOR_ALL else None
        row: dict[str, Any] = {"model": model} | about | {"n": len(error)}
        for u in ("m", "rad"):
            told = {
                "error_mean": error.mean(),
                "error_sem": _sem(error),
                "error_median": np.median(error),
                "error_p95": np.quantile(error, 0.95),
                "more_mean": None if more is None else more.mean(),
                "more_sem": None if more is None else _sem(more),
            }
            row |= {
                f"{key}_{u}": None if u != unit or value is None else float(value)
                for key, value in told.items()
            }
        rows.append(row | {"success_right_percent": right.get(model)})
    return rows


def _sem(values: np.ndarray) -> float:
    return float(values.std(ddof=1) / np.sqrt(len(values)))


def _success_right(answers: list[Answers]) -> float:
    """Per cent of grasps of which it is rightly foreseen whether they lift, by μ_z(1) > 0.1 m."""
    lifts = [
        np.concatenate([a[kind]["z"] for a in answers]) > Grasp.success_m
        for kind in ("truth", "mean")
    ]
    return 100 * float((lifts[0] == lifts[1]).mean())


def one_for_all(parts: str | Path = PARTS, halfway: str | Path = HALFWAY) -> Rows:
    """Errors by primitive and effect; the separate networks are the units of `units.py`.

    Their parts are read, or made where they are missing. halfway: a folder for what a training
    that is broken off goes on from.
    """
    folder, halfway = resolve_out_dir(parts), resolve_out_dir(halfway)
    told: dict[str, dict[str, list[Answers]]] = {
        name: {ONE_FOR_ALL: [], ONE_EACH: []} for name in PRIMITIVES
    }
    fixed: list[tuple[Answers, Answers]] = []
    for fold in range(FOLDS):
        checkpoint = halfway / f"fold{fold}.pt"
        model = train_one_for_all(fold, checkpoint)
        checkpoint.unlink(missing_ok=True)
        for name in PRIMITIVES:
            unit, data = _separate(name, fold), open_once(name)
            run_unit(unit, folder)
            part: Answers = read_part(unit, folder) or {}
            rows = split_interactions(data.sizes["interaction"], 0, fold).test
            mine = of_primitive(network_predictions(model, data, rows), name)
            if mine["interaction"] != part["fold_test"]["interaction"]:
                raise ValueError(f"part {unit.file} was tested on other interactions; delete it")
            told[name][ONE_FOR_ALL].append(mine)
            told[name][ONE_EACH].append(part["fold_test"])
            if also := TASKS[name].also:
                other = open_once(also)
                every = np.arange(other.sizes["interaction"])
                mine = summary(of_primitive(network_predictions(model, other, every), name))
                fixed.append((mine, part["fixed_test"]))
    rows = []
    for name, answers in told.items():
        effect, unit = {"grasp": ("z", "m"), "rotate": ("yaw", "rad")}.get(name, ("x, y", "m"))
        about = {"primitive": name, "effect": effect, "test": "folds", "folds": FOLDS}
        right = {m: _success_right(a) for m, a in answers.items()} if name == "grasp" else {}
        rows += _rows(about, {m: [*map(final_error, a)] for m, a in answers.items()}, unit, **right)
        if name == "push":
            turned = {m: [*map(yaw_error, a)] for m, a in answers.items()}
            rows += _rows(about | {"effect": "yaw"}, turned, "rad")
    for effect, key, unit in (("x, y", "final_error", "m"), ("yaw", "yaw_error", "rad")):
        about = {"primitive": "push", "effect": effect, "test": "push_test", "folds": len(fixed)}
        pair = zip((ONE_FOR_ALL, ONE_EACH), zip(*fixed, strict=True), strict=True)
        # An object has one error: the mean over the networks of the folds.
        rows += _rows(about, {m: [np.mean([s[key] for s in of], axis=0)] for m, of in pair}, unit)
    return rows
