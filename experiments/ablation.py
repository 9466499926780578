"""Studies: what each part of our network is worth, left out alone, and added one after another."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from affordlib.interactions import (
    InteractionTensors,
    Scaler,
    open_interactions,
    split_interactions,
)
from affordlib.interactions.sampling import Batch, sample_mixed
from affordlib.models.checkpoint import build
from affordlib.models.film import FiLMNetwork
from affordlib.models.protocol import condition_on_final_effect
from affordlib.models.training import final_errors_m, train
from affordlib.types import Observations
from experiments.literal import sample_literal
from experiments.runner import Rows, study
from experiments.shipped import CHECKPOINT_SPECS


def random_contexts(
    arrays: InteractionTensors, n_targets: int, obs_max: int, g: torch.Generator
) -> Batch:
    """As `sample_mixed`, but no context is at a phase that will be queried: all are random."""
    batch = sample_mixed(arrays, n_targets, obs_max, g)
    o, n = batch.observations, len(arrays.phase)
    action_at, effect_at = (torch.randint(n, m.shape, generator=g) for m in (o.action_mask,) * 2)
    action, effect = arrays.action_at(action_at), arrays.effect_at(effect_at)
    seen = Observations.of(arrays, action, effect, o.weight)
    masks = {"action_mask": o.action_mask, "effect_mask": o.effect_mask}
    return replace(batch, observations=replace(seen, **masks))


def half_blend(arrays: InteractionTensors, *sizes: Any) -> Batch:
    """As `sample_mixed`, but w₁ = ½ wherever both are observed."""
    batch = sample_mixed(arrays, *sizes)
    o = batch.observations
    both = (o.weight > 0) & (o.weight < 1)
    return replace(batch, observations=replace(o, weight=torch.where(both, 0.5, o.weight)))


def actions_only(arrays: InteractionTensors, *sizes: Any) -> Batch:
    """As `sample_mixed`, but only actions are observed: nothing is inferred from effects."""
    batch = sample_mixed(arrays, *sizes)
    o = batch.observations
    first = torch.arange(o.action_mask.shape[1]) == 0
    seen = replace(
        o,
        action_mask=o.action_mask | ~o.action_mask.any(dim=1, keepdim=True) & first,
        effect_mask=torch.zeros_like(o.effect_mask),
        weight=torch.ones_like(o.weight),
    )
    return replace(batch, observations=seen)


def one_at_a_time(
    arrays: InteractionTensors, n_targets: int, obs_max: int, g: torch.Generator
) -> Batch:
    """As in the paper: one trajectory, one target."""
    row = torch.randint(len(arrays), (1,), generator=g)  # any of the batch, rotated or not
    return sample_literal(arrays.select(row), obs_max, g)


def _plain_start(model: FiLMNetwork) -> None:
    """PyTorch's default initialisation instead of He's."""
    for module in model.image_encoder:
        if isinstance(module, torch.nn.Linear):
            module.reset_parameters()


def _no_modulation(model: FiLMNetwork) -> None:
    """Blocks that the image does not modulate; it still enters by the merge layer."""
    for block in model.blocks:
        for parameter in block.modulation.parameters():
            torch.nn.init.zeros_(parameter)
            parameter.requires_grad_(False)


def _raw(scaler: Scaler) -> Scaler:
    """Metres and radians as they are, images too."""
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
    "w₁ = ½": {"draw": half_blend},
    "actions only": {"draw": actions_only},
}
"""What is left out or changed, by name."""

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
"""What is added to the published training until it is ours, and the change it undoes."""

STEPS, SEEDS = 500, 3
SHIPPED = CHECKPOINT_SPECS["film_500"]
_ABOUT = (SHIPPED.network, SHIPPED.training, STEPS, SEEDS)


@study("push", "push_test", settings=(_ABOUT, CHANGES))
def ablation() -> Rows:
    """Errors on `push_test` of short trainings, each without one thing; means over seeds."""
    return [{"change": change} | _errors([change]) for change in CHANGES]


@study("push", "push_test", settings=(_ABOUT, [CHANGES[change] for change in LADDER.values()]))
def incremental_ablation() -> Rows:
    """The same of trainings that gain one thing after another, from none of `LADDER` to all."""
    names, changes = list(LADDER), list(LADDER.values())
    return [
        {"added": "nothing" if k == 0 else names[k - 1]} | _errors(changes[k:])
        for k in range(len(names) + 1)
    ]


def _errors(changes: Sequence[str]) -> dict[str, Any]:
    box = open_interactions("push_test")["family"].values == 0
    each_seed = [ablated(changes, STEPS, seed) for seed in range(SEEDS)]
    ends = [(error[box].mean() + error[~box].mean()) / 2 for error, _ in each_seed]
    row: dict[str, Any] = {"steps": STEPS, "seeds": SEEDS, "n": len(box)}
    for name, each in (("final_error", ends), ("action_start", [s.mean() for _, s in each_seed])):
        for statistic in (np.mean, np.min, np.max):
            row[f"{name}_{statistic.__name__}_m"] = float(statistic(each))
    return row


def ablated(changes: Sequence[str], steps: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Errors on `push_test` after a training on fold 0 of `push` with some of `CHANGES`.

    Where two of them sample contexts, the first does. Final errors (N,) [m] of effects predicted
    from actions; and distances (N,) [m] between the start of the recorded push and of the push that
    is decoded from its final effect.
    """
    each = [CHANGES[change] for change in changes]
    image = all(how.get("image", True) for how in each)
    scales = next((how["scales"] for how in each if "scales" in how), lambda same: same)
    draw = next((how["draw"] for how in each if "draw" in how), sample_mixed)
    options: dict[str, dict[str, Any]] = {
        of: {k: v for how in each for k, v in how.get(of, {}).items()}
        for of in ("training", "network")
    }
    config = replace(SHIPPED.training, steps=steps, seed=seed, **options["training"])
    network = replace(SHIPPED.network, **options["network"])
    channels = network.action_channels, network.effect_channels
    data, test_data = open_interactions("push"), open_interactions("push_test")
    split = split_interactions(data.sizes["interaction"])
    parts = (data, split.train), (data, split.validation), (test_data, None)
    training, validation, test = (
        InteractionTensors.from_dataset(d, rows, *channels) for d, rows in parts
    )
    scaler = Scaler.fit(training)
    if not image:
        blank = training.image.mean(dim=0, keepdim=True)
        training, validation, test = (
            replace(a, image=blank.expand(len(a), -1, -1, -1)) for a in (training, validation, test)
        )
        scaler = replace(scaler, mask_share=None)
    torch.manual_seed(seed)
    model = build(network, scales(scaler))
    for how in each:
        how.get("start", lambda _: None)(model)
    train(model, training, validation, config, sampler=draw)
    with torch.no_grad():
        observed = condition_on_final_effect(model, test.effect[:, -1])
        decoded = model.predict(model.encode(test.image), observed, torch.zeros(len(test), 1))
    start = (decoded.action_mean[:, 0, :2] - test.action[:, 0, :2]).norm(dim=-1)
    return final_errors_m(model, test).numpy(), start.numpy()
