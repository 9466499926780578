"""Cross-validation of lever-ups against recurrent networks (Table 1): jobs that train and test.

Five folds, 80/10/10, by object (each interaction has an object of its own, so the random split of
Seker et al. 2019 is the same); or all objects with some number of edges left out of training. A job
is one training, or one baseline, tested in every protocol that it is trained for. Errors are
distances between predicted and true positions [cm], after steps of 150 ms.
`experiments.lever_up` runs jobs and makes the tables.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import xarray as xr
from torch import Tensor

from affordlib.interactions import InteractionTensors, Scaler, Split, split_interactions
from affordlib.interactions.dataset import valid_interactions
from affordlib.interactions.lever_up import (
    N_OBSERVED,
    N_PREDICTED,
    POSE_CHANNELS,
    lever_up_tensors,
    n_windows,
)
from affordlib.interactions.recipes import Recipe, sample_scene
from affordlib.models.base import EffectNetwork
from affordlib.models.calibration import LEVELS, coverage
from affordlib.models.domain import TrainingDomain
from affordlib.models.lever_up import (
    LEVER_MODELS,
    PROTOCOLS,
    TRAINED_FOR,
    errors_m,
    predict_steps,
    train_lever_model,
)
from affordlib.types import Prediction
from experiments import lstm_seker2019
from experiments.lstm_seker2019 import SekerConfig, SekerLSTM, train_seker
from experiments.runner import Job, open_once
from experiments.shipped import shipped_lever_model

DATA = "lever_up"
N_FOLDS = 5
EDGES = range(3, 9)
BASELINES = ("persistence", "constant_velocity")
RECURRENT = ("lstm_tuned", "lstm_seker2019")
SINGLE = "cnp_last_pose_single"
"""`cnp_last_pose`, trained for one protocol at a time, as the recurrent networks are."""

MODELS = ("cnp", "cnp_last_pose", SINGLE, "lstm_seker2019", "lstm_tuned", *BASELINES)


def job(
    model: str,
    trained_for: str = "all",
    fold: int = 0,
    edges_left_out: int | None = None,
    seed: int = 0,
    epochs: int | None = None,
) -> Job:
    """One training and its tests; edges_left_out: polygons with so many are only in the test.

    epochs: of `lstm_seker2019` alone.
    """
    for name, value, known in (("model", model, MODELS), ("trained_for", trained_for, TRAINED_FOR)):
        if value not in known:
            raise ValueError(f"{name} must be one of {known}, got {value!r}")
    if fold not in range(N_FOLDS):
        raise ValueError(f"fold must lie in [0, {N_FOLDS - 1}], got {fold!r}")
    if edges_left_out is not None and edges_left_out not in EDGES:
        raise ValueError(f"edges_left_out must lie in [3, 8], got {edges_left_out!r}")
    if (trained_for == "all") == (model in (SINGLE, *RECURRENT)):
        raise ValueError(
            f"trained_for: {(SINGLE, *RECURRENT)} are trained for one protocol each, the others "
            f"for all; got {trained_for!r} for {model!r}"
        )
    if (epochs is not None) != (model == "lstm_seker2019"):
        raise ValueError(f"epochs belong to 'lstm_seker2019', got {epochs!r} for {model!r}")
    settings = _lever_model(model)
    if model == "lstm_seker2019":
        settings = (SekerConfig(), lstm_seker2019.TRAINING)
    arguments = {
        "model": model,
        "trained_for": trained_for,
        "fold": fold,
        "edges_left_out": edges_left_out,
        "seed": seed,
        "epochs": epochs,
    }
    return Job(cross_validate, arguments, settings, (DATA,))


def protocols_of(trained_for: str) -> tuple[str, ...]:
    """The protocols in which a training is tested."""
    return {"all": PROTOCOLS, "window": PROTOCOLS[:1], "first_step": PROTOCOLS[1:]}[trained_for]


def _lever_model(model: str) -> Any:
    return LEVER_MODELS.get("cnp_last_pose" if model == SINGLE else model)


def edges_of(data: xr.Dataset) -> np.ndarray:
    """How many edges the polygon of each interaction has (n,)."""
    recipe = Recipe.from_json(data.attrs["recipe"])
    numbers = data["interaction"].values
    return np.array([len(sample_scene(recipe, int(i))[0].footprint_m) for i in numbers])


def lever_split(
    data: xr.Dataset, fold: int = 0, seed: int = 0, edges_left_out: int | None = None
) -> Split:
    """80/10/10 in five folds whose test parts do not overlap, or all but some edges."""
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
    """Errors of every window of every test trajectory, by protocol, and how often σ covers them."""
    data = open_once(DATA)
    split = lever_split(data, fold, seed, edges_left_out)
    lever = _lever_model(model)
    view = lever.view if lever else "full" if model == "lstm_seker2019" else "near"
    test = lever_up_tensors(data, split.test, view)
    result: dict[str, Any] = {
        "interaction": data["interaction"].values[valid_interactions(data, split.test)].tolist()
    }
    if model in BASELINES:
        predict = lambda protocol: _extrapolated(model, test, protocol)  # noqa: E731
    else:
        if lever:
            lever = replace(lever, training=replace(lever.training, seed=seed))
            found = _train(model, lever, data, split, trained_for, resume_checkpoint)
        else:
            found = _train_seker(data, split, trained_for, epochs, seed, resume_checkpoint)
        network, result["training"] = found
        predict = lambda protocol: _predicted(network, test, protocol)  # noqa: E731
    for protocol in protocols_of(trained_for):
        result[protocol] = _errors(predict(protocol))
    if model == "persistence":
        moves_cm = 100 * test.effect[..., :3].diff(dim=1).norm(dim=-1)
        result["step_moves_cm"] = _four_decimals(moves_cm)
    return result


def _train(
    model: str, lever: Any, data: xr.Dataset, split: Split, trained_for: str, path: Path
) -> tuple[EffectNetwork, dict[str, Any]]:
    """A network trained here, or the shipped checkpoint of this very training."""
    if found := shipped_lever_model(model, trained_for, lever, data, split):
        return found
    network, history = train_lever_model(lever, data, split, trained_for, path)
    best = min(record.validation_error for record in history)
    told = {"steps": history[-1].step, "seconds": history[-1].seconds}
    return network, told | {"validation_error": best}


def _train_seker(
    data: xr.Dataset, split: Split, trained_for: str, epochs: int | None, seed: int, path: Path
) -> tuple[EffectNetwork, dict[str, Any]]:
    training, validation = (
        lever_up_tensors(data, part, "full") for part in (split.train, split.validation)
    )
    channels = {f"{k}_channels": getattr(training, f"{k}_channels") for k in ("action", "effect")}
    torch.manual_seed(seed)
    scales = Scaler.fit(training), TrainingDomain.fit(training)
    network = SekerLSTM(SekerConfig(**channels), *scales)
    epochs = epochs or lstm_seker2019.EPOCHS
    return network, train_seker(network, training, validation, trained_for, epochs, seed, path)


def _starts(arrays: InteractionTensors, protocol: str) -> range:
    return range(n_windows(arrays) if protocol == "window" else 1)


def _predicted(
    model: EffectNetwork, arrays: InteractionTensors, protocol: str
) -> list[tuple[Prediction, Tensor]]:
    with torch.no_grad():
        features = model.encode(arrays.image)
    return [predict_steps(model, arrays, protocol, k, features) for k in _starts(arrays, protocol)]


def extrapolate(
    baseline: str, effect: Tensor, protocol: str, start: int = 0
) -> tuple[Tensor, Tensor]:
    """Persistence's or constant velocity's prediction of poses (N, S, C), and the truth (N, T, C).

    From the first step alone the velocity is unknown; then both predict that nothing moves.
    """
    window = protocol == "window"
    last = start + N_OBSERVED - 1 if window else 0
    n = N_PREDICTED if window else effect.shape[1] - 1
    ahead = torch.arange(1, n + 1)
    velocity = torch.zeros_like(effect[:, last])
    if window and baseline == "constant_velocity":
        velocity = effect[:, last] - effect[:, last - 1]
    mean = effect[:, last, None] + ahead[:, None] * velocity[:, None]
    return mean, effect[:, last + ahead]


def _extrapolated(
    baseline: str, arrays: InteractionTensors, protocol: str
) -> list[tuple[Prediction, Tensor]]:
    found = []
    for start in _starts(arrays, protocol):
        mean, truth = extrapolate(baseline, arrays.effect, protocol, start)
        zero = torch.zeros_like(mean)
        found.append((Prediction(zero, zero, mean, zero), truth))
    return found


def _errors(found: list[tuple[Prediction, Tensor]]) -> dict[str, Any]:
    """Errors (N, W, T) [cm] of a protocol's windows, and the coverage of σ by channel."""
    errors = torch.stack([100 * errors_m(told, truth) for told, truth in found], dim=1)
    mean, std, truth = (
        torch.cat(parts).flatten(0, 1)
        for parts in zip(*((p.effect_mean, p.effect_std, e) for p, e in found), strict=True)
    )
    covered = None
    if std.min() > 0:
        covered = {
            channel: [round(coverage(truth[:, k], mean[:, k], std[:, k], v), 4) for v in LEVELS]
            for k, channel in enumerate(POSE_CHANNELS)
        }
    return {"error_cm": _four_decimals(errors), "coverage": covered}


def _four_decimals(values_cm: Tensor) -> list[Any]:
    """Centimetres to a micrometre, as lists."""
    return values_cm.double().numpy().round(4).tolist()
