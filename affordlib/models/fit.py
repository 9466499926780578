"""Fit a model to a user's own log: `fit` returns one that predicts where pushes move the object.

The recipes work from some 35 pushes on. An outcome has three columns: displacement x, y [m] and
rotation [rad], in the object's frame at the start.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable
from dataclasses import replace
from typing import Protocol, runtime_checkable

import numpy as np
import torch
from torch import Tensor

from affordlib.geometry import cross
from affordlib.interactions.dataset import InteractionTensors, Scaler
from affordlib.interactions.log import PushLog
from affordlib.interactions.sampling import sample_forward
from affordlib.models.base import EffectNetwork
from affordlib.models.calibration import effects_at, fit_sigma_scale
from affordlib.models.checkpoint import build
from affordlib.models.cnp import CNPConfig
from affordlib.models.film import FiLMConfig
from affordlib.models.neural_process import (
    FEET,
    NeuralProcess,
    in_contact_frame,
    load_neural_process,
    train_neural_process,
)
from affordlib.models.quasi_static import quarter_turn
from affordlib.models.training import TrainingConfig, train
from affordlib.types import check_choice, check_count

INNER_FOLDS = 3
FEW, MOST_CONTEXT = 100, 64
EFFORT = {"few": (100, 1e-4, 8), "many": (600, 3e-4, 8)}
"""Fine-tuning on fewer than `FEW` pushes or on more: steps, learning rate, tasks per step."""
NETWORK_TRAINING = TrainingConfig(
    steps=600,
    batch_size=32,
    n_targets=2,
    beta=0.5,
    weight_decay=0.1,
    final_sigma_floor=0.02,
    ema=0.98,
)
_PRIOR = 20.0


@runtime_checkable
class PushModel(Protocol):
    """A model that predicts the outcomes of pushes."""

    def predict(self, pushes: PushLog) -> tuple[np.ndarray, np.ndarray]:
        """Mean and σ (n, 3) of displacement [m] and rotation [rad], in the object's frame."""
        ...


def gyration_radius_m(outline_m: np.ndarray) -> float:
    """Radius of gyration [m] of a polygon (k, 2) about its centroid, the origin."""
    following = np.roll(outline_m, -1, axis=0)
    area = cross(outline_m, following)
    squares = (outline_m**2 + outline_m * following + following**2).sum(axis=1)
    return math.sqrt((area * squares).sum() / (6 * area.sum()))


def push_rows(pushes: PushLog) -> Tensor:
    """Pushes (n, 10) as rows for `neural_process` and `quasi_static`, the outcome last."""
    scale = gyration_radius_m(pushes.outline_m)
    lengths = (pushes.contact_m / scale, pushes.length_m[:, None] / scale)
    outcome = (pushes.displacement_m / scale, pushes.turn_rad[:, None])
    parts = (lengths[0], pushes.normal, pushes.direction, lengths[1], *outcome)
    return torch.from_numpy(np.concatenate(parts, axis=1)).float()


def told_feet(pushes: PushLog) -> Tensor:
    """Known feet (n, 12, 3) in units of the radius of gyration; (n, 0, 3) where none are known.

    They come from `context["feet"]`, (n, k, 3): x, y [m] and share of the weight; k at most 12.
    """
    feet = torch.zeros(len(pushes), FEET if "feet" in pushes.context else 0, 3)
    if feet.shape[1]:
        known = np.asarray(pushes.context["feet"], dtype=np.float32)
        if known.ndim != 3 or known.shape[2] != 3 or known.shape[1] > FEET:
            raise ValueError(f"context feet must be (n, up to {FEET}, 3), got {known.shape}")
        feet[:, : known.shape[1]] = torch.from_numpy(known)
        feet[..., :2] /= gyration_radius_m(pushes.outline_m)
    return feet


