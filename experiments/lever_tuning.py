"""A study: the same budget of tuning for ours and for the recurrent network (Section 4.1).

Each network is trained with each of `SETTINGS`, as long as the shipped one, on the training part of
fold 0 of the lever-ups, and evaluated on its validation part. `LEVER_MODELS` has one learning rate
for each network: the best, or within a thousandth of the best where the two trainings of the
recurrent one differ. No test data are used.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from affordlib.interactions import open_interactions
from affordlib.interactions.dataset import augment_by_symmetry
from affordlib.interactions.lever_up import MIRRORED, lever_up_tensors
from affordlib.models.lever_up import (
    LEVER_MODELS,
    TRAINING,
    LeverModel,
    fit_lever_model,
    from_start_errors_m,
    window_errors_m,
)
from experiments.lever_cross_validation import DATA, lever_split

SETTINGS: dict[str, tuple[dict[str, Any], float]] = {
    "rate 0.001": ({}, 1.0),
    "rate 0.0005": ({"learning_rate": 5e-4}, 1.0),
    "rate 0.002": ({"learning_rate": 2e-3}, 1.0),
    "rate 0.004": ({"learning_rate": 4e-3}, 1.0),
    "rate 0.008": ({"learning_rate": 8e-3}, 1.0),
    "rate 0.001, half the width": ({}, 0.5),
    "rate 0.001, no weight decay": ({"weight_decay": 0.0}, 1.0),
    "rate 0.001, plain likelihood": ({"beta": 0.0}, 1.0),
}
"""By name: what is changed in `TRAINING`, where both began, and the share of the width."""

TRAINED = (("cnp_last_pose", "all"), ("lstm_tuned", "window"), ("lstm_tuned", "first_step"))


DECISIVE = (SETTINGS, TRAINED, [LEVER_MODELS[name].network for name, _ in TRAINED], TRAINING)


def changed(lever: LeverModel, setting: str) -> LeverModel:
    """A network with one of `SETTINGS`."""
    training, share = SETTINGS[setting]
    network = replace(lever.network, width=round(share * lever.network.width))
    return replace(lever, network=network, training=replace(TRAINING, **training))


def tuning() -> list[dict[str, Any]]:
    """Mean validation errors [m], of windows and of whole beginnings, of every setting."""
    data, rows = open_interactions(DATA), []
    for name, trained_for in TRAINED:
        lever = LEVER_MODELS[name]
        split = lever_split(data)
        training = augment_by_symmetry(lever_up_tensors(data, split.train, lever.view), MIRRORED)
        validation = lever_up_tensors(data, split.validation, lever.view)
        for setting in SETTINGS:
            model, history = fit_lever_model(
                changed(lever, setting), training, validation, trained_for
            )
            row = {"model": name, "trained_for": trained_for, "setting": setting}
            row |= {"taken": changed(lever, setting) == lever}
            row |= {"steps": history[-1].step, "n": len(validation)}
            if trained_for != "first_step":
                row["window_mean_m"] = float(window_errors_m(model, validation).mean())
            if trained_for != "window":
                row["beginning_mean_m"] = float(from_start_errors_m(model, validation).mean())
            rows.append(row)
    return rows
