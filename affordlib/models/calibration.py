"""Calibration of σ: coverage of central intervals, negative log-likelihood, variance scaling.

With a calibrated Gaussian half of the ground truth lies in the central 50 % interval μ ± 0.674 σ.
Variance scaling multiplies σ of an effect channel by s; the maximum-likelihood value is s² = mean
((e - μ) / σ)² (a temperature: Guo et al., On calibration of modern neural networks, ICML 2017).

σ covers the noise in the training data, not the novelty of an object (notebook 08).
"""

import math
from collections.abc import Sequence
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from affordlib.geometry import xy_columns
from affordlib.interactions.dataset import InteractionTensors, check_fits
from affordlib.interactions.sampling import condition_on_recorded_action
from affordlib.models.protocol import EffectModel
from affordlib.types import check_within

AFTER_CONTACT = (0.8, 0.9, 1.0)
"""Phases at which every push has moved its object; before contact the effect is always zero."""


def coverage(
    truth: Float[Tensor, "*s"], mean: Float[Tensor, "*s"], std: Float[Tensor, "*s"], level: float
) -> float:
    """Share of the values inside the central interval of the given level, such as 0.9."""
    if not 0 < level < 1:
        raise ValueError(f"level must lie in (0, 1), got {level!r}")
    if not truth.shape == mean.shape == std.shape:
        shapes = tuple(truth.shape), tuple(mean.shape), tuple(std.shape)
        raise ValueError(f"truth, mean and std must have one shape, got {shapes}")
    half = math.sqrt(2) * float(torch.erfinv(torch.tensor(level, dtype=torch.float64)))
    return float(((truth - mean).abs() <= half * std).double().mean())


@torch.no_grad()
def effects_at(
    model: EffectModel, tensors: InteractionTensors, phases: Sequence[float]
) -> tuple[Tensor, Tensor, Tensor]:
    """Ground truth, mean and σ of the effects, (N, T, C) each, given image and action."""
    phases = [check_within("phases", phase, 0.0, 1.0) for phase in phases]
    if not phases:
        raise ValueError("phases must hold at least one phase in [0, 1], got none")
    check_fits("tensors", tensors, model)
    at = (torch.tensor(phases) * (len(tensors.phase) - 1)).round().long()
    t_target = tensors.phases(at)
    predicted = model.predict(
        model.encode(tensors.image), condition_on_recorded_action(tensors), t_target
    )
    return tensors.effect[:, at], predicted.effect_mean, predicted.effect_std


@runtime_checkable
class HasSigmaScale(EffectModel, Protocol):
    """A model whose σ of the effect channels is multiplied by sigma_scale (C_e,)."""

    sigma_scale: Tensor


def fit_sigma_scale(
    model: HasSigmaScale,
    validation: InteractionTensors,
    phases: Sequence[float] = AFTER_CONTACT,
) -> tuple[float, ...]:
    """Set and return the maximum-likelihood sigma_scale (C_e,); x and y share one factor."""
    model.sigma_scale.fill_(1.0)
    truth, mean, std = effects_at(model, validation, phases)
    squared = ((truth - mean) / std).square().mean(dim=(0, 1))
    plane = xy_columns(model.effect_channels)
    squared[plane] = squared[plane].mean()
    model.sigma_scale.copy_(squared.clamp_min(1e-6).sqrt())
    return tuple(model.sigma_scale.tolist())
