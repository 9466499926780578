"""A study of σ: why it is too wide for most pushes.

A few pushes have large errors, so the residuals have heavy tails.

Three distributions are fitted to the residuals (e - μ) / σ of validation data, each with one scale:
a Gaussian by maximum likelihood (the variance scaling of the checkpoints), which is sensitive to
outliers; a Gaussian by minimum CRPS (continuous ranked probability score, Gneiting and Raftery,
JASA 2007), which is less so; and Student's t by maximum likelihood, whose degrees of freedom
measure the weight of the tails. Their central 50 and 90 % intervals are then evaluated.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import optimize, stats
from torch import Tensor

from affordlib.geometry import xy_columns
from affordlib.interactions import InteractionTensors, open_interactions, split_interactions
from affordlib.models.base import EffectModel, gaussian_nll
from affordlib.models.checkpoint import load_checkpoint
from affordlib.models.evaluation import AFTER_CONTACT, coverage, effects_at
from experiments.runner import Rows, study

LEVELS = (0.5, 0.9)


def calibration_row(truth: Tensor, mean: Tensor, std: Tensor) -> dict[str, Any]:
    """n, coverage of the central intervals, mean σ and NLL of values (N,)."""
    row = {f"coverage_{v:.0%}"[:-1]: coverage(truth, mean, std, v) for v in LEVELS}
    nll = float(gaussian_nll(truth, mean, std).mean())
    return {"n": len(truth), **row, "std_mean": float(std.mean()), "nll": nll}


def calibration_rows(
    model: EffectModel,
    tensors: InteractionTensors,
    /,
    phases: Sequence[float] = AFTER_CONTACT,
    **columns: Any,
) -> list[dict[str, Any]]:
    """Return one row per phase and effect channel: n, coverage at 50 and 90 %, mean σ and NLL.

    The likelihood is a density per metre or radian; it compares models, not channels.
    """
    truth, mean, std = effects_at(model, tensors, phases)
    rows = []
    for i, phase in enumerate(phases):
        for k, channel in enumerate(model.effect_channels):
            row = calibration_row(truth[:, i, k], mean[:, i, k], std[:, i, k])
            rows.append({**columns, "phase": phase, "channel": channel, **row})
    return rows


@dataclass(frozen=True)
class Fit:
    """A distribution of standardised residuals; a Gaussian has infinite degrees of freedom."""

    name: str
    scale: float
    freedom: float = math.inf

    @property
    def distribution(self) -> Any:
        """The distribution in `scipy.stats`."""
        gaussian = math.isinf(self.freedom)
        return stats.norm(0, self.scale) if gaussian else stats.t(self.freedom, 0, self.scale)


def crps(z: np.ndarray) -> np.ndarray:
    """Return the continuous ranked probability score of a standard Gaussian for observations z."""
    return z * (2 * stats.norm.cdf(z) - 1) + 2 * stats.norm.pdf(z) - 1 / math.sqrt(math.pi)


def fits(residual: np.ndarray, std: np.ndarray) -> list[Fit]:
    """Return the three fits to standardised residuals (N,); σ (N,) are weights of the CRPS."""

    def score(log_scale: float) -> float:
        scale = math.exp(log_scale)
        return float((crps(residual / scale) * scale * std).mean())

    best = optimize.minimize_scalar(score, bounds=(math.log(0.01), math.log(100)), method="bounded")
    freedom, _, scale = stats.t.fit(residual, floc=0)
    return [
        Fit("Gaussian, maximum likelihood", float(np.sqrt(np.square(residual).mean()))),
        Fit("Gaussian, minimum CRPS", math.exp(best.x)),
        Fit("Student's t, maximum likelihood", float(scale), float(freedom)),
    ]


def _residuals(model: Any, arrays: InteractionTensors) -> tuple[np.ndarray, np.ndarray]:
    """Return standardised residuals of x and y after contact, and their σ."""
    plane = xy_columns(model.effect_channels)
    truth, mean, std = (
        v[..., plane].double().flatten().numpy() for v in effects_at(model, arrays, AFTER_CONTACT)
    )
    return (truth - mean) / std, std


@study("push", "push_test", checkpoints=("film_500",))
def residual_distribution() -> Rows:
    """Evaluate coverage and likelihood on `push_test` of fits to validation data of `film_500`."""
    model, _ = load_checkpoint("film_500")
    model.sigma_scale.fill_(1.0)
    channels, data = (model.action_channels, model.effect_channels), open_interactions("push")
    split = split_interactions(data.sizes["interaction"])
    known = InteractionTensors.from_dataset(data, split.validation, *channels)
    test = InteractionTensors.from_dataset(open_interactions("push_test"), None, *channels)
    about = {"model": "film_500", "channel": "x, y", "test": "test", "n": len(test)}
    residuals = _residuals(model, test)
    return [about | coverage_columns(fit, *residuals) for fit in fits(*_residuals(model, known))]


def coverage_columns(fit: Fit, residual: np.ndarray, std: np.ndarray) -> dict[str, Any]:
    """Return coverage of the central intervals, and NLL per value."""
    distribution = fit.distribution
    row = {"fit": fit.name}
    row["degrees_of_freedom"] = None if math.isinf(fit.freedom) else fit.freedom
    for level in LEVELS:
        half = distribution.ppf(0.5 + level / 2)
        row[f"coverage_{100 * level:.0f}"] = float((np.abs(residual) <= half).mean())
    return row | {"nll": float((np.log(std) - distribution.logpdf(residual)).mean())}