class FittedNeuralProcess:
    """The pretrained neural process, fine-tuned on a log, which is also its context.

    The context of a query are the log's pushes of the same group; an unknown group has none. Each
    of `INNER_FOLDS` copies is fine-tuned on all but one fold of the log. Predictions are the mean
    over the copies; their residuals on the held-out folds scale σ.
    """

    def __init__(self, data: PushLog, seed: int = 0) -> None:
        self.rows, self.groups = push_rows(data), data.groups
        self.fold = folds_of(data.groups, INNER_FOLDS, seed)
        self.members = [self._tuned(data, k, seed) for k in range(INNER_FOLDS)]
        off = [self._off(data, k) for k in range(INNER_FOLDS)]
        self.sigma_scale = sigma_scale(torch.cat(off))

    def _tuned(self, data: PushLog, fold: int, seed: int) -> NeuralProcess:
        """A copy of the pretrained network, fine-tuned on all folds but one."""
        kept = self.fold != fold
        names = [g for g in np.unique(self.groups) if (kept & (self.groups == g)).sum() > 1]
        model = copy.deepcopy(load_neural_process())
        if names:
            tasks = [self.rows[kept & (self.groups == g)] for g in names]
            feet = told_feet(data)
            feet = torch.stack([feet[kept & (self.groups == g)][0] for g in names])
            effort = EFFORT["few" if len(data) < FEW else "many"]
            generator = torch.Generator().manual_seed(seed)
            train_neural_process(model, tasks, feet, effort, generator)
        return model

    def _off(self, data: PushLog, fold: int) -> Tensor:
        """Residuals of a fold, in units of σ."""
        held = data.select(self.fold == fold)
        mean, std = self._predicted(held, self.members[fold], self.fold != fold)
        rows = push_rows(held)
        return (in_contact_frame(rows, rows[:, 7:]) - mean) / std

    def _predicted(
        self, pushes: PushLog, model: NeuralProcess, kept: np.ndarray
    ) -> tuple[Tensor, Tensor]:
        """Mean and σ (n, 3) in the contact frames, given the kept part of the log as context."""
        rows, feet = push_rows(pushes), told_feet(pushes)
        mean, std = torch.zeros(len(rows), 3), torch.zeros(len(rows), 3)
        for group in np.unique(pushes.groups):
            of_group, known = pushes.groups == group, np.flatnonzero(kept & (self.groups == group))
            few = np.linspace(0, len(known) - 1, min(len(known), MOST_CONTEXT)).round().astype(int)
            query = torch.from_numpy(of_group)
            mean[query], std[query] = model.predict(
                rows[query, :7], self.rows[known[few]], feet[query][0]
            )
        return mean, std

    def predict(self, pushes: PushLog) -> tuple[np.ndarray, np.ndarray]:
        """Mean and σ (n, 3) of displacement [m] and rotation [rad], in the object's frame."""
        every = np.ones(len(self.rows), dtype=bool)
        means, stds = zip(*(self._predicted(pushes, m, every) for m in self.members), strict=True)
        mean = torch.stack(means).mean(0)
        std = torch.stack(stds).mean(0) * self.sigma_scale
        return in_object_frame(pushes, mean, std)

    def given(self, pushes: PushLog) -> FittedNeuralProcess:
        """The same model with more pushes as context, of an object like that of the log."""
        more = copy.copy(self)
        more.rows = torch.cat([self.rows, push_rows(pushes)])
        more.groups = np.concatenate([self.groups, pushes.groups])
        return more


class FittedNetwork:
    """One of the book's networks trained from scratch on a log: FiLM in the push frame, or CNP.

    Inputs are the image of the outline, the tool's path and, as further action channels, what
    `context` holds. Rotation and reflection augmentation is used only without `context`, whose
    values need not be symmetric. A fifth of the pushes serves for validation and for scaling σ.
    """

    def __init__(self, data: PushLog, name: str, seed: int = 0) -> None:
        self.like, self.crop_width_m = data, data.crop_width_m
        arrays = self._tensors(data)
        channels = {"action_channels": arrays.action_channels, "effect_channels": ("x", "y", "yaw")}
        config = FiLMConfig(**channels) if name == "film" else CNPConfig(**channels)
        fold = torch.from_numpy(folds_of(data.groups, 5, seed))
        train_on, validate_on = arrays.select(fold > 0), arrays.select(fold == 0)
        torch.manual_seed(seed)
        self.network = build(config, Scaler.fit(train_on))
        steps = NETWORK_TRAINING.steps if name == "film" else 250  # its convolutions take longer
        training = replace(NETWORK_TRAINING, steps=steps, augment=not data.context, seed=seed)
        score = _relative_errors(gyration_radius_m(data.outline_m))
        train(self.network, train_on, validate_on, training, sampler=sample_forward, score=score)
        fit_sigma_scale(self.network, validate_on, (1.0,))

    def _tensors(self, pushes: PushLog) -> InteractionTensors:
        """The log as tensors for the networks, its context as further channels of the action."""
        if pushes.crop_width_m != self.crop_width_m:
            raise ValueError(
                f"crop_width_m is {pushes.crop_width_m:g} m, the model was trained on images of "
                f"{self.crop_width_m:g} m; create the log with that width"
            )
        arrays, columns = pushes.interaction_tensors(), []
        for name, known in self.like.context.items():
            values = pushes.context.get(name, np.zeros((len(pushes), *known.shape[1:])))
            if known.dtype.kind in "US":
                columns.append(values[:, None] == np.unique(known))
            else:
                columns.append(np.asarray(values).reshape(len(pushes), -1))
        told = torch.from_numpy(np.hstack(columns).astype(np.float32)) if columns else None
        if told is None:
            return arrays
        told = told[:, None].expand(-1, arrays.action.shape[1], -1)
        names = tuple(f"told_{i}" for i in range(told.shape[-1]))
        action = torch.cat([arrays.action, told], -1)
        return replace(arrays, action=action, action_channels=(*arrays.action_channels, *names))

    @torch.no_grad()
    def predict(self, pushes: PushLog) -> tuple[np.ndarray, np.ndarray]:
        """Mean and σ (n, 3) of displacement [m] and rotation [rad], in the object's frame."""
        _, mean, std = effects_at(self.network, self._tensors(pushes), (1.0,))
        return mean[:, 0].double().numpy(), std[:, 0].double().numpy()


