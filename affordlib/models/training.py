"""Training: one plain loop over batches of trajectories, with early stopping (Section 3.2).

The paper draws one trajectory and one target an iteration; here many trajectories, each with many
targets, share a step, some 200 times as many targets a second. `train_literal` is the paper's loop,
for comparison.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import asdict, astuple, dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import xarray as xr
from tqdm.auto import tqdm

from affordlib.geometry import xy_columns
from affordlib.interactions.dataset import (
    InteractionTensors,
    Scaler,
    Split,
    Symmetry,
    augment_by_symmetry,
)
from affordlib.interactions.sampling import (
    Batch,
    condition_on_recorded_action,
    sample_literal,
    sample_mixed,
)
from affordlib.models.calibration import fit_temperature
from affordlib.models.checkpoint import build, load_state, save_state
from affordlib.models.cnp import CNPConfig
from affordlib.models.lstm import LSTMNetwork, courses
from affordlib.models.network import EffectNetwork, NetworkConfig
from affordlib.types import check_count, check_field, check_within

Draw = Callable[[InteractionTensors, int, int, torch.Generator], Batch]
Score = Callable[["EffectNetwork", InteractionTensors], torch.Tensor]
_AUTO = "cuda" if torch.cuda.is_available() else "cpu"


@dataclass(frozen=True)
class TrainingConfig:
    """How to train: steps and sizes; the σ floor falls from the model's to `final_sigma_floor`.

    beta: see `EffectNetwork.loss`. The floor stays for the first `hold_floor` of the steps. augment
    turns and mirrors: each batch holds all eight images of the square in equal shares. ema: decay
    of the running mean of the weights, which is what is validated and kept; 0 for none. patience
    counts validations (one every `validate_every` steps) without improvement. max_minutes bounds
    wall time. device: as of torch, or "auto" for a GPU where there is one.
    """

    steps: int = 3000
    batch_size: int = 64
    n_targets: int = 16
    obs_max: int = 10
    learning_rate: float = 1e-3
    weight_decay: float = 0.0
    beta: float = 0.0
    final_sigma_floor: float = 0.02
    hold_floor: float = 0.0
    augment: bool = True
    ema: float = 0.0
    validate_every: int = 100
    patience: int = 10
    max_minutes: float = math.inf
    device: str = "auto"
    seed: int = 0

    def __post_init__(self) -> None:
        for name in ("steps", "validate_every", "patience"):
            check_count(name, getattr(self, name))
        for name in ("batch_size", "n_targets", "obs_max"):
            check_count(name, getattr(self, name), 1, 100_000)
        check_count("seed", self.seed, 0, 2**63 - 1)
        check_field(self, "learning_rate", 1e-7, 1.0)
        check_field(self, "weight_decay", 0.0, 10.0)
        check_field(self, "beta", 0.0, 1.0)
        check_field(self, "final_sigma_floor", 1e-6, 10.0)
        check_field(self, "hold_floor", 0.0, 1.0)
        check_field(self, "ema", 0.0, 0.99999)
        device_named(self.device)
        if not self.max_minutes > 0:
            raise ValueError(f"max_minutes must be positive, got {self.max_minutes!r}")

    def rate(self, step: int) -> float:
        """The learning rate at a step: it rises for a tenth of them, then falls as a cosine."""
        share = (step - 0.5) / self.steps
        rising = share / 0.1
        falling = (1 + math.cos(math.pi * (share - 0.1) / 0.9)) / 2
        return self.learning_rate * (rising if share < 0.1 else falling)

    def sigma_floor(self, step: int, first: float) -> float:
        """The floor at a step, falling geometrically from `first`."""
        share = max(0.0, step / self.steps - self.hold_floor) / (1 - min(self.hold_floor, 0.99))
        return first * (self.final_sigma_floor / first) ** min(1.0, share)


@dataclass(frozen=True)
class TrainingRecord:
    """One line of a training's history; the error is the mean score, in the score's own unit."""

    step: int
    seconds: float
    loss: float
    validation_error: float


def device_named(name: str) -> torch.device:
    """The torch device of a name; "auto" is a GPU where there is one, or else the processor."""
    try:
        return torch.device(_AUTO if name == "auto" else name)
    except RuntimeError:
        raise ValueError(f'device must be "auto" or as "cpu" or "cuda", got {name!r}') from None


@torch.no_grad()
def final_errors_m(model: EffectNetwork, arrays: InteractionTensors) -> torch.Tensor:
    """Distance (N,) [m] between predicted and true (x, y) at t = 1, given image and action.

    Where x and y are not predicted, that of what is (z [m], yaw [rad]).
    """
    was_training = model.training
    model.eval()
    t_target = torch.ones(len(arrays), 1)
    prediction = model.predict(
        model.encode(arrays.image), condition_on_recorded_action(arrays), t_target
    )
    model.train(was_training)
    plane = xy_columns(arrays.effect_channels) or list(range(len(arrays.effect_channels)))
    return (prediction.effect_mean[:, 0, plane] - arrays.effect[:, -1, plane]).norm(dim=-1)


def _to(batch: Any, device: torch.device) -> Any:
    """The same batch or observations on a device."""
    moved = {}
    for field in fields(batch):
        value = getattr(batch, field.name)
        moved[field.name] = value.to(device) if torch.is_tensor(value) else _to(value, device)
    return replace(batch, **moved)


def _augmented(arrays: InteractionTensors) -> InteractionTensors:
    """The interactions turned and mirrored in all eight ways, in turn."""
    eighths = torch.arange(len(arrays)).tensor_split(8)
    parts = [
        arrays.select(rows).rotated_and_mirrored(k // 2, mirror=k % 2 == 1)
        for k, rows in enumerate(eighths)
    ]
    return parts[0].joined(*parts[1:])


class _Run:
    """What a training is made of, between two steps; saved and loaded as one."""

    def __init__(self, model: EffectNetwork, config: TrainingConfig, about: dict[str, Any]) -> None:
        self.model, self.config = model, config
        self.about = about | asdict(replace(config, max_minutes=math.inf, device="cpu"))
        self.generator = torch.Generator().manual_seed(config.seed)
        self.optimiser = torch.optim.AdamW(
            model.parameters(), config.learning_rate, weight_decay=config.weight_decay, fused=True
        )
        self.mean = {k: v.clone() for k, v in model.state_dict().items()}
        self.best, self.best_state, self.best_floor = math.inf, self.mean, model.sigma_floor
        self.step, self.waited, self.seconds = 0, 0, 0.0
        self.history: list[TrainingRecord] = []

    _PLAIN = ("mean", "best", "best_state", "best_floor", "step", "waited", "seconds", "about")

    def save(self, path: Path) -> None:
        state = {name: getattr(self, name) for name in self._PLAIN} | {
            "model": self.model.state_dict(),
            "optimiser": self.optimiser.state_dict(),
            "generator": self.generator.get_state(),
            "history": [astuple(record) for record in self.history],
        }
        save_state(path, state)

    def load(self, path: Path) -> None:
        state = load_state(path)
        if state["about"] != self.about:
            differ = [k for k in self.about if state["about"].get(k) != self.about[k]]
            raise ValueError(
                f"checkpoint {path} is of a training with other {', '.join(differ)}; delete it, or "
                "train as it was begun"
            )
        for name in self._PLAIN:
            setattr(self, name, state[name])
        device = self.model.action_scale.device
        for weights in (self.mean, self.best_state):
            weights |= {name: value.to(device) for name, value in weights.items()}
        self.model.load_state_dict(state["model"])
        self.optimiser.load_state_dict(state["optimiser"])
        self.generator.set_state(state["generator"])
        self.history = [TrainingRecord(*record) for record in state["history"]]


def train(
    model: EffectNetwork,
    training: InteractionTensors,
    validation: InteractionTensors,
    config: TrainingConfig | None = None,
    progress: bool = True,
    checkpoint: str | Path | None = None,
    draw: Draw = sample_mixed,
    score: Score = final_errors_m,
) -> list[TrainingRecord]:
    """Train a model in place and return its history; it ends with the best validated weights.

    draw: makes a batch of context and targets, as `sample_mixed`. Early stopping watches the mean
    of score, by default of the final position errors, on the validation interactions.
    checkpoint: a file, written at every validation, from which the same call continues; on one
    machine's processor to the same bits as without the break.
    """
    config = config or TrainingConfig()
    for name, arrays in (("training", training), ("validation", validation)):
        if len(arrays) == 0:
            raise ValueError(f"{name} holds no interactions")
    device = device_named(config.device)
    model.to(device).train()
    first_floor = model.config.sigma_floor
    about = {
        "model": repr(model.config),
        "data": [_fingerprint(arrays) for arrays in (training, validation)],
        "draw and score": [getattr(of, "__name__", type(of).__name__) for of in (draw, score)],
    }
    run = _Run(model, config, about)
    if checkpoint is not None and Path(checkpoint).exists():
        run.load(Path(checkpoint))
    start = time.perf_counter() - run.seconds
    with tqdm(
        total=config.steps, initial=run.step, desc="training", unit=" steps", disable=not progress
    ) as bar:
        while run.step < config.steps and run.waited < config.patience:
            run.step += 1
            model.sigma_floor = config.sigma_floor(run.step, first_floor)
            for group in run.optimiser.param_groups:
                group["lr"] = config.rate(run.step)
            rows = torch.randint(0, len(training), (config.batch_size,), generator=run.generator)
            arrays = training.select(rows)
            batch = draw(
                _augmented(arrays) if config.augment else arrays,
                config.n_targets,
                config.obs_max,
                run.generator,
            )
            loss = _step(model, run.optimiser, _to(batch, device), config.beta)
            if config.ema:
                decay = min(config.ema, run.step / (run.step + 10))
                for name, value in model.state_dict().items():
                    run.mean[name].lerp_(value, 1 - decay)
            bar.update()
            if run.step % config.validate_every and run.step != config.steps:
                continue
            state = {k: v.clone() for k, v in model.state_dict().items()}
            candidate = {k: v.clone() for k, v in run.mean.items()} if config.ema else state
            model.load_state_dict(candidate)
            # Any score will do: like the arrays, the model is on the processor while it is judged.
            error = float(score(model.cpu(), validation).mean())
            model.to(device)
            model.load_state_dict(state)
            run.seconds = time.perf_counter() - start
            run.history.append(TrainingRecord(run.step, run.seconds, float(loss), error))
            bar.set_postfix_str(f"loss {float(loss):.2f}, validation {error:.3g}")
            run.waited += 1
            if error < run.best:
                run.best, run.best_state, run.waited = error, candidate, 0
                run.best_floor = model.sigma_floor
            if checkpoint is not None:
                run.save(Path(checkpoint))
            if run.seconds > 60 * config.max_minutes:
                break
    model.load_state_dict(run.best_state)
    model.sigma_floor = run.best_floor
    model.cpu().eval()
    return run.history


def _fingerprint(arrays: InteractionTensors) -> list[float]:
    of = (arrays.image, arrays.action, arrays.effect)
    return [len(arrays), *(float(values.double().sum()) for values in of)]


def _step(
    model: EffectNetwork, optimiser: torch.optim.Optimizer, batch: Batch, beta: float
) -> torch.Tensor:
    loss = batch_loss(model, batch, beta)
    optimiser.zero_grad(set_to_none=True)
    loss.backward()
    torch.nn.utils.clip_grad_norm_(model.parameters(), 1.0)
    optimiser.step()
    return loss.detach()


def batch_loss(model: EffectNetwork, batch: Batch, beta: float = 0.0) -> torch.Tensor:
    """Mean negative log-likelihood of a batch's targets; for beta see `EffectNetwork.loss`."""
    b = batch
    return model.loss(b.image, b.observations, b.t_target, b.action, b.effect, beta)


