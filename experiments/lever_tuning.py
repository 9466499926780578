"""Tuning of the networks of Table 1 with equal budgets, on the validation part of fold 0.

    python -m experiments.lever_tuning --only model=cnp_mean

runs missing jobs; `experiments.lever_up` makes the table. Each network has eight settings of as
many steps; those trained for one protocol at a time have them for each protocol. No test data are
used. `LEVER_MODELS` has one learning rate per network: the best, or, for two trainings, the one
whose two errors, each relative to the best of its protocol, have the least sum.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from affordlib.models.lever_up import from_start_errors_m, lever_up_tensors, window_errors_m
from affordlib.types import check_choice
from experiments import runner
from experiments.commands import command
from experiments.lever_cross_validation import DATA, lever_split
from experiments.lever_training import (
    LEVER_MODELS,
    TRAINING,
    LeverModel,
    fit_lever_model,
    lever_training,
)
from experiments.runner import FOLDER, Job, Rows, open_once, read

NAME = "lever_tuning"

_RATES = {f"rate {rate:g}": {"learning_rate": rate} for rate in (1e-3, 5e-4, 2e-3, 4e-3, 8e-3)}
_OTHER = {
    "rate 0.001, no weight decay": {"weight_decay": 0.0},
    "rate 0.001, plain likelihood": {"beta": 0.0},
}
SETTINGS: dict[str, dict[str, Any]] = _RATES | {"rate 0.001, half the width": {}} | _OTHER
"""Changes of the initial `TRAINING` by name; one halves the network's width."""

CNP_SETTINGS = _RATES | {"rate 0.00025": {"learning_rate": 2.5e-4}} | _OTHER
"""Settings of the paper's network, whose widths are the paper's."""

TUNED = (
    ("cnp_last_pose", "all"),
    ("lstm_tuned", "window"),
    ("lstm_tuned", "first_step"),
    ("cnp_mean", "window"),
    ("cnp_mean", "first_step"),
)


def settings_of(model: str) -> dict[str, dict[str, Any]]:
    """Return the settings of a network by name."""
    return CNP_SETTINGS if model == "cnp_mean" else SETTINGS


def changed(model: str, setting: str) -> LeverModel:
    """Return a network of `LEVER_MODELS` with one of its settings."""
    lever, change = LEVER_MODELS[model], settings_of(model)[setting]
    network = lever.network
    if setting.endswith("half the width"):
        network = replace(network, width=network.width // 2)
    return replace(lever, network=network, training=replace(TRAINING, **change))


def job(model: str, trained_for: str, setting: str) -> Job:
    """Return the job of one training with a setting."""
    check_choice("setting", setting, settings_of(model))
    arguments = {"model": model, "trained_for": trained_for, "setting": setting}
    return Job(tune, arguments, changed(model, setting), (DATA,))


def tune(model: str, trained_for: str, setting: str, resume_checkpoint: Path) -> dict[str, Any]:
    """Train and return mean validation errors [m] of windows, and from the first step."""
    lever, data = changed(model, setting), open_once(DATA)
    split = lever_split(data)
    validation = lever_up_tensors(data, split.validation, lever.view)
    training = lever_training(lever, data, split)
    network, history = fit_lever_model(lever, training, validation, trained_for, resume_checkpoint)
    row = {"steps": history[-1].step, "n": len(validation)}
    if trained_for != "first_step":
        row["window_mean_m"] = float(window_errors_m(network, validation).mean())
    if trained_for != "window":
        row["beginning_mean_m"] = float(from_start_errors_m(network, validation).mean())
    return row


JOBS = [job(*pair, setting) for pair in TUNED for setting in settings_of(pair[0])]


def rows(folder: str | Path = FOLDER) -> Rows:
    """Return the rows of all finished jobs; `taken` marks the setting of `LEVER_MODELS`."""
    found = {runner._key(about): result for about, result in read(NAME, job, folder)}
    made = []
    for one in JOBS:
        about, lever = one.arguments, one.settings
        if result := found.get(runner._key(about)):
            made.append(about | {"taken": lever == LEVER_MODELS[about["model"]]} | result)
    return made


@command(OSError, ValueError)
def main(argv: Sequence[str] | None = None) -> int:
    """Train missing settings."""
    return runner.make(JOBS, NAME, runner.parser(NAME, main.__doc__).parse_args(argv))


if __name__ == "__main__":
    sys.exit(main())
