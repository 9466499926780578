"""Training: one plain loop over batches of trajectories, with early stopping (Section 3.2).

The paper draws one trajectory and one target an iteration; here many trajectories, each with many
targets, share a step, which is the same expectation a few hundred times faster.
"""

from __future__ import annotations

import copy
import math
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from tqdm.auto import tqdm

from affordlib.interactions.batches import TrainingArrays, observe_action, sample_batch
from affordlib.types import check_within

if TYPE_CHECKING:
    from affordlib.models.cnp import AffordanceCNP


@dataclass(frozen=True)
class TrainingConfig:
    """How to train: steps and sizes; the σ floor falls from the model's to `final_sigma_floor`.

    augment turns and mirrors each batch at random by quarter turns. patience counts validations
    (one every `validate_every` steps) without improvement. max_minutes bounds wall time.
    """

    steps: int = 3000
    batch_size: int = 64
    n_targets: int = 16
    obs_max: int = 10
    learning_rate: float = 1e-3
    final_sigma_floor: float = 0.02
    augment: bool = True
    validate_every: int = 100
    patience: int = 10
    max_minutes: float = math.inf
    seed: int = 0

    def __post_init__(self) -> None:
        for name in ("steps", "batch_size", "n_targets", "obs_max", "validate_every", "patience"):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int) or value < 1:
                raise ValueError(f"{name} must be a whole number of at least 1, got {value!r}")
        check_within("learning_rate", self.learning_rate, 1e-7, 1.0)
        check_within("final_sigma_floor", self.final_sigma_floor, 1e-6, 10.0)
        if not self.max_minutes > 0:
            raise ValueError(f"max_minutes must be positive, got {self.max_minutes!r}")


@dataclass(frozen=True)
class TrainingRecord:
    """One line of a training's history; errors are final positions, in metres."""

    step: int
    seconds: float
    loss: float
    validation_error_m: float


@torch.no_grad()
def final_errors_m(model: AffordanceCNP, arrays: TrainingArrays) -> torch.Tensor:
    """Distance (N,) [m] between predicted and true (x, y) at t = 1, given image and action."""
    was_training = model.training
    model.eval()
    t_target = torch.ones(len(arrays), 1)
    prediction = model.predict(model.encode(arrays.image), observe_action(arrays), t_target)
    model.train(was_training)
    plane = [arrays.effect_channels.index(name) for name in ("x", "y")]
    return (prediction.effect_mean[:, 0, plane] - arrays.effect[:, -1, plane]).norm(dim=-1)


def train(
    model: AffordanceCNP,
    training: TrainingArrays,
    validation: TrainingArrays,
    config: TrainingConfig | None = None,
    progress: bool = True,
) -> list[TrainingRecord]:
    """Train a model in place and return its history; it ends with the best validated weights.

    Early stopping watches the mean final position error on the validation interactions.
    """
    config = config or TrainingConfig()
    for name, arrays in (("training", training), ("validation", validation)):
        if len(arrays) == 0:
            raise ValueError(f"{name} holds no interactions")
    torch.manual_seed(config.seed)
    generator = torch.Generator().manual_seed(config.seed)
    optimiser = torch.optim.Adam(model.parameters(), lr=config.learning_rate, fused=True)
    schedule = torch.optim.lr_scheduler.OneCycleLR(
        optimiser, config.learning_rate, total_steps=config.steps, pct_start=0.1
    )
    first_floor = model.config.sigma_floor
    history: list[TrainingRecord] = []
    best, best_state, waited = math.inf, copy.deepcopy(model.state_dict()), 0
    start = time.perf_counter()
    model.train()
    with tqdm(total=config.steps, desc="training", unit=" steps", disable=not progress) as bar:
        for step in range(1, config.steps + 1):
            done = step / config.steps
            model.sigma_floor = first_floor * (config.final_sigma_floor / first_floor) ** done
            rows = torch.randint(0, len(training), (config.batch_size,), generator=generator)
            arrays = training.select(rows)
            if config.augment:
                quarters, mirror = torch.randint(0, 4, (2,), generator=generator).tolist()
                arrays = arrays.turned(quarters, mirror % 2 == 1)
            batch = sample_batch(
                arrays, torch.arange(len(rows)), config.n_targets, config.obs_max, generator
            )
            loss = model.loss(
                batch.image, batch.observations, batch.t_target, batch.action, batch.effect
            )
            optimiser.zero_grad(set_to_none=True)
            loss.backward()
            torch.nn.utils.clip_grad_norm_(model.parameters(), 1.0)
            optimiser.step()
            schedule.step()
            bar.update()
            if step % config.validate_every and step != config.steps:
                continue
            seconds = time.perf_counter() - start
            error = float(final_errors_m(model, validation).mean())
            history.append(TrainingRecord(step, seconds, float(loss.detach()), error))
            bar.set_postfix_str(f"validation {error * 1000:.2f} mm")
            if error < best:
                best, best_state, waited = error, copy.deepcopy(model.state_dict()), 0
            else:
                waited += 1
            if waited >= config.patience or seconds > 60 * config.max_minutes:
                break
    model.load_state_dict(best_state)
    model.eval()
    return history
