"""A study of the limits of prediction: models of full actions on partial actions.

Actions stop at phase t; the truth is the state of the full action at t, or the object's rest
position.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import torch

from affordlib.interactions import open_interactions
from affordlib.models.base import condition_on_primitives
from affordlib.models.checkpoint import load_checkpoint
from affordlib.primitives import Drag, Push
from experiments.runner import Rows, study

WHOLE_ACTION_MODELS = ("film_500", "film_5000", "drag_film_500")
PHASES = (0.0, 0.55, 0.65, 0.75, 1.0)
"""Edges of the phase bins; the gripper touches nothing before 0.5."""


@study("partial", checkpoints=WHOLE_ACTION_MODELS, settings=PHASES)
@torch.no_grad()
def partial_execution() -> Rows:
    """Measure the errors on partial actions of networks trained only on full actions."""
    data = open_interactions("partial")
    names = data["primitive"].attrs["flag_meanings"].split()
    kinds = np.array(names)[data["primitive"].values]
    phase = data["stop_phase"].values
    whole, rest = (data[name].values for name in ("full_effect", "rest_effect"))
    slid = np.hypot(*(rest - whole)[:, :2].T)
    rows = []
    for name in WHOLE_ACTION_MODELS:
        model, _ = load_checkpoint(name)
        kind = Drag if name.startswith("drag") else Push
        mine = np.flatnonzero((kinds == kind.name) & ~data["fault"].values)
        actions = [kind(float(theta)) for theta in data["theta"].values[mine]]
        image = torch.from_numpy(data["image"].values[mine])
        at = torch.from_numpy(phase[mine]).float()[:, None]
        predicted = model.predict(model.encode(image), condition_on_primitives(model, actions), at)
        columns = [model.effect_channels.index(c) for c in "xy"]
        mean = predicted.effect_mean[:, 0, columns].numpy()
        errors = [np.hypot(*(mean - truth[mine, :2]).T) for truth in (whole, rest)]
        for low, high in pairwise(PHASES):
            of = (phase[mine] > low) & (phase[mine] <= high)
            row = {"model": name, "from_phase": low, "to_phase": high, "n": int(of.sum())}
            for what, error in zip(("whole", "rest"), errors, strict=True):
                row[f"{what}_mean_m"] = float(error[of].mean())
                row[f"{what}_median_m"] = float(np.median(error[of]))
            rows.append(row | {"slid_mean_m": float(slid[mine][of].mean())})
    return rows
