"""Lever-ups against a recurrent network (Table 1 of the paper): makes `data/results/lever_up.json`.

    python -m experiments.lever_up --only model=lstm_tuned

runs these jobs if they are missing, then makes the tables from all results. The split is by object
into five folds, 80/10/10 (each interaction has its own object). A job is one training,
tested in all protocols that it is trained for; errors are distances [cm] between predicted and true
positions, after steps of 150 ms. A job with a `setting` is tuning: it is scored on the validation
part of fold 0. Means, standard errors and intervals are over objects.
"""

from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
import xarray as xr

from affordlib.interactions import Split, split_interactions
from affordlib.interactions.dataset import InteractionTensors, valid_interactions
from affordlib.models import lever_up as models
from affordlib.models.base import EffectNetwork
from affordlib.models.lever_up import PROTOCOLS, lever_up_tensors
from experiments import reported, runner
from experiments.lever_training import (
    LEVER_MODELS,
    TRAINING,
    LeverModel,
    fit_lever_model,
    from_start_errors_m,
)
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

TESTED = {"all": PROTOCOLS, "window": PROTOCOLS[:1], "first_step": PROTOCOLS[1:]}
"""Protocols in which a network is tested, by the protocol that it is trained for."""

SETTINGS: dict[str, dict[str, Any]] = {
    **{f"rate {rate:g}": {"learning_rate": rate} for rate in (1e-3, 5e-4, 2e-3, 4e-3, 8e-3)},
    "rate 0.001, half the width": {},
    "rate 0.001, last weights": {"ema": 0.0},
    "rate 0.001, no weight decay": {"weight_decay": 0.0},
    "rate 0.001, plain likelihood": {"beta": 0.0},
}
"""Changes of the initial `TRAINING` by name; one halves the network's width, which the paper fixes:
for its network, another setting stands in its place.

`LEVER_MODELS` has one learning rate per network: the best, or, for the two trainings of the
recurrent one, the rate whose two errors, each relative to the best of its protocol, have the least
sum."""


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
    """Return the errors in all windows of all test trajectories, by protocol; with a setting, the
    mean errors on the validation part.
    """
    data, lever = open_once(DATA), lever_model(model, setting)
    split = lever_split(data, fold)
    training, validation, test = (
        lever_up_tensors(data, part, lever.view)
        for part in (split.train, split.validation, split.test)
    )
    network, _ = fit_lever_model(lever, training, validation, trained_for, resume_checkpoint)
    if setting is None:
        kept = data["interaction"].values[valid_interactions(data, split.test)]
        errors = {protocol: _errors(network, test, protocol) for protocol in TESTED[trained_for]}
        return {"interaction": kept.tolist()} | errors
    row: dict[str, Any] = {"n": len(validation)}
    if trained_for != "first_step":
        row["window_mean_m"] = float(models.window_errors_m(network, validation).mean())
    if trained_for != "window":
        row["beginning_mean_m"] = float(from_start_errors_m(network, validation).mean())
    return row


@torch.no_grad()
def _errors(network: EffectNetwork, arrays: InteractionTensors, protocol: str) -> dict[str, Any]:
    """Return the errors (N, W, T) [cm] of a network, rounded to 1 µm, as lists."""
    if protocol == "window":
        errors = models.window_errors_m(network, arrays)
    else:
        errors = models.errors_m(*models.predict_steps(network, arrays, protocol))[:, None]
    return {"error_cm": (100 * errors).double().numpy().round(4).tolist()}


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
    """Return paired differences to the recurrent network, with bootstrap 95 % intervals.

    Pairs are test objects, with errors averaged over windows.
    """
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
        taken = lever_model(about["model"], about["setting"]) == LEVER_MODELS[about["model"]]
        names = ("model", "trained_for", "setting")
        rows.append({name: about[name] for name in names} | {"taken": taken} | result)
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


def _jobs(model: str, *how: Any) -> list[Job]:
    return [job(model, kind, *how) for kind in EACH.get(model, ("all",))]


JOBS = [
    *_jobs("cnp_published"),
    *(e for m in MODELS if m != "cnp_published" for k in range(N_FOLDS) for e in _jobs(m, k)),
    *(
        each
        for m, s in product(("cnp_tuned", OURS, RECURRENT), SETTINGS)
        if s != ("rate 0.001, half the width" if m == "cnp_tuned" else "rate 0.001, last weights")
        for each in _jobs(m, 0, s)
    ),
]

main = runner.command_of(NAME, __doc__, lambda: JOBS, tables)

if __name__ == "__main__":
    raise SystemExit(main())