def train_literal(
    model: EffectNetwork,
    training: InteractionTensors,
    iterations: int = 1_000_000,
    obs_max: int = 10,
    learning_rate: float = 1e-4,
    seed: int = 0,
    validation: InteractionTensors | None = None,
    validate_every: int = 1000,
    patience: int = 20,
) -> list[float]:
    """The paper's loop (Section 3.2): one trajectory and one target an iteration, Adam.

    Trains in place and returns the losses. A million iterations, as in the paper, take hours.
    With validation interactions it stops early, after `patience` validations without a smaller
    final error, and the model ends with the weights of the smallest.
    """
    check_count("iterations", iterations)
    check_count("obs_max", obs_max, 1, 100_000)
    check_count("validate_every", validate_every)
    check_count("patience", patience)
    check_within("learning_rate", learning_rate, 1e-7, 1.0)
    generator = torch.Generator().manual_seed(check_count("seed", seed, 0, 2**63 - 1))
    optimiser = torch.optim.Adam(model.parameters(), lr=learning_rate)
    losses, best, waited = [], math.inf, 0
    state = model.state_dict()
    for number in range(1, iterations + 1):
        loss = batch_loss(model, sample_literal(training, obs_max, generator))
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        losses.append(loss.item())
        if validation is None or (number % validate_every and number != iterations):
            continue
        error, waited = float(final_errors_m(model, validation).mean()), waited + 1
        if error < best:
            best, waited = error, 0
            state = {k: v.clone() for k, v in model.state_dict().items()}
        if waited == patience:
            break
    model.load_state_dict(state)
    return losses


