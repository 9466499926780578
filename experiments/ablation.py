"""Ablation studies of our network: parts removed one at a time, and added one after another."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import torch
import xarray as xr

from affordlib.interactions import (
    InteractionTensors,
    Scaler,
    open_interactions,
    split_interactions,
)
from affordlib.interactions.dataset import Batch, sample_mixed, valid_interactions
from affordlib.models import EffectNetwork
from affordlib.models.base import condition_on_final_effect
from affordlib.models.checkpoint import build
from affordlib.models.evaluation import final_errors_m
from affordlib.models.film import FiLMNetwork
from affordlib.models.training import train
from affordlib.types import Observations
from experiments.runner import Rows
from experiments.shipped import CHECKPOINT_SPECS


def random_contexts(
    arrays: InteractionTensors, n_targets: int, obs_max: int, g: torch.Generator
) -> Batch:
    """As `sample_mixed`, but all context phases are random: none is set to those used to plan."""
    batch = sample_mixed(arrays, n_targets, obs_max, g)
    o, n = batch.observations, len(arrays.phase)
    action_at, effect_at = (torch.randint(n, m.shape, generator=g) for m in (o.action_mask,) * 2)
    action, effect = arrays.action_at(action_at), arrays.effect_at(effect_at)
    seen = Observations.of(arrays, action, effect, o.weight)
    masks = {"action_mask": o.action_mask, "effect_mask": o.effect_mask}
    return replace(batch, observations=replace(seen, **masks))


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


def one_at_a_time(
    arrays: InteractionTensors, n_targets: int, obs_max: int, g: torch.Generator
) -> Batch:
    """Sample one trajectory and one target per step, as in the paper."""
    row = torch.randint(len(arrays), (1,), generator=g)  # any of the batch, augmented or not
    return sample_literal(arrays.select(row), obs_max, g)


def _plain_start(model: FiLMNetwork) -> None:
    """Initialise the image encoder with PyTorch's default instead of He initialisation."""
    for module in model.image_encoder:
        if isinstance(module, torch.nn.Linear):
            module.reset_parameters()


def _no_modulation(model: FiLMNetwork) -> None:
    """Disable the image's modulation of the blocks; the image still enters by the merge layer."""
    for block in model.blocks:
        for parameter in block.modulation.parameters():
            torch.nn.init.zeros_(parameter)
            parameter.requires_grad_(False)


def _raw(scaler: Scaler) -> Scaler:
    """Return scales of one: actions, effects and images are not standardised."""
    return replace(
        scaler,
        action_scale=(1.0,) * len(scaler.action_scale),
        effect_scale=(1.0,) * len(scaler.effect_scale),
        image_mean=(0.0, 0.0),
        image_std=(1.0, 1.0),
    )


CHANGES: dict[str, dict[str, Any]] = {
    "nothing": {},
    "no image": {"image": False},
    "metres, not standardised": {"scales": _raw},
    "table frame": {"network": {"frame": "table"}},
    "no rotation and reflection augmentation": {"training": {"augment": False}},
    "no FiLM: image joined only": {"start": _no_modulation},
    "no EMA of the weights": {"training": {"ema": 0.0}},
    "plain likelihood (β = 0)": {"training": {"beta": 0.0}},
    "PyTorch initialisation": {"start": _plain_start},
    "one trajectory, one target a step": {"draw": one_at_a_time},
    "random contexts only": {"draw": random_contexts},
}
"""Changes to network or training by name."""

LADDER = {
    "channels of unit size": "metres, not standardised",
    "He initialisation": "PyTorch initialisation",
    "batches": "one trajectory, one target a step",
    "contexts at the ends": "random contexts only",
    "push frame": "table frame",
    "FiLM": "no FiLM: image joined only",
    "rotation and reflection augmentation": "no rotation and reflection augmentation",
    "β": "plain likelihood (β = 0)",
    "EMA of the weights": "no EMA of the weights",
}
"""Parts that are added in turn to the published training, each with the change it reverts."""

STEPS, SEEDS = 500, 3
SHIPPED = CHECKPOINT_SPECS["film_500"]
ABOUT = (SHIPPED.network, SHIPPED.training, STEPS, SEEDS)


