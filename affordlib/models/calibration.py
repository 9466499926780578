"""Calibration of σ: coverage of central intervals, negative log-likelihood, variance scaling.

With a calibrated Gaussian half of the ground truth lies in the central 50 % interval μ ± 0.674 σ.
Variance scaling multiplies σ of an effect channel by s; the maximum-likelihood value is s² = mean
((e - μ) / σ)² (a temperature: Guo et al., On calibration of modern neural networks, ICML 2017).

σ covers the noise in the training data, not the novelty of an object. `Novelty` is the distance of
an image to its nearest training image (Sun et al., Out-of-distribution detection with deep nearest
neighbors, ICML 2022) in circular harmonics, since learned features discard what training did not
need.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from affordlib.geometry import xy_columns
from affordlib.interactions.dataset import InteractionTensors, check_channels
from affordlib.interactions.sampling import condition_on_recorded_action
from affordlib.models.base import EffectNetwork, gaussian_nll
from affordlib.models.harmonics import CircularHarmonics
from affordlib.models.protocol import EffectModel
from affordlib.types import Observations, Prediction, check_within

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
    """Ground truth, mean and σ of the effects, (N, T, C) each, given image and action."""
    phases = [check_within("phases", phase, 0.0, 1.0) for phase in phases]
    if not phases:
        raise ValueError("phases must hold at least one phase in [0, 1], got none")
    check_channels("tensors", tensors, model)
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
    """Set and return the maximum-likelihood sigma_scale (C_e,); x and y share one factor."""
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


NOVELTY_GAIN = 0.0167  # c of `NoveltyAware`, chosen in `experiments/novelty.py`


class Novelty:
    """Distance (N,) of images to their nearest training image, in units of `limit`.

    references: (n, f) spectra of the circular harmonics of training images, which are invariant to
    rotation. limit: 99 % of the references are closer than this to their nearest other reference.
    """

    def __init__(self, references: Float[Tensor, "n f"]) -> None:
        self.references, self.harmonics = references, CircularHarmonics()
        spread = references.std(dim=0).reshape(2, -1)
        # A spread below 1 % of the largest spread of its image channel is pixel noise.
        self.spread = spread.maximum(0.01 * spread.amax(dim=1, keepdim=True)).flatten()
        self.limit = self.distances(references, 2)[:, 1].quantile(0.99)

    @classmethod
    def fit(cls, image: Float[Tensor, "n 2 48 48"]) -> "Novelty":
        """Create it from at most the first 500 training images."""
        return cls(CircularHarmonics().spectrum(image[:500]))

    def distances(self, spectra: Tensor, n: int = 1) -> Tensor:
        """Distances (N, n) to the nearest n references."""
        a, b = spectra / self.spread, self.references / self.spread
        exact = "donot_use_mm_for_euclid_dist"
        return torch.cdist(a, b, compute_mode=exact).topk(n, largest=False).values

    @torch.no_grad()
    def __call__(self, image: Float[Tensor, "n 2 48 48"]) -> Float[Tensor, " n"]:
        return self.distances(self.harmonics.spectrum(image))[:, 0] / self.limit


class NoveltyAware:
    """A model of pushes whose σ grows with an object's novelty; satisfies `EffectModel`.

    σ² grows by (c m s)² n. n: novelty in excess of 1 (0 for known objects); m: predicted distance
    moved, in scales of x and y; s: the scale of the channel; c: `NOVELTY_GAIN`.
    """

    def __init__(self, model: EffectNetwork) -> None:
        if model.novelty is None:
            raise ValueError("model has no novelty; set it to Novelty.fit(training images)")
        self.model, self.novelty = model, model.novelty
        self.action_channels, self.effect_channels = model.action_channels, model.effect_channels

    def encode(self, image: Tensor) -> Tensor:
        """Features (B, F + 1) of images (B, 2, 48, 48): those of the model, and √n."""
        root = (self.novelty(image) - 1).clamp_min(0).sqrt()
        return torch.cat([self.model.encode(image), root[:, None]], dim=1)

    def predict(self, features: Tensor, observations: Observations, t_target: Tensor) -> Prediction:
        """The model's prediction, with σ of the effect increased by novelty."""
        p = self.model.predict(features[:, :-1], observations, t_target)
        plane, scale = xy_columns(self.effect_channels), self.model.effect_scale
        moved = (p.effect_mean[..., plane] / scale[plane]).norm(dim=-1, keepdim=True)
        more = NOVELTY_GAIN * features[:, -1:, None] * moved * scale
        return replace(p, effect_std=torch.hypot(p.effect_std, more))
