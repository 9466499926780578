"""Samplers of training batches: the context that a model observes and its target phases.

In Section 3.2 of the paper, k observations, k uniform in 1 … obs_max, are taken at random phases
of a random trajectory. A sampler takes the interactions of a batch, n_targets, obs_max and a
generator, and returns a `Batch`.
"""

from dataclasses import dataclass, replace
from typing import Self

import torch

from affordlib.interactions.dataset import InteractionTensors
from affordlib.types import Observations


@dataclass(frozen=True)
class Batch:
    """Images, context, and targets of action and effect."""

    image: torch.Tensor  # (B, 2, 48, 48)
    observations: Observations
    t_target: torch.Tensor  # (B, T)
    action: torch.Tensor  # (B, T, C_a)
    effect: torch.Tensor  # (B, T, C_e)

    @classmethod
    def of(
        cls, tensors: InteractionTensors, observations: Observations, target_at: torch.Tensor
    ) -> Self:
        """Build a batch whose targets are the samples with numbers (B, T), or (T,) for all."""
        t_target, action = tensors.action_at(target_at)
        effect = tensors.effect_at(target_at)[1]
        return cls(tensors.image, observations, t_target, action, effect)


def condition_on_recorded_action(tensors: InteractionTensors) -> Observations:
    """Return a context of only the commanded action, at t = 0 and t = 1 (w₁ = 1)."""
    return Observations.of(tensors, action=tensors.action_at(torch.tensor([0, -1])))


def condition_on_poses(
    tensors: InteractionTensors, start: torch.Tensor, n_poses: int
) -> Observations:
    """Return a context of the action at t = 0 and 1, and n_poses effects from sample `start` (N,).

    With n_poses = 0 only the action is observed (w₁ = 1), otherwise both (w₁ = 1/2).
    """
    at = start[:, None] + torch.arange(n_poses)
    effect = tensors.effect_at(at) if n_poses else None
    return Observations.of(tensors, tensors.action_at(torch.tensor([0, -1])), effect)


def sample_mixed(
    tensors: InteractionTensors, n_targets: int, obs_max: int, generator: torch.Generator
) -> Batch:
    """Sample contexts of action (50 %), effect (25 %) or both, half at the phases used to plan."""
    b, last = len(tensors), len(tensors.phase) - 1

    def uniform(*shape):
        return torch.rand(*shape, generator=generator)

    def samples(*shape):
        return torch.randint(0, last + 1, shape, generator=generator)

    def counts():
        few = torch.randint(1, min(2, obs_max) + 1, (b, 1), generator=generator)
        many = torch.randint(1, obs_max + 1, (b, 1), generator=generator)
        return torch.where(uniform(b, 1) < 0.5, few, many)

    action_at, effect_at = samples(b, obs_max), samples(b, obs_max)
    as_queried = uniform(b) < 0.5
    action_at[as_queried, 0] = 0
    action_at[as_queried, min(1, obs_max - 1)] = last if obs_max > 1 else 0
    effect_at[uniform(b) < 0.5, 0] = last

    slot = torch.arange(obs_max)
    kind = uniform(b, 1)
    action_mask = (slot < counts()) & ((kind < 0.5) | (kind > 0.75))
    effect_mask = (slot < counts()) & (kind >= 0.5)
    weight = torch.where(kind > 0.75, uniform(b, 1), (kind < 0.5).float()).squeeze(1)

    target_at = samples(b, n_targets)
    target_at[:, 0] = last
    observed = Observations.of(
        tensors, tensors.action_at(action_at), tensors.effect_at(effect_at), weight
    )
    observed = replace(observed, action_mask=action_mask, effect_mask=effect_mask)
    return Batch.of(tensors, observed, target_at)


def sample_forward(
    tensors: InteractionTensors, n_targets: int, obs_max: int, generator: torch.Generator
) -> Batch:
    """Sample targets for a context of only the action at t = 0 and 1; obs_max is not used."""
    last = len(tensors.phase) - 1
    target_at = torch.randint(0, last + 1, (len(tensors), n_targets), generator=generator)
    target_at[:, 0] = last
    return Batch.of(tensors, condition_on_recorded_action(tensors), target_at)