def ablation() -> Rows:
    """Return errors after short trainings with one change each, on validation data.

    They are means of `errors_m` over seeds. The unchanged network is also tested on `push_test`.
    """
    rows = [{"change": change} | _row([change]) for change in CHANGES]
    return [*rows, {"change": "nothing"} | _row(["nothing"], test=True)]


def incremental_ablation() -> Rows:
    """Return the same for trainings to which the parts of `LADDER` are added one after another."""
    names, changes = ["nothing", *LADDER], list(LADDER.values())
    return [{"added": name} | _row(changes[k:] or ["nothing"]) for k, name in enumerate(names)]


def _row(changes: Sequence[str], test: bool = False) -> dict[str, Any]:
    each_seed = [errors_m(tuple(changes), STEPS, seed, test) for seed in range(SEEDS)]
    n = each_seed[0]["n"] if test else sum(errors["n"] for errors in each_seed)
    row = {"scored_on": "test" if test else "validation", "steps": STEPS, "seeds": SEEDS, "n": n}
    for name in ("final_error", "action_start"):
        for statistic in (np.mean, np.min, np.max):
            over_seeds = statistic([errors[name] for errors in each_seed])
            row[f"{name}_{statistic.__name__}_m"] = float(over_seeds)
    return row


def errors_m(
    changes: tuple[str, ...], steps: int, seed: int, test: bool = False
) -> dict[str, float]:
    """Return mean errors [m] of the network of `ablated`, with equal weights for both categories.

    They are over `n` pushes of its validation data, or of `push_test`. `final_error`: error of
    effects predicted from actions; `action_start`: distance between the start of the recorded push
    and that of the push decoded from its final effect.
    """
    data = open_interactions("push_test" if test else SHIPPED.data)
    n = data.sizes["interaction"]
    rows = np.arange(n) if test else split_interactions(n, fold=seed).validation
    rows = valid_interactions(data, rows)
    model, arrays = ablated(changes, steps, seed), _tensors(data, rows, changes)
    with torch.no_grad():
        observed = condition_on_final_effect(model, arrays.effect[:, -1])
        decoded = model.predict(model.encode(arrays.image), observed, torch.zeros(len(rows), 1))
    start = (decoded.action_mean[:, 0, :2] - arrays.action[:, 0, :2]).norm(dim=-1)
    box = torch.from_numpy(data["category"].values[rows] == 0)
    errors = {"final_error": final_errors_m(model, arrays), "action_start": start}
    means = {k: float(e[box].mean() + e[~box].mean()) / 2 for k, e in errors.items()}
    return means | {"n": len(rows)}


def _tensors(data: xr.Dataset, rows: np.ndarray, changes: Sequence[str]) -> InteractionTensors:
    """Return pushes with the channels of our network, and zero images if that is a change."""
    channels = SHIPPED.network.action_channels, SHIPPED.network.effect_channels
    arrays = InteractionTensors.from_dataset(data, rows, *channels)
    if all(CHANGES[change].get("image", True) for change in changes):
        return arrays
    return replace(arrays, image=torch.zeros_like(arrays.image))


@cache
def ablated(changes: tuple[str, ...], steps: int, seed: int = 0) -> EffectNetwork:
    """Train our network on `push` with some of `CHANGES`; the seed is also the fold.

    If several of them change the sampler of contexts, the first one is used.
    """
    each = [CHANGES[change] for change in changes]
    scales = next((how["scales"] for how in each if "scales" in how), lambda same: same)
    draw = next((how["draw"] for how in each if "draw" in how), sample_mixed)
    options: dict[str, dict[str, Any]] = {
        of: {k: v for how in each for k, v in how.get(of, {}).items()}
        for of in ("training", "network")
    }
    config = replace(SHIPPED.training, steps=steps, seed=seed, **options["training"])
    network = replace(SHIPPED.network, **options["network"])
    data = open_interactions(SHIPPED.data)
    split = split_interactions(data.sizes["interaction"], fold=seed)
    training, validation = (_tensors(data, r, changes) for r in (split.train, split.validation))
    torch.manual_seed(seed)
    model = build(network, scales(Scaler.fit(training)))
    for how in each:
        how.get("start", lambda _: None)(model)
    train(model, training, validation, config, sampler=draw)
    return model
