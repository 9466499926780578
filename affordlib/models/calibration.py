"""Is σ right? Coverage of the central intervals, negative log-likelihood, and a temperature.

Of a calibrated Gaussian the truth lies in the central 50 % interval μ ± 0.674 σ half of the time.
A temperature τ multiplies σ of an effect channel; the one of greatest likelihood is
τ² = mean ((e - μ) / σ)² (Guo et al., On calibration of modern neural networks, ICML 2017).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from affordlib.geometry import xy_columns
from affordlib.interactions.dataset import InteractionTensors
from affordlib.interactions.sampling import condition_on_recorded_action
from affordlib.models.ensemble import Ensemble
from affordlib.models.network import EffectNetwork, gaussian_nll
from affordlib.types import check_within

LEVELS = (0.5, 0.9)
AFTER_CONTACT = (0.8, 0.9, 1.0)
"""Phases at which every push has moved its object; before contact the effect is zero and told."""


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
    model: EffectNetwork | Ensemble, arrays: InteractionTensors, phases: Sequence[float]
) -> tuple[Tensor, Tensor, Tensor]:
    """Truth, mean and σ of the effects, (N, T, C) each, given image and action."""
    phases = [check_within("phases", phase, 0.0, 1.0) for phase in phases]
    if not phases:
        raise ValueError("phases must hold at least one phase in [0, 1], got none")
    at = (torch.tensor(phases) * (len(arrays.phase) - 1)).round().long()
    t_target = arrays.phases(at)
    told = model.predict(model.encode(arrays.image), condition_on_recorded_action(arrays), t_target)
    return arrays.effect[:, at], told.effect_mean, told.effect_std


def fit_temperature(
    model: EffectNetwork | Ensemble,
    validation: InteractionTensors,
    phases: Sequence[float] = AFTER_CONTACT,
) -> tuple[float, ...]:
    """Set, and return, the temperatures (C_e,) under which validation data are likeliest.

    x and y share one, as they share a scale: no direction of the table is special.
    """
    model.temperature = (1.0,) * len(model.effect_channels)
    truth, mean, std = effects_at(model, validation, phases)
    squared = ((truth - mean) / std).square().mean(dim=(0, 1))
    plane = xy_columns(model.effect_channels)
    squared[plane] = squared[plane].mean()
    model.temperature = tuple(squared.clamp_min(1e-6).sqrt().tolist())
    return model.temperature


def calibration_rows(
    model: EffectNetwork | Ensemble,
    arrays: InteractionTensors,
    /,
    phases: Sequence[float] = AFTER_CONTACT,
    **columns: Any,
) -> list[dict[str, Any]]:
    """One row per phase and effect channel: n, coverage at 50 and 90 %, mean σ and NLL.

    The likelihood is a density of metres or radians; it compares models, not channels.
    """
    truth, mean, std = effects_at(model, arrays, phases)
    rows = []
    for i, phase in enumerate(phases):
        for k, channel in enumerate(model.effect_channels):
            y, mu, sigma = truth[:, i, k], mean[:, i, k], std[:, i, k]
            row = {"phase": phase, "channel": channel, "n": len(y)}
            row |= {f"coverage_{level:.0%}"[:-1]: coverage(y, mu, sigma, level) for level in LEVELS}
            row |= {"std_mean": float(sigma.mean())}
            row |= {"nll": float(gaussian_nll(y, mu, sigma).mean())}
            rows.append(columns | row)
    return rows
