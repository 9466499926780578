"""Lever-ups against a recurrent network (Table 1 of the paper): makes `data/results/lever_up.json`.

    python -m experiments.lever_up --only model=lstm_tuned

runs these jobs if they are missing, then makes the tables from all results. The split is by object
into five folds, 80/10/10 (each interaction has its own object). A job is one training, tested in
all protocols that it is trained for: a conditional network is trained once for all, a recurrent one
for each. Errors are distances [cm] between predicted and true positions, after steps of 150 ms. A
job with a `setting` is tuning: it is scored on the validation part of fold 0. Means, standard
errors and intervals are over objects.
"""

from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
import xarray as xr
from jaxtyping import Float
from torch import Tensor

from affordlib.interactions import InteractionTensors, Split, split_interactions
from affordlib.interactions.dataset import Batch, condition_on_poses, valid_interactions
from affordlib.models import CNPConfig, EffectNetwork, NetworkConfig
from affordlib.models import lever_up as models
from affordlib.models.lever_up import N_OBSERVED, N_PREDICTED, PROTOCOLS, lever_up_tensors
from affordlib.models.training import TrainingConfig, TrainingRecord, train, untrained
from experiments import reported, runner
from experiments.last_pose import CNPAroundMeanConfig, LastPoseConfig
from experiments.lstm import LSTMConfig
from experiments.published import PUBLISHED, ConstantRate, one_at_a_time
from experiments.runner import FOLDER, Job, Result, Rows, interval, open_once, plain, read

NAME, DATA, N_FOLDS = "lever_up", "lever_up", 5
OURS, SINGLE, RECURRENT = "cnp_last_pose", "cnp_last_pose_single", "lstm_tuned"
"""Our network, the same trained for one protocol at a time, and the recurrent one."""

MODELS = ("cnp", "cnp_published", "cnp_tuned", OURS, SINGLE, RECURRENT)
EACH = {
    **dict.fromkeys(("cnp_published", "cnp_tuned"), ("window",)),
    **dict.fromkeys((SINGLE, RECURRENT), ("window", "first_step")),
}
"""Networks that are trained for one protocol at a time, and these protocols."""

Symmetry = tuple[int, bool]  # the number of rotations by π/2, and whether y is mirrored first


def from_start_errors_m(model: EffectNetwork, tensors: InteractionTensors) -> Float[Tensor, "n t"]:
    """Errors [m] at all steps after the first, given only the image and the action."""
    return models.errors_m(*models.predict_steps(model, tensors, "image_only"))


def augment_by_symmetry(
    arrays: InteractionTensors, symmetries: tuple[Symmetry, ...]
) -> InteractionTensors:
    """Rotate and mirror images and effects, but not actions, of a primitive without direction."""
    parts = [replace(arrays.rotated_and_mirrored(*s), action=arrays.action) for s in symmetries]
    return parts[0].joined(*parts[1:]) if parts else arrays


TRAINING = TrainingConfig(
    steps=1000, n_targets=N_PREDICTED, obs_max=N_OBSERVED, patience=99, beta=0.5, weight_decay=0.1,
    final_sigma_floor=0.005, ema=0.99, augment=False, validate_every=125,
)  # fmt: skip
_AT = {rate: replace(TRAINING, learning_rate=rate) for rate in (2e-3, 4e-3)}


@dataclass(frozen=True)
class LeverModel:
    """A network, its training, and which part of the image it sees (see `lever_up_tensors`)."""

    network: NetworkConfig
    training: TrainingConfig = TRAINING
    view: str = "near"


