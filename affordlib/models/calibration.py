"""Is σ right? Coverage of the central intervals, negative log-likelihood, and variance scaling.

With a calibrated Gaussian half of the ground truth lies in the central 50 % interval μ ± 0.674 σ.
Variance scaling multiplies σ of an effect channel by s; that of greatest likelihood is
s² = mean ((e - μ) / σ)² (a temperature: Guo et al., On calibration of modern neural networks, ICML
2017).
"""

import math
from collections.abc import Sequence
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from affordlib.geometry import xy_columns
from affordlib.interactions.dataset import InteractionTensors
from affordlib.interactions.sampling import condition_on_recorded_action
from affordlib.models.base import gaussian_nll
from affordlib.models.protocol import EffectModel
from affordlib.types import check_within

LEVELS = (0.5, 0.9)
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
    """Truth, mean and σ of the effects, (N, T, C) each, given image and action."""
    phases = [check_within("phases", phase, 0.0, 1.0) for phase in phases]
    if not phases:
        raise ValueError("phases must hold at least one phase in [0, 1], got none")
    at = (torch.tensor(phases) * (len(tensors.phase) - 1)).round().long()
    t_target = tensors.phases(at)
    predicted = model.predict(
        model.encode(tensors.image), condition_on_recorded_action(tensors), t_target
    )
    return tensors.effect[:, at], predicted.effect_mean, predicted.effect_std


def fit_sigma_scale(
    model: EffectModel,
    validation: InteractionTensors,
    phases: Sequence[float] = AFTER_CONTACT,
) -> tuple[float, ...]:
    """Set, and return, the sigma_scale (C_e,) of greatest likelihood; x and y share one."""
    model.sigma_scale = (1.0,) * len(model.effect_channels)
    truth, mean, std = effects_at(model, validation, phases)
    squared = ((truth - mean) / std).square().mean(dim=(0, 1))
    plane = xy_columns(model.effect_channels)
    squared[plane] = squared[plane].mean()
    model.sigma_scale = tuple(squared.clamp_min(1e-6).sqrt().tolist())
    return model.sigma_scale


def calibration_row(truth: Tensor, mean: Tensor, std: Tensor) -> dict[str, Any]:
    """n, coverage of the central intervals, mean σ and NLL of values (N,)."""
    row = {f"coverage_{v:.0%}"[:-1]: coverage(truth, mean, std, v) for v in LEVELS}
    nll = float(gaussian_nll(truth, mean, std).mean())
    return {"n": len(truth), **row, "std_mean": float(std.mean()), "nll": nll}