def train_model(
    data: xr.Dataset,
    split: Split,
    config: TrainingConfig,
    model_config: NetworkConfig | None = None,
    progress: bool = True,
    symmetries: tuple[Symmetry, ...] = (),
    checkpoint: str | Path | None = None,
    draw: Draw = sample_mixed,
) -> tuple[EffectNetwork, list[TrainingRecord]]:
    """A network (default: the paper's), trained on a split's training part.

    Its validation part stops the training and calibrates σ. symmetries: see `augment_by_symmetry`;
    checkpoint, draw: see `train`.
    """
    model_config = model_config or CNPConfig()
    channels = model_config.action_channels, model_config.effect_channels
    training = InteractionTensors.from_dataset(data, split.train, *channels)
    validation = InteractionTensors.from_dataset(data, split.validation, *channels)
    if symmetries:
        training = augment_by_symmetry(training, symmetries)
    torch.manual_seed(config.seed)
    model = build(model_config, Scaler.fit(training))
    if isinstance(model, LSTMNetwork):
        model.fit_course(courses(model, training))
    history = train(model, training, validation, config, progress, checkpoint, draw)
    fit_temperature(model, validation)
    return model, history


def about_training(data: xr.Dataset, seen: np.ndarray, config: TrainingConfig) -> dict[str, object]:
    """What a checkpoint says of its training: data set, interactions seen, settings."""
    settings = {k: v for k, v in vars(config).items() if k != "max_minutes"}
    return {
        "recipe": data.attrs["recipe"],
        "seen_interactions": sorted(int(i) for i in data["interaction"].values[seen]),
        "training": settings,
    }
