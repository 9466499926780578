"""The paper's network trained as published, and on trajectories of fewer samples."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import torch

from affordlib.interactions import InteractionTensors, split_interactions
from affordlib.interactions.sampling import Batch
from affordlib.models import CNPConfig, EffectNetwork
from affordlib.models.checkpoint import load_state, save_state
from affordlib.models.evaluation import final_errors_m
from affordlib.models.training import Score, TrainingConfig, train_model, untrained
from affordlib.results import resolve_out_dir
from affordlib.types import Observations
from experiments.runner import Rows, open_once, study
from experiments.shipped import CHECKPOINT_SPECS

SPEC = CHECKPOINT_SPECS["cnp_500"]
ITERATIONS, SAVE_EVERY = 100_000, 10_000
LITERAL = TrainingConfig(
    steps=1_000_000, learning_rate=1e-4, validate_every=2500, patience=40, augment=False
)
"""The paper's recipe; it stops early, 100,000 steps after its best validation, as we read it."""

_MIXED = replace(SPEC, data="mixed")
OTHER_SEEDS = ("_seed_1", "_seed_2")
OTHER_TRAININGS = {
    f"cnp_mixed_500{name}": replace(_MIXED, training=replace(SPEC.training, seed=seed))
    for seed, name in enumerate(OTHER_SEEDS, 1)
} | {
    "cnp_yaw_mixed_500": replace(_MIXED, network=CNPConfig(effect_channels=("x", "y", "yaw"))),
}
"""Trainings of the paper's network, of pushes and drags, beside the shipped `cnp_mixed_500`."""


def trained(name: str) -> EffectNetwork:
    """Train one of `OTHER_TRAININGS`, once: its finished state is kept in the folder `runs`."""
    spec = OTHER_TRAININGS[name]
    data = open_once(spec.data)
    split = split_interactions(data.sizes["interaction"])
    state = resolve_out_dir("runs/trainings") / f"{name}.state"
    return train_model(data, split, spec.training, spec.network, resume_checkpoint=state)[0]


def sample_literal(tensors: InteractionTensors, obs_max: int, generator: torch.Generator) -> Batch:
    """Sample as in the paper: one trajectory, k observations, k uniform in 1 … obs_max, one target.

    Action and effect are observed at the same phases; w₁ is 1, 0 or uniform in [0, 1] (1/3 each).
    """

    def draw(high, n=1):
        return torch.randint(high, (n,), generator=generator)

    part, last = tensors.select(draw(len(tensors))), len(tensors.phase)
    at, target_at = draw(last, 1 + int(draw(obs_max))), draw(last)
    kind, weight = int(draw(3)), torch.rand(1, generator=generator)
    weight = weight if kind == 2 else torch.tensor([float(kind)])
    observed = Observations.of(part, part.action_at(at), part.effect_at(at), weight)
    return Batch.of(part, observed, target_at)


def train_literal(
    model: EffectNetwork,
    training: InteractionTensors,
    validation: InteractionTensors,
    config: TrainingConfig = LITERAL,
    state: str | Path | None = None,
    score: Score = final_errors_m,
) -> Rows:
    """Train in place with the paper's loop (Section 3.2) and early stopping; return its history.

    A step is one trajectory and one target; a million take hours. The model keeps the weights of
    the best validation. Of config, the numbers of steps, observations, validations and patience,
    the rate and the seed count. state: a file, written every `SAVE_EVERY` steps and at the end,
    from which the same call continues.
    """
    generator = torch.Generator().manual_seed(config.seed)
    optimiser = torch.optim.Adam(model.parameters(), config.learning_rate, fused=True)
    about = [repr(model.config), len(training), config.obs_max, config.learning_rate, config.seed]
    done, history, best = 0, [], {"error": math.inf, "step": 0, "weights": model.state_dict()}
    if state is not None and Path(state).exists():
        saved = load_state(state)
        if saved["about"] != about:
            raise ValueError(f"state {str(state)!r} is of another training; delete it")
        model.load_state_dict(saved["model"])
        optimiser.load_state_dict(saved["optimiser"])
        generator.set_state(saved["generator"])
        done, history, best = (saved[name] for name in ("done", "history", "best"))
    for step in range(done + 1, config.steps + 1):
        if step > best["step"] + config.patience * config.validate_every:
            break
        optimiser.zero_grad()
        loss = model.loss(sample_literal(training, config.obs_max, generator))
        loss.backward()
        optimiser.step()
        if step % config.validate_every == 0 or step == config.steps:
            error = float(score(model, validation).mean())
            history.append({"step": step, "validation_error_m": error})
            if error < best["error"]:
                weights = {name: value.clone() for name, value in model.state_dict().items()}
                best = {"error": error, "step": step, "weights": weights}
        if state is not None and (step % SAVE_EVERY == 0 or step == config.steps):
            parts = {"about": about, "model": model.state_dict(), "done": step, "best": best}
            parts |= {"optimiser": optimiser.state_dict(), "generator": generator.get_state()}
            save_state(state, parts | {"history": history})
    model.load_state_dict(best["weights"])
    model.eval()
    return history


@study("push", settings=(SPEC.network, ITERATIONS, LITERAL.validate_every))
def literal_training() -> Rows:
    """Return validation errors of the paper's network and loop, learning rate 1e-4, on one fold."""
    data = open_once(SPEC.data)
    split = split_interactions(data.sizes["interaction"])
    training = InteractionTensors.from_dataset(data, split.train)
    validation = InteractionTensors.from_dataset(data, split.validation)
    model = untrained(SPEC.network, training, 0).train()
    history = train_literal(model, training, validation, replace(LITERAL, steps=ITERATIONS))
    return [{"recipe": "literal"} | row for row in history]
