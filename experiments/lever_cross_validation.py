"""Cross-validation of lever-ups against recurrent networks (Table 1): jobs that train and test.

The split is by object into five folds, 80/10/10 (each interaction has its own object, so it equals
the random split of Seker et al. 2019), or leaves out all objects with a given number of edges. A
job is one training, or one baseline, tested in all protocols that it is trained for. Errors are
distances [cm] between predicted and ground-truth positions, after steps of 150 ms.
`experiments.lever_up` runs the jobs and makes the tables.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import xarray as xr
from torch import Tensor

from affordlib.interactions import Scaler, Split, split_interactions
from affordlib.interactions.dataset import valid_interactions
from affordlib.interactions.recipes import Recipe, sample_scene
from affordlib.models import lever_up as models
from affordlib.models.base import EffectNetwork
from affordlib.models.domain import TrainingDomain
from affordlib.models.lever_up import PROTOCOLS, lever_up_tensors
from affordlib.types import Prediction, check_choice, check_count
from experiments import lstm_seker2019
from experiments.lever_training import (
    LEVER_MODELS,
    LeverModel,
    shipped_lever_model,
    train_lever_model,
)
from experiments.lstm_seker2019 import SekerConfig, SekerLSTM, train_seker
from experiments.runner import Job, open_once

DATA, N_FOLDS = "lever_up", 5
BASELINES = ("persistence", "constant_velocity")
RECURRENT = ("lstm_tuned", "lstm_seker2019")
EACH = ("cnp_mean", "cnp_last_pose_single", *RECURRENT)
"""Networks that are trained for one protocol at a time."""

SINGLE = EACH[1]
"""Name of `cnp_last_pose` trained for one protocol at a time, like the recurrent networks."""

MODELS = ("cnp", "cnp_mean", "cnp_last_pose", SINGLE, "lstm_seker2019", "lstm_tuned", *BASELINES)
TESTED = {"all": PROTOCOLS, "window": PROTOCOLS[:1], "first_step": PROTOCOLS[1:]}
"""Protocols in which a network is tested, by the protocol that it is trained for."""


def job(
    model: str,
    trained_for: str = "all",
    fold: int = 0,
    edges_left_out: int | None = None,
    seed: int = 0,
    epochs: int | None = None,
) -> Job:
    """Return the job of one training and its tests.

    edges_left_out: polygons with this number of edges are only tested; epochs: `lstm_seker2019`'s.
    """
    check_choice("model", model, MODELS)
    each = model in EACH
    check_choice(f"trained_for of {model!r}", trained_for, [*TESTED][1:] if each else ["all"])
    check_count("fold", fold, 0, N_FOLDS - 1)
    if edges_left_out is not None:
        check_count("edges_left_out", edges_left_out, 3, 8)
    published = model == "lstm_seker2019"
    if (epochs is not None) != published:
        raise ValueError(f"epochs are only for 'lstm_seker2019', got {epochs!r} for {model!r}")
    settings = (SekerConfig(), lstm_seker2019.TRAINING) if published else _lever_model(model)
    arguments = {"model": model, "trained_for": trained_for, "fold": fold}
    arguments |= {"edges_left_out": edges_left_out, "seed": seed, "epochs": epochs}
    return Job(cross_validate, arguments, settings, (DATA,))


def _lever_model(model: str) -> LeverModel | None:
    return LEVER_MODELS.get("cnp_last_pose" if model == SINGLE else model)


def edges_of(data: xr.Dataset) -> np.ndarray:
    """Return the number of edges (n,) of each interaction's polygon."""
    recipe, numbers = Recipe.from_json(data.attrs["recipe"]), data["interaction"].values
    return np.array([len(sample_scene(recipe, int(i))[0].footprint_m) for i in numbers])


def lever_split(
    data: xr.Dataset, fold: int = 0, seed: int = 0, edges_left_out: int | None = None
) -> Split:
    """Split 80/10/10 in five folds with disjoint test parts, or leave out a number of edges."""
    split = split_interactions(data.sizes["interaction"], seed, 2 * fold, 2 * N_FOLDS)
    if edges_left_out is None:
        return split
    edges = edges_of(data)
    others = np.concatenate([split.train, split.test])
    return Split(
        np.sort(others[edges[others] != edges_left_out]),
        split.validation[edges[split.validation] != edges_left_out],
        np.flatnonzero(edges == edges_left_out),
    )


