"""The paper's own training: one trajectory and one target per iteration, at a constant rate."""

from dataclasses import dataclass, replace

import torch

from affordlib.interactions import Batch, InteractionTensors
from affordlib.models.training import TrainingConfig
from affordlib.types import Observations


def one_at_a_time(
    arrays: InteractionTensors, n_targets: int, obs_max: int, generator: torch.Generator
) -> Batch:
    """Sample as in the paper: one trajectory and one target; n_targets is not used.

    Action and effect are observed at the same k phases, k uniform in 1 … obs_max; w₁ is 1, 0 or
    uniform in [0, 1] (1/3 each).
    """

    def draw(high, n=1):
        return torch.randint(high, (n,), generator=generator)

    part, last = arrays.select(draw(len(arrays))), len(arrays.phase)
    draw(1)  # keeps the random numbers of the trainings that were made
    at, target_at = draw(last, 1 + int(draw(obs_max))), draw(last)
    kind, weight = int(draw(3)), torch.rand(1, generator=generator)
    weight = weight if kind == 2 else torch.tensor([float(kind)])
    observed = Observations.of(part, part.action_at(at), part.effect_at(at), weight)
    return Batch.of(part, observed, target_at)


@dataclass(frozen=True)
class ConstantRate(TrainingConfig):
    """Training whose rate does not change; its σ floor falls as if it took a million steps."""

    def rate(self, step: int) -> float:
        return self.learning_rate

    def sigma_floor(self, step: int, first: float) -> float:
        return replace(TrainingConfig(), steps=10**6).sigma_floor(step, first)


PUBLISHED = ConstantRate(
    10**6, 1, 1, learning_rate=1e-4, augment=False, validate_every=5000, patience=40
)
"""Section 4: a million iterations, or until 200,000 bring no gain in validation."""