def _relative_errors(radius_m: float) -> Callable[[EffectNetwork, InteractionTensors], Tensor]:
    """Score for early stopping [m]: position error plus rotation error times the radius."""

    def score(network, tensors):
        truth, mean, _ = effects_at(network, tensors, (1.0,))
        off = (truth - mean)[:, 0]
        return off[:, :2].norm(dim=-1) + radius_m * off[:, 2].abs()

    return score


def in_object_frame(pushes: PushLog, mean: Tensor, std: Tensor) -> tuple[np.ndarray, np.ndarray]:
    """Convert outcomes (n, 3) from contact frames and unit lengths to object frame and metres."""
    normal = torch.from_numpy(pushes.normal).float()
    axes = torch.stack([normal, quarter_turn(normal)], 1)
    metres = gyration_radius_m(pushes.outline_m)
    xy = (mean[:, None, :2] @ axes)[:, 0] * metres
    spread = (std[:, None, :2].square() @ axes.square())[:, 0].sqrt() * metres
    both = torch.cat([xy, mean[:, 2:]], 1), torch.cat([spread, std[:, 2:]], 1)
    return both[0].double().numpy(), both[1].double().numpy()


def sigma_scale(off: Tensor) -> Tensor:
    """Factors (3,) on σ that match the 50 and 90 % intervals of residuals (n, 3), in units of σ.

    x and y share one factor. Factors are shrunk towards 1 with the weight of 20 residuals.
    """
    factors = []
    for z in (off[:, :2].abs().flatten(), off[:, 2].abs()):
        found = (z.quantile(0.5) / 0.6745).log() + (z.quantile(0.9) / 1.6449).log()
        factors.append((found / 2 * len(z) / (len(z) + _PRIOR)).exp())
    return torch.stack([factors[0], *factors])


def folds_of(groups: np.ndarray, k: int, seed: int) -> np.ndarray:
    """Fold (n,) of each push, drawn at random within its group."""
    rng, fold = np.random.default_rng(seed), np.zeros(len(groups), dtype=int)
    for group in np.unique(groups):
        of_group = groups == group
        fold[of_group] = rng.permutation(of_group.sum()) % k
    return fold


def fit(data: PushLog, model: str = "np", seed: int = 0) -> PushModel:
    """Fit a model to a log: "np", "film" or "cnp"; 40 pushes take 6 to 20 s on one core.

    "np" is the pretrained neural process, fine-tuned; the others are the book's own networks.
    Raises ValueError for an unknown name, and for fewer than eight pushes in all.
    """
    check_choice("model", model, MODELS)
    if len(data) < 8:
        raise ValueError(f"data must hold at least 8 interactions to learn from, got {len(data)}")
    return MODELS[model](data, check_count("seed", seed, 0, 2**31))


MODELS = {
    "np": FittedNeuralProcess,
    "film": lambda data, seed: FittedNetwork(data, "film", seed),
    "cnp": lambda data, seed: FittedNetwork(data, "cnp", seed),
}
