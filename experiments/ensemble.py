"""Deep ensembles: several networks that differ only in their seed, used as one model.

    μ = mean_k μ_k        σ² = mean_k σ_k² + mean_k (μ_k - μ)²

are the first two moments of the uniform mixture (Lakshminarayanan, Pritzel and Blundell, Simple and
scalable predictive uncertainty estimation using deep ensembles, NeurIPS 2017). The second term, the
disagreement of the members, is the epistemic uncertainty, which a single network does not estimate.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence

import torch
from torch import Tensor

from affordlib.models.base import EffectNetwork
from affordlib.types import Observations, Prediction


class Ensemble:
    """Combines trained networks with equal channels to one `EffectModel`.

    sigma_scale: factor on the mixture's σ. Members are copied, and their own sigma_scale is one.
    """

    def __init__(self, members: Sequence[EffectNetwork]) -> None:
        if not members:
            raise ValueError("members must hold at least one network, got none")
        first = members[0]
        self.action_channels, self.effect_channels = first.action_channels, first.effect_channels
        for k, member in enumerate(members):
            channels = member.action_channels, member.effect_channels
            if channels != (self.action_channels, self.effect_channels):
                raise ValueError(
                    f"members must have the channels of the first, {self.action_channels} and "
                    f"{self.effect_channels}; member {k} has {channels[0]} and {channels[1]}"
                )
        self.members = tuple(copy.deepcopy(member) for member in members)
        self.sigma_scale = torch.ones(len(self.effect_channels))
        for member in self.members:
            member.sigma_scale.fill_(1.0)

    def encode(self, image: Tensor) -> Tensor:
        """Return the concatenated features (B, K F) of K members for images (B, 2, 48, 48)."""
        return torch.cat([member.encode(image) for member in self.members], dim=-1)

    def predict(self, features: Tensor, observations: Observations, t_target: Tensor) -> Prediction:
        """Predict the mixture (B, T, C) at t_target (B, T); features are (B, K F) or (1, K F)."""
        each = features.chunk(len(self.members), dim=-1)
        predicted = [
            member.predict(mine.contiguous(), observations, t_target)
            for member, mine in zip(self.members, each, strict=True)
        ]
        action = _moments([p.action_mean for p in predicted], [p.action_std for p in predicted])
        mean, std = _moments([p.effect_mean for p in predicted], [p.effect_std for p in predicted])
        return Prediction(*action, mean, std * self.sigma_scale)


def _moments(means: list[Tensor], stds: list[Tensor]) -> tuple[Tensor, Tensor]:
    """Return mean and σ of the uniform mixture of Gaussians."""
    every = torch.stack(means)
    mean = every.mean(dim=0)
    variance = torch.stack(stds).square().mean(dim=0) + (every - mean).square().mean(dim=0)
    return mean, variance.sqrt()
