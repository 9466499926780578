"""The paper's network, trained with the paper's loop: one trajectory and one target a step."""

from __future__ import annotations

import math
from dataclasses import replace

import torch

from affordlib.interactions import InteractionTensors, split_interactions
from affordlib.interactions.sampling import Batch
from affordlib.models import EffectNetwork
from affordlib.models.evaluation import final_errors_m
from affordlib.models.training import TrainingConfig, untrained
from affordlib.types import Observations
from experiments.runner import Rows, open_once
from experiments.shipped import CHECKPOINT_SPECS

SPEC = CHECKPOINT_SPECS["cnp_500"]
ITERATIONS = 100_000
LITERAL = TrainingConfig(
    steps=1_000_000, learning_rate=1e-4, validate_every=2500, patience=40, augment=False
)
"""The paper's recipe; it stops early, 100,000 steps after its best validation, as we read it."""

DECISIVE = (SPEC.network, ITERATIONS, LITERAL.validate_every)
"""What decides the result of `literal_training`."""


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
    validation: InteractionTensors,
    config: TrainingConfig = LITERAL,
) -> Rows:
    """Train in place with the paper's loop (Section 3.2) and early stopping; return its history.

    A step is one trajectory and one target; a million take hours. The model keeps the weights of
    the best validation. Of config, the numbers of steps, observations, validations and patience,
    the rate and the seed count.
    """
    generator = torch.Generator().manual_seed(config.seed)
    optimiser = torch.optim.Adam(model.parameters(), config.learning_rate, fused=True)
    history, best = [], {"error": math.inf, "step": 0, "weights": model.state_dict()}
    for step in range(1, config.steps + 1):
        if step > best["step"] + config.patience * config.validate_every:
            break
        optimiser.zero_grad()
        loss = model.loss(sample_literal(training, config.obs_max, generator))
        loss.backward()
        optimiser.step()
        if step % config.validate_every == 0 or step == config.steps:
            error = float(final_errors_m(model, validation).mean())
            history.append({"step": step, "validation_error_m": error})
            if error < best["error"]:
                weights = {name: value.clone() for name, value in model.state_dict().items()}
                best = {"error": error, "step": step, "weights": weights}
    model.load_state_dict(best["weights"])
    model.eval()
    return history


def literal_training() -> Rows:
    """Return validation errors of the paper's network and loop, learning rate 1e-4, on one fold."""
    data = open_once(SPEC.data)
    split = split_interactions(data.sizes["interaction"])
    training = InteractionTensors.from_dataset(data, split.train)
    validation = InteractionTensors.from_dataset(data, split.validation)
    model = untrained(SPEC.network, training, 0).train()
    history = train_literal(model, training, validation, replace(LITERAL, steps=ITERATIONS))
    return [{"recipe": "literal"} | row for row in history]
