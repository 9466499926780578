"""The paper's network trained as published, and on trajectories of fewer samples."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch

from affordlib.interactions import InteractionTensors, split_interactions
from affordlib.interactions.sampling import Batch
from affordlib.models import EffectNetwork
from affordlib.models.training import batch_loss, final_errors_m, train_model, untrained
from affordlib.types import Observations, check_count, check_within
from experiments.runner import Rows, open_once, study
from experiments.shipped import CHECKPOINT_SPECS

SPEC = CHECKPOINT_SPECS["cnp_500"]
ITERATIONS, VALIDATE_EVERY = 100_000, 2500


def trained_on(n_samples: int) -> EffectNetwork:
    """Train the shipped network in batches, with n_samples per trajectory instead of all."""
    data = open_once(SPEC.data)
    split = split_interactions(data.sizes["interaction"])
    samples = np.linspace(0, data.sizes["sample"] - 1, n_samples).round().astype(int)
    return train_model(data.isel(sample=samples), split, SPEC.training, SPEC.network)[0]


def sample_literal(tensors: InteractionTensors, obs_max: int, generator: torch.Generator) -> Batch:
    """Sample as in the paper: one trajectory, k observations, k uniform in 1 … obs_max, one target.

    Action and effect are observed at the same phases; w₁ is 1, 0 or uniform in [0, 1] (1/3 each).
    """

    def draw(high, n=1):
        return torch.randint(high, (n,), generator=generator)

    part, last = tensors.select(draw(len(tensors))), len(tensors.phase)
    at, target_at = draw(last, 1 + int(draw(obs_max))), draw(last)
    kind, weight = int(draw(3)), torch.rand(1, generator=generator)
    weight = weight if kind == 2 else torch.tensor([float(kind)])
    observed = Observations.of(part, part.action_at(at), part.effect_at(at), weight)
    return Batch.of(part, observed, target_at)


def train_literal(
    model: EffectNetwork,
    training: InteractionTensors,
    iterations: int = 1_000_000,
    obs_max: int = 10,
    learning_rate: float = 1e-4,
    seed: int = 0,
    after: Callable[[int], object] = bool,
) -> list[float]:
    """Train in place with the paper's loop (Section 3.2) and return the losses.

    An iteration is one trajectory and one target; a million take hours. after: gets its number.
    """
    check_count("iterations", iterations)
    check_count("obs_max", obs_max, 1, 100_000)
    check_within("learning_rate", learning_rate, 1e-7, 1.0)
    generator = torch.Generator().manual_seed(check_count("seed", seed, 0, 2**63 - 1))
    optimiser = torch.optim.Adam(model.parameters(), lr=learning_rate)
    losses = []
    for iteration in range(1, iterations + 1):
        loss = batch_loss(model, sample_literal(training, obs_max, generator))
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        losses.append(loss.item())
        after(iteration)
    return losses


@study("push", settings=(SPEC.network, ITERATIONS, VALIDATE_EVERY))
def literal_training() -> Rows:
    """Return validation errors of the paper's network and loop, learning rate 1e-4, on one fold."""
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
