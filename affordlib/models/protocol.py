"""The interface of models for planners: encode an object once, predict many queries per call."""

from collections.abc import Sequence
from typing import Protocol, runtime_checkable

import numpy as np
import torch

from affordlib.primitives import Primitive
from affordlib.types import ACTION_CHANNELS, HasChannels, Observations, Prediction


@runtime_checkable
class EffectModel(HasChannels, Protocol):
    """A model of the effects of actions; inputs and outputs are in metres, radians and phase.

    Both methods are differentiable in their inputs.
    """

    def encode(self, image: torch.Tensor) -> torch.Tensor:
        """Features (B, F) of images (B, 2, 48, 48)."""
        ...

    def predict(
        self, features: torch.Tensor, observations: Observations, t_target: torch.Tensor
    ) -> Prediction:
        """Mean and σ (B, T, C) at t_target (B, T) for B queries; features (B, F) or (1, F)."""
        ...


def condition_on_primitives(model: EffectModel, actions: Sequence[Primitive]) -> Observations:
    """Observe each commanded action at t = 0 and t = 1, and no effect: B = len(actions)."""
    if not actions:
        raise ValueError("actions must hold at least one action, got none")
    columns = [ACTION_CHANNELS.index(name) for name in model.action_channels]
    action = np.stack([one.ends() for one in actions])[..., columns]
    t = torch.tensor([0.0, 1.0]).expand(len(actions), 2)
    return Observations.of(model, action=(t, torch.as_tensor(action, dtype=torch.float32)))


def condition_on_final_effect(model: EffectModel, effect: torch.Tensor) -> Observations:
    """Observe the effect (B, C_e) at t = 1 and no action (w₁ = 0); differentiable in the effect."""
    return Observations.of(model, effect=(effect.new_ones(len(effect), 1), effect[:, None]))
