"""Training: one plain loop over batches of trajectories, with early stopping (Section 3.2).

The paper uses one trajectory and one target per iteration. Here a step uses many trajectories with
many targets each, some 200 times as many targets per second; `experiments/` has the paper's loop.
"""

import copy
import inspect
import math
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

from affordlib.interactions import Batch, InteractionTensors, Scaler, Split, sample_mixed
from affordlib.interactions.dataset import check_fits
from affordlib.models.base import EffectNetwork, NetworkConfig
from affordlib.models.checkpoint import build, load_state, save_state
from affordlib.models.cnp import CNPConfig
from affordlib.models.domain import TrainingDomain
from affordlib.models.evaluation import final_errors_m, fit_sigma_scale
from affordlib.results import from_root
from affordlib.types import Checked, count, number

if TYPE_CHECKING:
    import xarray

Sampler = Callable[[InteractionTensors, int, int, torch.Generator], Batch]
Score = Callable[[EffectNetwork, InteractionTensors], Tensor]


@dataclass(frozen=True)
class TrainingConfig(Checked):
    """Settings of training, with their ranges."""

    steps: int = count(3000)
    batch_size: int = count(64, 1, 100_000)  # trajectories per step
    n_targets: int = count(16, 1, 100_000)  # target phases per trajectory
    obs_max: int = count(10, 1, 100_000)  # largest number of observations of action, and of effect
    learning_rate: float = number(1e-7, 1.0, default=1e-3)  # its peak, see `rate`
    weight_decay: float = number(0.0, 10.0, default=0.0)  # of AdamW
    beta: float = number(0.0, 1.0, default=0.0)  # see `EffectNetwork.loss`
    final_sigma_floor: float = number(1e-6, 10.0, default=0.02)  # to which the model's decreases
    # Rotate and mirror each batch in eight ways, an eighth of it each; wrong where the hand does
    # not turn with the object, as in a grasp.
    augment: bool = True
    # Decay of the exponential moving average of the weights, which is then validated and kept.
    ema: float = number(0.0, 0.99999, default=0.0)
    validate_every: int = count(100)  # steps
    patience: int = count(10)  # validations without improvement before stopping
    device: str = "auto"  # as in torch; "auto" is the GPU if there is one, else the CPU
    seed: int = count(0, 0, 2**63 - 1)  # of batches and contexts, and of a new network's weights

    def __post_init__(self) -> None:
        super().__post_init__()
        device_named(self.device)

    def rate(self, step: int) -> float:
        """Learning rate at a step: linear rise over a tenth of the steps, then cosine decay."""
        share = (step - 0.5) / self.steps
        falling = (1 + math.cos(math.pi * (share - 0.1) / 0.9)) / 2
        return self.learning_rate * (share / 0.1 if share < 0.1 else falling)

    def sigma_floor(self, step: int, first: float) -> float:
        """σ floor at a step, decreasing geometrically from `first`; a lower `first` stays."""
        return first * (min(self.final_sigma_floor, first) / first) ** (step / self.steps)


@dataclass(frozen=True)
class TrainingRecord:
    """One validation in a training's history; validation_error: mean score, in the score's unit."""

    step: int
    seconds: float
    loss: float
    validation_error: float


def device_named(name: str) -> torch.device:
    """Return the torch device of a name; "auto" is the GPU if there is one, else the CPU."""
    auto = "cuda" if torch.cuda.is_available() else "cpu"
    try:
        return torch.device(auto if name == "auto" else name)
    except RuntimeError:
        raise ValueError(f'device must be "auto", "cpu", "cuda" or alike, got {name!r}') from None


