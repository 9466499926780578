"""A study: σ is too wide for most pushes because a few are far off; the tails are not Gaussian.

The residuals (e - μ) / σ of validation data are read in three ways, each with one scale a channel:
as a Gaussian of greatest likelihood (the temperature that checkpoints carry), which the few decide;
as a Gaussian of least CRPS (the expected absolute error of the whole distribution, Gneiting and
Raftery, JASA 2007), which they decide less; and as Student's t of greatest likelihood, whose
degrees of freedom say how heavy the tails are. The central 50 and 90 % intervals are then judged.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import optimize, stats

from affordlib.geometry import xy_columns
from affordlib.interactions import InteractionTensors, open_interactions, split_interactions
from affordlib.models.calibration import AFTER_CONTACT, LEVELS, effects_at
from affordlib.models.checkpoint import load_checkpoint
from experiments.shipped import CHECKPOINT_SPECS

CHECKPOINTS = ("film_500", "cnp_500", "drag_film_500")
"""Those whose validation data are shipped."""

TESTS = {"push": "push_test"}
"""Of a set that has none, the test part of its fold 0."""

Rows = list[dict[str, Any]]


@dataclass(frozen=True)
class Reading:
    """A distribution of the standardised residuals: its scale, and degrees of freedom (inf: N)."""

    name: str
    scale: float
    freedom: float = math.inf

    @property
    def distribution(self) -> Any:
        """As of `scipy.stats`."""
        gaussian = math.isinf(self.freedom)
        return stats.norm(0, self.scale) if gaussian else stats.t(self.freedom, 0, self.scale)


def crps(z: np.ndarray) -> np.ndarray:
    """Continuous ranked probability score of a standard Gaussian, where the truth is z."""
    return z * (2 * stats.norm.cdf(z) - 1) + 2 * stats.norm.pdf(z) - 1 / math.sqrt(math.pi)


def readings(residual: np.ndarray, std: np.ndarray) -> list[Reading]:
    """The three readings of standardised residuals (N,) and their σ (N,), which weighs the CRPS."""

    def score(log_scale: float) -> float:
        scale = math.exp(log_scale)
        return float((crps(residual / scale) * scale * std).mean())

    best = optimize.minimize_scalar(score, bounds=(math.log(0.01), math.log(100)), method="bounded")
    freedom, _, scale = stats.t.fit(residual, floc=0)
    return [
        Reading("Gaussian, greatest likelihood", float(np.sqrt(np.square(residual).mean()))),
        Reading("Gaussian, least CRPS", math.exp(best.x)),
        Reading("Student's t, greatest likelihood", float(scale), float(freedom)),
    ]


def _residuals(
    model: Any, arrays: InteractionTensors, columns: list[int]
) -> tuple[np.ndarray, np.ndarray]:
    truth, mean, std = (
        v[..., columns].double().flatten().numpy() for v in effects_at(model, arrays, AFTER_CONTACT)
    )
    return (truth - mean) / std, std


def tails() -> Rows:
    """Coverage and likelihood of each reading, fitted to validation data, there and on tests."""
    rows = []
    for name in CHECKPOINTS:
        model, _ = load_checkpoint(name)
        model.temperature = (1.0,) * len(model.effect_channels)
        channels = model.action_channels, model.effect_channels
        source = CHECKPOINT_SPECS[name].data
        data = open_interactions(source)
        split = split_interactions(data.sizes["interaction"])
        other = TESTS.get(source)
        test_set = (open_interactions(other), None) if other else (data, split.test)
        judged = {
            "validation": InteractionTensors.from_dataset(data, split.validation, *channels),
            "test": InteractionTensors.from_dataset(*test_set, *channels),
        }
        plane = xy_columns(channels[1])
        for columns in (plane, *([k] for k in range(len(channels[1])) if k not in plane)):
            channel = ", ".join(channels[1][k] for k in columns)
            told = {test: _residuals(model, a, columns) for test, a in judged.items()}
            for reading in readings(*told["validation"]):
                for test, (residual, std) in told.items():
                    row = {"model": name, "channel": channel, "reading": reading.name}
                    row |= {"test": test, "n": len(judged[test])}
                    unit = "rad" if channel == "yaw" else "m"
                    rows.append(row | judge(reading, residual, std, unit))
    return rows


def judge(reading: Reading, residual: np.ndarray, std: np.ndarray, unit: str) -> dict[str, Any]:
    """Coverage of the central intervals, half the mean width of the wider, NLL per value."""
    told = reading.distribution
    half = {level: float(told.ppf(0.5 + level / 2)) for level in LEVELS}
    return {
        "scale": reading.scale,
        "degrees_of_freedom": None if math.isinf(reading.freedom) else reading.freedom,
        **{f"coverage_{v:.0%}"[:-1]: float((np.abs(residual) <= half[v]).mean()) for v in LEVELS},
        **{
            f"half_width_90_mean_{u}": half[0.9] * float(std.mean()) if u == unit else None
            for u in ("m", "rad")
        },
        "nll": float((np.log(std) - told.logpdf(residual)).mean()),
    }
