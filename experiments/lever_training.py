"""Training of lever-up models for the protocols of Table 1.

A conditional network is trained once for all protocols, a recurrent one separately for each.
"""

from dataclasses import dataclass, replace
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from affordlib.interactions import InteractionTensors
from affordlib.interactions.dataset import Batch, condition_on_poses
from affordlib.models import CNPConfig, EffectNetwork, NetworkConfig
from affordlib.models.lever_up import (
    LEVER_ACTION_CHANNELS,
    N_OBSERVED,
    N_PREDICTED,
    POSE_CHANNELS,
    errors_m,
    predict_steps,
    window_errors_m,
)
from affordlib.models.training import TrainingConfig, TrainingRecord, train, untrained
from experiments.last_pose import CNPAroundMeanConfig, LastPoseConfig
from experiments.lstm import LSTMConfig
from experiments.published import PUBLISHED, ConstantRate, one_at_a_time

Symmetry = tuple[int, bool]  # the number of rotations by π/2, and whether y is mirrored first


def from_start_errors_m(model: EffectNetwork, tensors: InteractionTensors) -> Float[Tensor, "n t"]:
    """Errors [m] at all steps after the first, given only the image and the action."""
    return errors_m(*predict_steps(model, tensors, "image_only"))


def augment_by_symmetry(
    arrays: InteractionTensors, symmetries: tuple[Symmetry, ...]
) -> InteractionTensors:
    """Augment interactions of a primitive without direction parameters by rotation and reflection.

    Image and effect are rotated and mirrored; the commanded action is unchanged.
    """
    parts = [replace(arrays.rotated_and_mirrored(*s), action=arrays.action) for s in symmetries]
    return parts[0].joined(*parts[1:]) if parts else arrays


MIRRORED: tuple[Symmetry, ...] = ((0, False), (0, True))
"""Reflection augmentation: a lever-up and its mirror image in y (see `augment_by_symmetry`)."""

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
    "cnp_tuned": LeverModel(
        CNPAroundMeanConfig(**_CHANNELS), replace(TRAINING, learning_rate=2e-3)
    ),
    "cnp_published": LeverModel(
        CNPConfig(**_CHANNELS), replace(PUBLISHED, steps=350_000, obs_max=N_OBSERVED), "wide"
    ),
    "lstm_tuned": LeverModel(
        LSTMConfig(**_CHANNELS, **_IMAGE), replace(TRAINING, learning_rate=2e-3)
    ),
}
"""Our network, the paper's (on 48×48 images as in its appendix), the paper's tuned, by its own
recipe, and the tuned recurrent network.

Without the recipe, all train for the same number of steps; those of the paper's network cost three
times as much. Rates: see `SETTINGS` of `experiments/lever_up.py`."""


def sample_windows(
    tensors: InteractionTensors, n_targets: int, obs_max: int, generator: torch.Generator
) -> Batch:
    """Sample windows of obs_max observed samples followed by n_targets targets."""
    latest = len(tensors.phase) - obs_max - n_targets
    start = torch.randint(0, latest + 1, (len(tensors),), generator=generator)
    target_at = start[:, None] + obs_max + torch.arange(n_targets)
    return Batch.of(tensors, condition_on_poses(tensors, start, obs_max), target_at)


def sample_from_start(
    tensors: InteractionTensors, n_targets: int, obs_max: int, generator: torch.Generator
) -> Batch:
    """Use all samples after the first as targets; observe the first pose in half of the batches."""
    n_poses = int(torch.randint(0, 2, (1,), generator=generator))
    start = torch.zeros(len(tensors), dtype=torch.long)
    target_at = torch.arange(1, len(tensors.phase))
    return Batch.of(tensors, condition_on_poses(tensors, start, n_poses), target_at)


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

    The training part is joined by its mirror image, except by the paper's own recipe. Early
    stopping uses the validation errors of the protocols that it is trained for.
    """
    network, (sampler, score) = lever.network, TRAINED_FOR[trained_for]
    if isinstance(lever.training, ConstantRate):
        sampler = one_at_a_time
    else:
        training = augment_by_symmetry(training, MIRRORED)
    if hasattr(network, "steps"):
        network = replace(network, steps=len(training.phase) - 1)
    model = untrained(network, training, lever.training.seed)
    how = lever.training, resume_checkpoint, sampler, score
    return model, train(model, training, validation, *how)


LEVER_CHECKPOINTS: dict[str, tuple[str, str]] = {
    "lever_up_last_pose_1800": ("cnp_last_pose", "all"),
    "lever_up_lstm_1800_window": ("lstm_tuned", "window"),
    "lever_up_lstm_1800_first_step": ("lstm_tuned", "first_step"),
}
"""Checkpoints of lever-ups: the name in `LEVER_MODELS`, and the protocol it is trained for."""