_CHANNELS = {"action_channels": models.LEVER_ACTION_CHANNELS}
_CHANNELS["effect_channels"] = models.POSE_CHANNELS
_IMAGE = _CHANNELS | {"rings": 10, "orders": 12}
_LONG = replace(PUBLISHED, steps=350_000, obs_max=N_OBSERVED)
LEVER_MODELS: dict[str, LeverModel] = {
    "cnp_last_pose": LeverModel(LastPoseConfig(**_IMAGE), _AT[4e-3]),
    "cnp": LeverModel(CNPConfig(**_CHANNELS), view="wide"),
    "cnp_tuned": LeverModel(CNPAroundMeanConfig(**_CHANNELS), _AT[2e-3]),
    "cnp_published": LeverModel(CNPConfig(**_CHANNELS), _LONG, "wide"),
    "lstm_tuned": LeverModel(LSTMConfig(**_IMAGE), _AT[2e-3]),
}
"""Our network, the paper's (on 48×48 images as in its appendix), the paper's tuned, by its own
recipe, and the tuned recurrent one. But for the recipe, all train for the same number of steps, of
which those of the paper's network cost three times as much. Rates: see `SETTINGS`."""


def sample_windows(
    tensors: InteractionTensors, n_targets: int, obs_max: int, generator: torch.Generator
) -> Batch:
    """Sample windows of obs_max observed samples followed by n_targets targets."""
    latest = len(tensors.phase) - obs_max - n_targets
    start = torch.randint(0, latest + 1, (len(tensors),), generator=generator)
    target_at = start[:, None] + obs_max + torch.arange(n_targets)
    return Batch.of(tensors, condition_on_poses(tensors, start, obs_max), target_at)


def sample_from_start(
    tensors: InteractionTensors, n_targets: int, obs_max: int, generator: torch.Generator
) -> Batch:
    """Use all samples after the first as targets; observe the first pose in half of the batches."""
    n_poses = int(torch.randint(0, 2, (1,), generator=generator))
    start = torch.zeros(len(tensors), dtype=torch.long)
    target_at = torch.arange(1, len(tensors.phase))
    return Batch.of(tensors, condition_on_poses(tensors, start, n_poses), target_at)


def _sample_all(
    tensors: InteractionTensors, n_targets: int, obs_max: int, generator: torch.Generator
) -> Batch:
    kind = int(torch.randint(0, 2, (1,), generator=generator))
    return (sample_windows, sample_from_start)[kind](tensors, n_targets, obs_max, generator)


def _all_errors_m(model: EffectNetwork, tensors: InteractionTensors) -> Tensor:
    """Window and start errors at about equal weight: the latter are three times as large."""
    window, start = models.window_errors_m(model, tensors), from_start_errors_m(model, tensors)
    return window.mean(dim=(1, 2)) + start.mean(dim=1) / 3


TRAINED_FOR = {
    "all": (PROTOCOLS, _sample_all, _all_errors_m),
    "window": (PROTOCOLS[:1], sample_windows, models.window_errors_m),
    "first_step": (PROTOCOLS[1:], sample_from_start, from_start_errors_m),
}
"""Protocols in which a network is tested, sampler and score, by what it is trained for."""


def fit_lever_model(
    lever: LeverModel,
    training: InteractionTensors,
    validation: InteractionTensors,
    trained_for: str = "all",
    resume_checkpoint: Path | None = None,
) -> tuple[EffectNetwork, list[TrainingRecord]]:
    """Train a network, with as many steps as a trajectory has, for one protocol or all of them.

    The training part is joined by its mirror image, except by the paper's own recipe. Early
    stopping uses the validation errors of the protocols that it is trained for.
    """
    network, (_, sampler, score) = lever.network, TRAINED_FOR[trained_for]
    if isinstance(lever.training, ConstantRate):
        sampler = one_at_a_time
    else:
        training = augment_by_symmetry(training, ((0, False), (0, True)))
    if hasattr(network, "steps"):
        network = replace(network, steps=len(training.phase) - 1)
    model = untrained(network, training, lever.training.seed)
    how = lever.training, resume_checkpoint, sampler, score
    return model, train(model, training, validation, *how)


