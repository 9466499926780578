"""An ablation study of our network: its parts are added one after another."""

from dataclasses import replace
from typing import Any

import numpy as np
import torch
import xarray as xr

from affordlib.interactions import InteractionTensors, Scaler, open_interactions, split_interactions
from affordlib.interactions.dataset import Batch, sample_mixed, valid_interactions
from affordlib.models import EffectNetwork
from affordlib.models.checkpoint import build
from affordlib.models.evaluation import final_errors_m
from affordlib.models.film import FiLMNetwork
from affordlib.models.training import train
from affordlib.types import Observations
from experiments.published import one_at_a_time
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


LADDER: dict[str, dict[str, Any]] = {
    "channels of unit size": {"scales": _raw},
    "He initialisation": {"start": _plain_start},
    "batches": {"draw": one_at_a_time},
    "contexts at the ends": {"draw": random_contexts},
    "push frame": {"network": {"frame": "table"}},
    "FiLM": {"start": _no_modulation},
    "rotation and reflection augmentation": {"training": {"augment": False}},
    "β": {"training": {"beta": 0.0}},
    "EMA of the weights": {"training": {"ema": 0.0}},
}
"""Parts that are added in turn to the published training, each with the change that reverts it."""

STEPS, SEEDS = 500, 3
SHIPPED = CHECKPOINT_SPECS["film_500"]
ABOUT = (SHIPPED.network, SHIPPED.training, STEPS, SEEDS)


def incremental_ablation() -> Rows:
    """Return errors after short trainings to which the parts of `LADDER` are added in turn.

    They are on validation data: the mean, the least and the largest over seeds.
    """
    rows = []
    for k, name in enumerate(["nothing", *LADDER]):
        each = [error_m(tuple(LADDER)[k:], STEPS, seed) for seed in range(SEEDS)]
        row = {"added": name, "steps": STEPS, "seeds": SEEDS}
        for statistic in (np.mean, np.min, np.max):
            row[f"final_error_{statistic.__name__}_m"] = float(statistic(each))
        rows.append(row)
    return rows


def error_m(without: tuple[str, ...], steps: int, seed: int) -> float:
    """Return the mean final error [m] of the network of `ablated` on its validation data.

    Both categories have the same weight.
    """
    data = open_interactions(SHIPPED.data)
    rows = split_interactions(data.sizes["interaction"], fold=seed).validation
    rows = valid_interactions(data, rows)
    errors = final_errors_m(ablated(without, steps, seed), _tensors(data, rows))
    box = torch.from_numpy(data["category"].values[rows] == 0)
    return float(errors[box].mean() + errors[~box].mean()) / 2


def _tensors(data: xr.Dataset, rows: np.ndarray) -> InteractionTensors:
    """Return pushes with the channels of our network."""
    channels = SHIPPED.network.action_channels, SHIPPED.network.effect_channels
    return InteractionTensors.from_dataset(data, rows, *channels)


def ablated(without: tuple[str, ...], steps: int, seed: int = 0) -> EffectNetwork:
    """Train our network on `push` without some parts of `LADDER`; the seed is also the fold.

    If several of them change the sampler of contexts, the first one is used.
    """
    each = [LADDER[part] for part in without]
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
    training, validation = (_tensors(data, r) for r in (split.train, split.validation))
    torch.manual_seed(seed)
    model = build(network, scales(Scaler.fit(training)))
    for how in each:
        how.get("start", lambda _: None)(model)
    train(model, training, validation, config, sampler=draw)
    return model
