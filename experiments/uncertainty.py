"""Studies of σ: in a perturbed world, and why it is too wide for most pushes.

A few pushes have large errors: the tails are heavy.

Three distributions are fitted to the residuals (e - μ) / σ of validation data, each with one scale
a channel: a Gaussian of maximum likelihood (the variance scaling of the checkpoints), which the few
decide; a Gaussian of minimum CRPS (the continuous ranked probability score, Gneiting and Raftery,
JASA 2007), which they decide less; and Student's t of maximum likelihood, whose degrees of freedom
say how heavy the tails are. Their central 50 and 90 % intervals are then evaluated.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import optimize, stats

from affordlib.evaluation.metrics import refuse_seen
from affordlib.geometry import xy_columns
from affordlib.interactions import InteractionTensors, open_interactions, split_interactions
from affordlib.models.calibration import AFTER_CONTACT, LEVELS, calibration_rows, effects_at
from affordlib.models.checkpoint import load_checkpoint
from affordlib.models.training import final_errors_m, train_model
from experiments.representation import TRAINING
from experiments.runner import Rows, study
from experiments.shipped import CHECKPOINT_SPECS

CHECKPOINTS = ("film_500", "cnp_500", "drag_film_500")
"""Those whose validation data are shipped."""

TEST_SETS = {"push": "push_test"}
"""A set that has none is tested on the test part of its fold 0."""

PERTURBED_FOLDS = 3
NETWORK = CHECKPOINT_SPECS["film_500"].network
_ABOUT = (TRAINING, NETWORK, PERTURBED_FOLDS)


@study("push_varied", checkpoints=("film_5000_perturbed",), settings=_ABOUT)
def perturbed_world() -> Rows:
    """Errors and calibration in a perturbed world with camera noise.

    Folds of 500 pushes together; and all of these, predicted by the network that learned from 4,000
    others.
    """
    data = open_interactions("push_varied")
    channels = NETWORK.action_channels, NETWORK.effect_channels
    errors, calibrated = [], []
    for fold in range(PERTURBED_FOLDS):
        split = split_interactions(data.sizes["interaction"], 0, fold)
        model, _ = train_model(data, split, TRAINING, NETWORK)
        test = InteractionTensors.from_dataset(data, split.test, *channels)
        errors.append(final_errors_m(model, test).numpy())
        calibrated.append(calibration_rows(model, test))
    rows = _perturbed_rows(500, PERTURBED_FOLDS, np.concatenate(errors), calibrated)
    model, about = load_checkpoint("film_5000_perturbed")
    everything = np.arange(data.sizes["interaction"])
    refuse_seen(about, data, everything)
    test = InteractionTensors.from_dataset(data, everything, *channels)
    error = final_errors_m(model, test).numpy()
    return rows + _perturbed_rows(5000, 1, error, [calibration_rows(model, test)])


def _perturbed_rows(
    n_interactions: int, folds: int, error: np.ndarray, calibrated: list[Rows]
) -> Rows:
    about = {"n_interactions": n_interactions, "folds": folds, "n": len(error)}
    about |= {"final_error_mean_m": float(error.mean())}
    about |= {"final_error_median_m": float(np.median(error))}
    rows = []
    for same in zip(*calibrated, strict=True):
        row = about | {key: same[0][key] for key in ("phase", "channel")}
        for key in ("coverage_50", "coverage_90", "std_mean", "nll"):
            row[key] = float(np.average([r[key] for r in same], weights=[r["n"] for r in same]))
        rows.append(row)
    return rows


@dataclass(frozen=True)
class Fit:
    """A distribution of standardised residuals; a Gaussian has infinite degrees of freedom."""

    name: str
    scale: float
    freedom: float = math.inf

    @property
    def distribution(self) -> Any:
        """As of `scipy.stats`."""
        gaussian = math.isinf(self.freedom)
        return stats.norm(0, self.scale) if gaussian else stats.t(self.freedom, 0, self.scale)


def crps(z: np.ndarray) -> np.ndarray:
    """Continuous ranked probability score of a standard Gaussian, where the observation is z."""
    return z * (2 * stats.norm.cdf(z) - 1) + 2 * stats.norm.pdf(z) - 1 / math.sqrt(math.pi)


def fits(residual: np.ndarray, std: np.ndarray) -> list[Fit]:
    """The three fits to standardised residuals (N,) with σ (N,), which weighs the CRPS."""

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


def _residuals(
    model: Any, arrays: InteractionTensors, columns: list[int]
) -> tuple[np.ndarray, np.ndarray]:
    truth, mean, std = (
        v[..., columns].double().flatten().numpy() for v in effects_at(model, arrays, AFTER_CONTACT)
    )
    return (truth - mean) / std, std


@study("push", "drag", "push_test", checkpoints=CHECKPOINTS)
def residual_distribution() -> Rows:
    """Coverage and likelihood of each fit to validation data, there and on tests."""
    rows = []
    for name in CHECKPOINTS:
        model, _ = load_checkpoint(name)
        model.sigma_scale = (1.0,) * len(model.effect_channels)
        channels = model.action_channels, model.effect_channels
        source = CHECKPOINT_SPECS[name].data
        data = open_interactions(source)
        split = split_interactions(data.sizes["interaction"])
        other = TEST_SETS.get(source)
        test_set = (open_interactions(other), None) if other else (data, split.test)
        parts = {
            "validation": InteractionTensors.from_dataset(data, split.validation, *channels),
            "test": InteractionTensors.from_dataset(*test_set, *channels),
        }
        plane = xy_columns(channels[1])
        for columns in (plane, *([k] for k in range(len(channels[1])) if k not in plane)):
            channel = ", ".join(channels[1][k] for k in columns)
            residuals = {test: _residuals(model, a, columns) for test, a in parts.items()}
            for fit in fits(*residuals["validation"]):
                for test, (residual, std) in residuals.items():
                    row = {"model": name, "channel": channel, "fit": fit.name}
                    row |= {"test": test, "n": len(parts[test])}
                    unit = "rad" if channel == "yaw" else "m"
                    rows.append(row | coverage_columns(fit, residual, std, unit))
    return rows


def coverage_columns(fit: Fit, residual: np.ndarray, std: np.ndarray, unit: str) -> dict[str, Any]:
    """Coverage of the central intervals, half the mean width of the wider, NLL per value."""
    distribution = fit.distribution
    half = {level: float(distribution.ppf(0.5 + level / 2)) for level in LEVELS}
    return {
        "scale": fit.scale,
        "degrees_of_freedom": None if math.isinf(fit.freedom) else fit.freedom,
        **{f"coverage_{v:.0%}"[:-1]: float((np.abs(residual) <= half[v]).mean()) for v in LEVELS},
        **{
            f"half_width_90_mean_{u}": half[0.9] * float(std.mean()) if u == unit else None
            for u in ("m", "rad")
        },
        "nll": float((np.log(std) - distribution.logpdf(residual)).mean()),
    }