def cross_validate(
    model: str,
    trained_for: str,
    fold: int,
    edges_left_out: int | None,
    seed: int,
    epochs: int | None,
    resume_checkpoint: Path,
) -> dict[str, Any]:
    """Train and return the errors in all windows of all test trajectories, by protocol."""
    data, lever = open_once(DATA), _lever_model(model)
    split = lever_split(data, fold, seed, edges_left_out)
    view = lever.view if lever else "full" if model == "lstm_seker2019" else "near"
    kept = valid_interactions(data, split.test)
    result: dict[str, Any] = {"interaction": data["interaction"].values[kept].tolist()}
    network: EffectNetwork | str = model
    if model == "lstm_seker2019":
        network, told = _train_seker(data, split, trained_for, epochs, seed, resume_checkpoint)
    elif lever:
        lever = replace(lever, training=replace(lever.training, seed=seed))
        found = shipped_lever_model(model, trained_for, lever, data, split)
        network, told = found or _train(lever, data, split, trained_for, resume_checkpoint)
    if network is not model:
        result["training"] = told
    test = lever_up_tensors(data, split.test, view)
    return result | {protocol: _errors(network, test, protocol) for protocol in TESTED[trained_for]}


def _train(
    lever: LeverModel, data: xr.Dataset, split: Split, trained_for: str, path: Path
) -> tuple[EffectNetwork, dict[str, Any]]:
    network, history = train_lever_model(lever, data, split, trained_for, path)
    best = min(record.validation_error for record in history)
    told = {"steps": history[-1].step, "seconds": history[-1].seconds}
    return network, told | {"validation_error": best}


def _train_seker(
    data: xr.Dataset, split: Split, trained_for: str, epochs: int | None, seed: int, path: Path
) -> tuple[EffectNetwork, dict[str, Any]]:
    parts = [lever_up_tensors(data, part, "full") for part in (split.train, split.validation)]
    config = SekerConfig(parts[0].action_channels, parts[0].effect_channels)
    torch.manual_seed(seed)
    network = SekerLSTM(config, Scaler.fit(parts[0]), TrainingDomain.fit(parts[0]))
    epochs = epochs or lstm_seker2019.EPOCHS
    return network, train_seker(network, *parts, trained_for, epochs, seed, path)


def extrapolate(
    baseline: str, effect: Tensor, protocol: str, start: int = 0
) -> tuple[Tensor, Tensor]:
    """Return a baseline's prediction of poses from effects (N, S, C), and ground truth (N, T, C).

    With only the first step the velocity is unknown, and both baselines predict no motion.
    """
    window = protocol == "window"
    last = start + models.N_OBSERVED - 1 if window else 0
    ahead = torch.arange(1, (models.N_PREDICTED if window else effect.shape[1] - 1) + 1)
    velocity = torch.zeros_like(effect[:, last])
    if window and baseline == "constant_velocity":
        velocity = effect[:, last] - effect[:, last - 1]
    return effect[:, last, None] + ahead[:, None] * velocity[:, None], effect[:, last + ahead]


def _errors(network: EffectNetwork | str, arrays: Any, protocol: str) -> dict[str, Any]:
    """Return the errors (N, W, T) [cm] of a network or baseline, rounded to 1 µm, as lists."""
    starts = range(models.n_windows(arrays) if protocol == "window" else 1)
    if isinstance(network, str):
        found = [extrapolate(network, arrays.effect, protocol, start) for start in starts]
        found = [(Prediction(mean, mean, mean, 0 * mean), truth) for mean, truth in found]
    else:
        with torch.no_grad():
            seen = network.encode(arrays.image)
        found = [models.predict_steps(network, arrays, protocol, start, seen) for start in starts]
    errors = torch.stack([100 * models.errors_m(told, truth) for told, truth in found], dim=1)
    return {"error_cm": errors.double().numpy().round(4).tolist()}
