"""The paper's network trained by the paper's recipe, and on trajectories of fewer samples."""

from __future__ import annotations

import numpy as np

from affordlib.interactions import InteractionTensors, split_interactions
from affordlib.models import EffectNetwork
from affordlib.models.training import final_errors_m, train_literal, train_model, untrained
from experiments.runner import Rows, open_once, study
from experiments.shipped import CHECKPOINT_SPECS

SPEC = CHECKPOINT_SPECS["cnp_500"]
ITERATIONS, VALIDATE_EVERY = 100_000, 2500


def trained_on(n_samples: int) -> EffectNetwork:
    """The same network, trained in batches as it is shipped, on so many samples a trajectory."""
    data = open_once(SPEC.data)
    split = split_interactions(data.sizes["interaction"])
    samples = np.linspace(0, data.sizes["sample"] - 1, n_samples).round().astype(int)
    return train_model(data.isel(sample=samples), split, SPEC.training, SPEC.network)[0]


@study("push", settings=(SPEC.network, ITERATIONS, VALIDATE_EVERY))
def literal_training() -> Rows:
    """Validation errors of the paper's network and loop, at a rate of 1e-4, on one fold."""
    data = open_once(SPEC.data)
    split = split_interactions(data.sizes["interaction"])
    training = InteractionTensors.from_dataset(data, split.train)
    validation = InteractionTensors.from_dataset(data, split.validation)
    model, rows = untrained(SPEC.network, training, 0).train(), []

    def validate(iteration: int) -> None:
        if iteration % VALIDATE_EVERY == 0:
            error = float(final_errors_m(model, validation).mean())
            rows.append({"recipe": "literal", "step": iteration, "validation_error_m": error})

    train_literal(model, training, ITERATIONS, after=validate)
    return rows
