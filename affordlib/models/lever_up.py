"""Lever-ups: the prediction protocols of Section 4.1 and Table 1, and training for them.

    window      15 poses observed, anywhere in the trajectory; the next 1 to 5 steps predicted
    first_step  the first pose observed; all later steps predicted
    image_only  no pose observed

All models observe the image and the commanded action at t = 0 and t = 1. A pose is the change since
the start, so the first pose is always zero. Therefore first_step contains no more information than
image_only, and one trained network serves both. A conditional network is trained once for all
protocols, a recurrent one separately for each.
"""

from dataclasses import dataclass, replace
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from affordlib.interactions.dataset import InteractionTensors
from affordlib.interactions.lever_up import (
    LEVER_ACTION_CHANNELS,
    N_OBSERVED,
    N_PREDICTED,
    POSE_CHANNELS,
    n_windows,
)
from affordlib.interactions.sampling import (
    Batch,
    condition_on_poses,
    sample_from_start,
    sample_windows,
)
from affordlib.models.base import EffectNetwork, NetworkConfig
from affordlib.models.cnp import CNPConfig
from affordlib.models.film import LastPoseConfig
from affordlib.models.lstm import LSTMConfig
from affordlib.models.training import TrainingConfig, TrainingRecord, train, untrained
from affordlib.types import Prediction, check_choice

PROTOCOLS = ("window", "first_step", "image_only")

_CHANNELS = {"action_channels": LEVER_ACTION_CHANNELS, "effect_channels": POSE_CHANNELS}
TRAINING = TrainingConfig(
    steps=1000, n_targets=N_PREDICTED, obs_max=N_OBSERVED, patience=99, beta=0.5, weight_decay=0.1,
    final_sigma_floor=0.005, ema=0.99, augment=False, validate_every=125,
)  # fmt: skip


@dataclass(frozen=True)
class LeverModel:
    """A network, its training, and which part of the image it sees (see `lever_up_tensors`)."""

    network: NetworkConfig
    training: TrainingConfig = TRAINING
    view: str = "near"


_IMAGE = {"rings": 10, "orders": 12}
LEVER_MODELS: dict[str, LeverModel] = {
    "cnp_last_pose": LeverModel(
        LastPoseConfig(**_CHANNELS, **_IMAGE), replace(TRAINING, learning_rate=4e-3)
    ),
    "cnp": LeverModel(CNPConfig(**_CHANNELS), view="wide"),
    "lstm_tuned": LeverModel(
        LSTMConfig(**_CHANNELS, **_IMAGE), replace(TRAINING, learning_rate=2e-3)
    ),
}
"""Our network, the paper's (on 48×48 images as in its appendix) and the tuned recurrent network.

All train for the same number of steps; those of the paper's network cost three times as much. The
other learning rates minimise validation error (`experiments/lever_cross_validation.py`)."""


@torch.no_grad()
def predict_steps(
    model: EffectNetwork,
    tensors: InteractionTensors,
    protocol: str,
    start: int = 0,
    features: Tensor | None = None,
) -> tuple[Prediction, Float[Tensor, "n t c"]]:
    """Prediction and ground truth at the steps that a protocol queries; start: of the window.

    features: of the images, if already encoded.
    """
    check_choice("protocol", protocol, PROTOCOLS)
    n, last = len(tensors), len(tensors.phase)
    n_poses = {"window": N_OBSERVED, "first_step": 1, "image_only": 0}[protocol]
    first = start + N_OBSERVED if protocol == "window" else 1
    steps = torch.arange(first, first + N_PREDICTED if protocol == "window" else last)
    observed = condition_on_poses(tensors, torch.full((n,), start), n_poses)
    features = model.encode(tensors.image) if features is None else features
    return model.predict(features, observed, tensors.phases(steps)), tensors.effect[:, steps]


def errors_m(prediction: Prediction, truth: Tensor) -> Float[Tensor, "n t"]:
    """Distances [m] between predicted and true positions."""
    return (prediction.effect_mean - truth)[..., :3].norm(dim=-1)


@torch.no_grad()
def window_errors_m(model: EffectNetwork, tensors: InteractionTensors) -> Float[Tensor, "n w t"]:
    """Errors [m] of all windows of all trajectories, 1 to 5 steps ahead."""
    features = model.encode(tensors.image)
    starts = range(n_windows(tensors))
    found = [predict_steps(model, tensors, "window", start, features) for start in starts]
    return torch.stack([errors_m(*one) for one in found], dim=1)


def from_start_errors_m(model: EffectNetwork, tensors: InteractionTensors) -> Float[Tensor, "n t"]:
    """Errors [m] at all steps after the first, given only the image and the action."""
    return errors_m(*predict_steps(model, tensors, "image_only"))


def _sample_all(
    tensors: InteractionTensors, n_targets: int, obs_max: int, generator: torch.Generator
) -> Batch:
    kind = int(torch.randint(0, 2, (1,), generator=generator))
    return (sample_windows, sample_from_start)[kind](tensors, n_targets, obs_max, generator)


def _all_errors_m(model: EffectNetwork, tensors: InteractionTensors) -> Tensor:
    """Window and start errors at about equal weight: the latter are three times as large."""
    window, start = window_errors_m(model, tensors), from_start_errors_m(model, tensors)
    return window.mean(dim=(1, 2)) + start.mean(dim=1) / 3


TRAINED_FOR = {
    "all": (_sample_all, _all_errors_m),
    "window": (sample_windows, window_errors_m),
    "first_step": (sample_from_start, from_start_errors_m),
}
"""Sampler and score of each training; `first_step` also serves `image_only` (see above)."""


def fit_lever_model(
    lever: LeverModel,
    training: InteractionTensors,
    validation: InteractionTensors,
    trained_for: str = "all",
    resume_checkpoint: Path | None = None,
) -> tuple[EffectNetwork, list[TrainingRecord]]:
    """Train a network, with as many steps as a trajectory has, for one protocol or all of them.

    Early stopping uses the validation errors of the protocols that it is trained for.
    """
    trained_for = TRAINED_FOR[check_choice("trained_for", trained_for, TRAINED_FOR)]
    network = lever.network
    if hasattr(network, "steps"):
        network = replace(network, steps=len(training.phase) - 1)
    model = untrained(network, training, lever.training.seed)
    if hasattr(model, "mean_trajectory"):
        model.mean_trajectory.fit(training.effect, model.effect_scale)
    return model, train(
        model, training, validation, lever.training, resume_checkpoint, *trained_for
    )
