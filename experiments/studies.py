"""Studies in addition to the cross-validation: an ablation, partial actions, novelty.

    python -m experiments.studies --only study=novelty_judged

computes missing or stale results in `data/results/raw/studies.jsonl.gz`. The tables are written by
`experiments.effect_prediction`. The ablation adds the parts of our network one after another.
"""

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import torch

from affordlib.interactions import InteractionTensors, Scaler, open_interactions, split_interactions
from affordlib.interactions.dataset import Batch, sample_mixed, valid_interactions
from affordlib.models import condition_on_primitives, load_checkpoint
from affordlib.models.checkpoint import build
from affordlib.models.evaluation import final_errors_m
from affordlib.models.film import FiLMNetwork
from affordlib.models.training import train
from affordlib.primitives import Drag, Push
from affordlib.types import Observations
from experiments import novelty, runner
from experiments.published import one_at_a_time
from experiments.runner import FOLDER, Job, Rows, read
from experiments.shipped import CHECKPOINT_SPECS

NAME = "studies"
WHOLE_ACTION_MODELS = ("film_500", "film_5000", "drag_film_500")
PHASES = (0.0, 0.55, 0.65, 0.75, 1.0)
"""Edges of the phase bins; the gripper touches nothing before 0.5."""


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
    actions, effects = ((1.0,) * len(of) for of in (scaler.action_scale, scaler.effect_scale))
    return Scaler(actions, effects, image_mean=(0.0, 0.0), image_std=(1.0, 1.0))


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


def incremental_ablation() -> Rows:
    """Return errors after short trainings to which the parts of `LADDER` are added in turn."""
    rows = []
    for k, name in enumerate(["nothing", *LADDER]):
        each = [error_m(tuple(LADDER)[k:], STEPS, seed) for seed in range(SEEDS)]
        row = {"added": name, "steps": STEPS, "seeds": SEEDS}
        for statistic in (np.mean, np.min, np.max):
            row[f"final_error_{statistic.__name__}_m"] = float(statistic(each))
        rows.append(row)
    return rows


def error_m(without: tuple[str, ...], steps: int, seed: int = 0) -> float:
    """Train our network on `push` without some parts of `LADDER`; the seed is also the fold.

    Return the mean final error [m] on its validation data; both categories have the same weight.
    If several parts change the sampler of contexts, the first one is used.
    """
    each = [LADDER[part] for part in without]
    scales = next((how["scales"] for how in each if "scales" in how), lambda same: same)
    draw = next((how["draw"] for how in each if "draw" in how), sample_mixed)
    config = replace(SHIPPED.training, steps=steps, seed=seed)
    network = SHIPPED.network
    for how in each:
        config = replace(config, **how.get("training", {}))
        network = replace(network, **how.get("network", {}))
    data = open_interactions(SHIPPED.data)
    split = split_interactions(data.sizes["interaction"], fold=seed)
    rows = valid_interactions(data, split.validation)
    channels = SHIPPED.network.action_channels, SHIPPED.network.effect_channels
    training, validation = (
        InteractionTensors.from_dataset(data, part, *channels) for part in (split.train, rows)
    )
    torch.manual_seed(seed)
    model = build(network, scales(Scaler.fit(training)))
    for how in each:
        how.get("start", lambda _: None)(model)
    train(model, training, validation, config, sampler=draw)
    errors = final_errors_m(model, validation)
    box = torch.from_numpy(data["category"].values[rows] == 0)
    return float(errors[box].mean() + errors[~box].mean()) / 2


@torch.no_grad()
def partial_execution() -> Rows:
    """Measure the errors on actions that stop at phase t of networks trained only on full actions.

    The truth is the state of the full action at t, or the object's rest position.
    """
    data, rows = open_interactions("partial"), []
    names = data["primitive"].attrs["flag_meanings"].split()
    kinds, phase = np.array(names)[data["primitive"].values], data["stop_phase"].values
    whole, rest = (data[name].values for name in ("full_effect", "rest_effect"))
    slid = np.hypot(*(rest - whole)[:, :2].T)
    for name in WHOLE_ACTION_MODELS:
        model, _ = load_checkpoint(name)
        kind = Drag if name.startswith("drag") else Push
        mine = np.flatnonzero((kinds == kind.name) & ~data["fault"].values)
        actions = [kind(float(theta)) for theta in data["theta"].values[mine]]
        features = model.encode(torch.from_numpy(data["image"].values[mine]))
        at = torch.from_numpy(phase[mine]).float()[:, None]
        predicted = model.predict(features, condition_on_primitives(model, actions), at)
        columns = [model.effect_channels.index(c) for c in "xy"]
        mean = predicted.effect_mean[:, 0, columns].numpy()
        for low, high in pairwise(PHASES):
            of = (phase[mine] > low) & (phase[mine] <= high)
            row = {"model": name, "from_phase": low, "to_phase": high, "n": int(of.sum())}
            for what, truth in (("whole", whole), ("rest", rest)):
                error = np.hypot(*(mean - truth[mine, :2])[of].T)
                row[f"{what}_mean_m"] = float(error.mean())
                row[f"{what}_median_m"] = float(np.median(error))
            rows.append(row | {"slid_mean_m": float(slid[mine][of].mean())})
    return rows


_LADDER = (SHIPPED.network, SHIPPED.training, STEPS, SEEDS), [*LADDER.values()]
_GROWN = *novelty.SETTINGS, novelty.NOVELTY_GAIN
STUDIES: dict[Callable[[], Rows], tuple[Any, ...]] = {
    incremental_ablation: (_LADDER, ("push",), (), 2),
    novelty.novelty_gain: (novelty.SETTINGS, ("push",), novelty.MODELS[:3]),
    novelty.novelty_judged: (_GROWN, ("push_test",), novelty.MODELS),
    partial_execution: (PHASES, ("partial",), WHOLE_ACTION_MODELS),
}
"""Functions that return the rows of a study; settings, data, checkpoints and version of its job."""

BY_NAME = {study.__name__: study for study in STUDIES}


def job(study: str) -> Job:
    """Return the job that makes the rows of a study."""
    return Job(make_rows, {"study": study}, *STUDIES[BY_NAME[study]])


def make_rows(study: str) -> Rows:
    """Make the rows of a study."""
    return BY_NAME[study]()


def tables(folder: str = FOLDER) -> dict[str, Rows]:
    """Return the rows of all finished studies; raises ValueError for stale ones."""
    made = {arguments["study"]: rows for arguments, rows in read(NAME, job, folder)}
    return {name: made[name] for name in BY_NAME if name in made}


main = runner.command_of(NAME, __doc__, lambda: [job(name) for name in BY_NAME])

if __name__ == "__main__":
    raise SystemExit(main())