def train(
    model: EffectNetwork,
    training: InteractionTensors,
    validation: InteractionTensors,
    config: TrainingConfig | None = None,
    resume_checkpoint: str | Path | None = None,
    sampler: Sampler = sample_mixed,
    score: Score = final_errors_m,
) -> list[TrainingRecord]:
    """Train a model in place and return its history; the model keeps the best validated weights.

    sampler: draws a batch of contexts and targets. Early stopping uses the mean of score (N,) on
    the validation interactions. resume_checkpoint: a file, written at every validation, from which
    the same call continues to bit-identical results.
    """
    config = config or TrainingConfig()
    for name, function, n in (("sampler", sampler, 4), ("score", score, 2)):
        try:
            inspect.signature(function).bind(*range(n))
        except (TypeError, ValueError) as error:
            raise TypeError(f"{name} must take {n} arguments, got {function!r}: {error}") from None
    for name, tensors in (("training", training), ("validation", validation)):
        if len(tensors) == 0:
            raise ValueError(f"{name} holds no interactions")
        check_fits(name, tensors, model)
    device = device_named(config.device)
    model.to(device).train()
    generator = torch.Generator().manual_seed(config.seed)
    optimiser = torch.optim.AdamW(
        model.parameters(), config.learning_rate, weight_decay=config.weight_decay, fused=True
    )
    floor = float(model.sigma_floor)
    average = {name: v.detach().clone() for name, v in model.named_parameters() if config.ema}
    best, best_error, step, fruitless, seconds, history = {}, math.inf, 0, 0, 0.0, []
    about = asdict(replace(config, device="cpu")) | {  # all that decides the results
        "model": repr(model.config),
        "sampler and score": [getattr(f, "__name__", type(f).__name__) for f in (sampler, score)],
        "data": [
            [len(t), *(float(v.double().sum()) for v in (t.image, t.action, t.effect))]
            for t in (training, validation)
        ],
    }
    if resume_checkpoint and from_root(resume_checkpoint).exists():
        state = load_state(resume_checkpoint, device)
        if differ := [k for k, v in about.items() if state["about"].get(k) != v]:
            raise ValueError(
                f"resume_checkpoint is of a training with other {', '.join(differ)}; delete it, "
                "or use the settings of that training"
            )
        model.load_state_dict(state["model"])
        optimiser.load_state_dict(state["optimiser"])
        generator.set_state(state["random"].cpu())
        floor, average, best, best_error, step, fruitless, seconds, history = state["run"]
    start = time.perf_counter() - seconds
    bar = tqdm(total=config.steps, initial=step, desc="training", unit=" steps", disable=None)
    while step < config.steps and fruitless < config.patience:
        step += 1
        model.sigma_floor.fill_(config.sigma_floor(step, floor))
        optimiser.param_groups[0]["lr"] = config.rate(step)
        rows = torch.randint(0, len(training), (config.batch_size,), generator=generator)
        some = training.select(rows)
        if config.augment:  # an eighth of them in each way
            parts = enumerate(map(training.select, rows.tensor_split(8)))
            some, *others = (p.rotated_and_mirrored(k // 2, k % 2 == 1) for k, p in parts)
            some = some.joined(*others)
        batch = sampler(some, config.n_targets, config.obs_max, generator)
        loss = model.loss(_to(batch, device), config.beta)
        optimiser.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(model.parameters(), 1.0)
        optimiser.step()
        decay = min(config.ema, step / (step + 10))
        for name, value in model.named_parameters() if config.ema else ():
            average[name].lerp_(value.detach(), 1 - decay)
        bar.update()
        if step % config.validate_every and step != config.steps:
            continue
        own = copy.deepcopy(model.state_dict())
        model.load_state_dict(own | average)
        # The model is scored on the CPU, where the data are, so scores can ignore devices.
        error = float(score(model.cpu().eval(), validation).mean())
        fruitless += 1
        if error < best_error:
            best, best_error, fruitless = copy.deepcopy(model.state_dict()), error, 0
        model.to(device).train().load_state_dict(own)
        seconds = time.perf_counter() - start
        history.append((step, seconds, loss.item(), error))
        bar.set_postfix_str(f"loss {loss.item():.2f}, validation {error:.3g}")
        if resume_checkpoint:
            run = floor, average, best, best_error, step, fruitless, seconds, history
            state = {"about": about, "model": own, "optimiser": optimiser.state_dict()}
            save_state(resume_checkpoint, state | {"random": generator.get_state(), "run": run})
    bar.close()
    if not best:
        raise ValueError(
            f"learning_rate {config.learning_rate:g}: no validation error was finite; lower it, or "
            "look for values in the data that are not finite"
        )
    model.load_state_dict(best)
    model.cpu().eval()
    return [TrainingRecord(*record) for record in history]


def _to(batch: Any, device: torch.device) -> Any:
    """Copy a batch or observations to a device."""
    moved = {}
    for name, value in vars(batch).items():
        moved[name] = value.to(device) if torch.is_tensor(value) else _to(value, device)
    return replace(batch, **moved)


def untrained(config: NetworkConfig, training: InteractionTensors, seed: int) -> EffectNetwork:
    """Create a network with seeded weights, and scales and domain from the data."""
    torch.manual_seed(seed)
    model = build(config, Scaler.fit(training), TrainingDomain.fit(training))
    model.prepare(training)
    return model


def train_model(
    data: "xarray.Dataset",
    split: Split,
    config: TrainingConfig,
    model_config: NetworkConfig | None = None,
    augment: Callable[[InteractionTensors], InteractionTensors] = lambda training: training,
    resume_checkpoint: str | Path | None = None,
    sampler: Sampler = sample_mixed,
) -> tuple[EffectNetwork, list[TrainingRecord]]:
    """Train a network (default: the paper's) on the training part of a split.

    The validation part is used for early stopping and to calibrate σ. augment: adds to the training
    data; resume_checkpoint, sampler: see `train`.
    """
    model_config = model_config or CNPConfig()
    channels = model_config.action_channels, model_config.effect_channels
    training = augment(InteractionTensors.from_dataset(data, split.train, *channels))
    validation = InteractionTensors.from_dataset(data, split.validation, *channels)
    model = untrained(model_config, training, config.seed)
    history = train(model, training, validation, config, resume_checkpoint, sampler)
    fit_sigma_scale(model, validation)
    return model, history


def about_training(
    data: "xarray.Dataset", seen: np.ndarray, config: TrainingConfig
) -> dict[str, object]:
    """The record of a training for its checkpoint: data set, interactions seen, settings."""
    return {
        "recipe": data.attrs["recipe"],
        "seen_interactions": sorted(int(i) for i in data["interaction"].values[seen]),
        "training": dict(vars(config)),
    }