LEVER_CHECKPOINTS: dict[str, tuple[str, str]] = {
    "lever_up_last_pose_1800": ("cnp_last_pose", "all"),
    "lever_up_lstm_1800_window": ("lstm_tuned", "window"),
    "lever_up_lstm_1800_first_step": ("lstm_tuned", "first_step"),
}
"""Checkpoints of lever-ups: the name in `LEVER_MODELS`, and the protocol it is trained for."""

SETTINGS: dict[str, dict[str, Any]] = {
    **{f"rate {rate:g}": {"learning_rate": rate} for rate in (1e-3, 5e-4, 2e-3, 4e-3, 8e-3)},
    "rate 0.001, half the width": {},
    "rate 0.001, last weights": {"ema": 0.0},
    "rate 0.001, no weight decay": {"weight_decay": 0.0},
    "rate 0.001, plain likelihood": {"beta": 0.0},
}
"""Changes of the initial `TRAINING` by name; one halves the network's width, which the paper fixes:
for its network, another setting stands in its place. `LEVER_MODELS` has one learning rate per
network: the best, or, for the two trainings of the recurrent one, that with the least sum of both
errors, each relative to the best of its protocol."""


def lever_model(model: str, setting: str | None = None) -> LeverModel:
    """Return a network of `LEVER_MODELS`, or with a setting."""
    lever = LEVER_MODELS[OURS if model == SINGLE else model]
    if setting is None:
        return lever
    network = lever.network
    if setting.endswith("half the width"):
        network = replace(network, width=network.width // 2)
    return replace(lever, network=network, training=replace(TRAINING, **SETTINGS[setting]))


def job(model: str, trained_for: str = "all", fold: int = 0, setting: str | None = None) -> Job:
    """Return the job of one training and its tests."""
    arguments = {"model": model, "trained_for": trained_for, "fold": fold, "setting": setting}
    return Job(cross_validate, arguments, lever_model(model, setting), (DATA,))


def lever_split(data: xr.Dataset, fold: int = 0) -> Split:
    """Split 80/10/10 in five folds with disjoint test parts."""
    return split_interactions(data.sizes["interaction"], 0, 2 * fold, 2 * N_FOLDS)


def cross_validate(
    model: str, trained_for: str, fold: int, setting: str | None, resume_checkpoint: Path
) -> dict[str, Any]:
    """Return errors (N, W, T) [cm] of the test part, or with a setting mean validation errors."""
    data, lever = open_once(DATA), lever_model(model, setting)
    split = lever_split(data, fold)
    parts = split.train, split.validation, split.test
    training, validation, test = (lever_up_tensors(data, part, lever.view) for part in parts)
    network, _ = fit_lever_model(lever, training, validation, trained_for, resume_checkpoint)
    if setting is None:
        kept = data["interaction"].values[valid_interactions(data, split.test)]
        record: dict[str, Any] = {"interaction": kept.tolist()}
        for name in TRAINED_FOR[trained_for][0]:
            if name == "window":
                errors_m = models.window_errors_m(network, test)
            else:
                errors_m = models.errors_m(*models.predict_steps(network, test, name))[:, None]
            record[name] = {"error_cm": (100 * errors_m).double().numpy().round(4).tolist()}
        return record
    row: dict[str, Any] = {"n": len(validation)}
    if trained_for != "first_step":
        row["window_mean_m"] = float(models.window_errors_m(network, validation).mean())
    if trained_for != "window":
        row["beginning_mean_m"] = float(from_start_errors_m(network, validation).mean())
    return row


def _error_table(results: list[Result]) -> pd.DataFrame:
    """Return a row per tested object and step with the error [cm], averaged over windows."""
    parts = []
    for about, result in results:
        for protocol in PROTOCOLS:
            if protocol in result:
                means = pd.DataFrame(np.mean(result[protocol]["error_cm"], axis=1))
                means.columns += 1
                means = means.assign(interaction=result["interaction"], protocol=protocol, **about)
                names = [*about, "protocol", "interaction"]
                parts.append(means.melt(names, var_name="steps", value_name="error_cm"))
    table = pd.concat(parts)
    for name, order in (("protocol", PROTOCOLS), ("model", MODELS)):
        table[name] = pd.Categorical(table[name], order)
    return table


def error_rows(results: list[Result]) -> Rows:
    """Return the rows of Table 1; an object's errors are averaged over its windows."""
    keys, error = ["protocol", "model", "steps"], "error_cm"
    groups = _error_table(results).groupby(keys, observed=True)
    rows = groups.agg(
        folds=("fold", "nunique"), n=(error, "size"), mean_cm=(error, "mean"), sem_cm=(error, "sem")
    )
    return plain(rows.reset_index())


def paired_rows(results: list[Result]) -> Rows:
    """Return differences to the recurrent network, paired by object, with 95 % intervals."""
    rows: Rows = []
    errors = {
        key: of_one.pivot(index=["fold", "interaction"], columns="steps", values="error_cm")
        for key, of_one in _error_table(results).groupby(["model", "protocol"], observed=True)
    }
    for ours, protocol in [("cnp_tuned", "window"), *product((OURS, SINGLE), PROTOCOLS)]:
        gap = errors[ours, protocol] - errors[RECURRENT, protocol]
        mean, low, high = interval(gap, 2000)
        table = pd.DataFrame({"difference_cm": mean, "low_cm": low, "high_cm": high}, gap.columns)
        table.insert(0, "n", len(gap))
        about = {"ours": ours, "rival": RECURRENT, "protocol": protocol}
        stride = 1 if protocol == "window" else 5
        rows += [about | row for row in plain(table[stride - 1 :: stride].reset_index())]
    return rows


def summary_rows(rows: Rows) -> Rows:
    """Return one row per model for the window protocol, as in the paper's Table 1."""
    window = pd.DataFrame(rows).query("protocol == 'window'")
    keys = ["model", "folds", "n"]
    summary = window.set_index([*keys, "steps"])["mean_cm"].unstack(sort=False)
    return plain(summary.rename(columns="step_{}_mean_cm".format).reset_index())


def tuning_rows(results: list[Result]) -> Rows:
    """Return the validation errors of all settings; `taken` marks the setting of `LEVER_MODELS`."""
    rows = []
    for about, result in results:
        row = {name: about[name] for name in ("model", "trained_for", "setting")}
        row["taken"] = lever_model(row["model"], row["setting"]) == LEVER_MODELS[row["model"]]
        rows.append(row | result)
    return rows


def tables(folder: str | Path = FOLDER) -> dict[str, Rows]:
    """Return all tables from the results in a folder."""

    def order(result: Result) -> tuple[Any, ...]:
        model, trained_for, fold, setting = result[0].values()
        return MODELS.index(model), trained_for, fold, [None, *SETTINGS].index(setting)

    every = sorted(read(NAME, job, folder), key=order)
    results = [result for result in every if result[0]["setting"] is None]
    rows = error_rows(results)
    return {
        "lever_up": rows,
        "summary": [*reported.LEVER_UP_ROWS, *summary_rows(rows)],
        "paired": paired_rows(results),
        "tuning": tuning_rows([result for result in every if result[0]["setting"]]),
    }


_TRAININGS: list[tuple] = [("cnp_published", 0, None)]
_TRAININGS += [(m, k, None) for m in MODELS if m != "cnp_published" for k in range(N_FOLDS)]
_TRAININGS += [
    (m, 0, s)
    for m, s in product(("cnp_tuned", OURS, RECURRENT), SETTINGS)
    if s != ("rate 0.001, half the width" if m == "cnp_tuned" else "rate 0.001, last weights")
]
JOBS = [job(m, kind, *how) for m, *how in _TRAININGS for kind in EACH.get(m, ("all",))]

main = runner.command_of(NAME, __doc__, lambda: JOBS, tables)

if __name__ == "__main__":
    raise SystemExit(main())
