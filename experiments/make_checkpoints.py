"""`make checkpoints`: train the shipped models again from the shipped interactions."""

from __future__ import annotations

import argparse
import math
import sys
from dataclasses import dataclass, replace

import numpy as np
import xarray as xr

from affordlib.commands import command
from affordlib.interactions import (
    Normaliser,
    Split,
    TrainingArrays,
    open_interactions,
    split_interactions,
)
from affordlib.interactions.batches import (
    Symmetry,
    draw_forward,
    plane_of,
    sample_batch,
)
from affordlib.interactions.store import SUFFIX as DATA_SUFFIX
from affordlib.models.checkpoint import SUFFIX, load_checkpoint, save_checkpoint
from affordlib.models.cnp import CNPConfig
from affordlib.models.film import FiLMConfig
from affordlib.models.lever import (
    LEVER_MODELS,
    LeverModel,
    lever_training,
    train_lever_model,
)
from affordlib.models.lstm import LSTMConfig
from affordlib.models.network import EffectNetwork, NetworkConfig
from affordlib.models.training import (
    Draw,
    TrainingConfig,
    about_training,
    final_errors_m,
    train_model,
)
from affordlib.paths import repo_root
from experiments.attention import AttentionConfig


@dataclass(frozen=True)
class Shipped:
    """A shipped checkpoint: the data set it learns from, its network, and its training.

    symmetries: see `symmetric_copies`; draw: see `train`.
    """

    data: str
    network: NetworkConfig
    training: TrainingConfig
    symmetries: tuple[Symmetry, ...] = ()
    draw: Draw = sample_batch


_YAW = ("x", "y", "yaw")
_PUSH_FRAME = TrainingConfig(
    steps=4000, n_targets=8, patience=99, beta=0.5, weight_decay=0.1, final_sigma_floor=0.005,
    ema=0.99,
)  # fmt: skip
_TABLE_FRAME = replace(_PUSH_FRAME, augment=False)
HALF_TURNS: tuple[Symmetry, ...] = ((0, False), (2, False))
GRASP_SYMMETRIES: tuple[Symmetry, ...] = (*HALF_TURNS, (0, True), (2, True))
"""Under which a grasp and a rotation, which have no direction, stay themselves."""

SHIPPED: dict[str, Shipped] = {
    "push_cnp": Shipped("push", CNPConfig(), TrainingConfig(steps=5000, patience=20)),
    "push_attention": Shipped("push", AttentionConfig(effect_channels=_YAW), _PUSH_FRAME),
    "push_film": Shipped("push", FiLMConfig(effect_channels=_YAW), _PUSH_FRAME),
    "push_film_x10": Shipped(
        "push_x10", FiLMConfig(effect_channels=_YAW), replace(_PUSH_FRAME, steps=16000)
    ),
    "push_film_varied": Shipped(
        "push_varied_x10", FiLMConfig(effect_channels=_YAW), replace(_PUSH_FRAME, steps=16000)
    ),
    "drag_film": Shipped("drag", FiLMConfig(), _PUSH_FRAME),
    "grasp_film": Shipped(
        "grasp_x10",
        FiLMConfig(frame="table", action_channels=("z", "gripper"), effect_channels=("z",)),
        _TABLE_FRAME,
        GRASP_SYMMETRIES,
    ),
    "grasp_film_firm": Shipped(
        "grasp_firm_x10",
        FiLMConfig(frame="table", action_channels=("z", "gripper"), effect_channels=("z",)),
        _TABLE_FRAME,
        GRASP_SYMMETRIES,
    ),
    "rotate_film": Shipped(
        "rotate_x10",
        FiLMConfig(frame="table", action_channels=("yaw", "gripper"), effect_channels=("yaw",)),
        _TABLE_FRAME,
        HALF_TURNS,
    ),
    "push_lstm": Shipped(
        "push",
        LSTMConfig(effect_channels=_YAW, frame="push", width=128),
        _PUSH_FRAME,
        draw=draw_forward,
    ),
}
"""Minutes of one core: ten for `push_cnp`, five for `push_lstm` and the two of 5,000 pushes, one or
two for others.

Five learn from sets of ten times the size, which are not shipped: collect them first.
"""

SHIPPED_LEVER: dict[str, tuple[str, str]] = {
    "lever_anchored": ("anchored", "all"),
    "lever_lstm_window": ("lstm_tuned", "window"),
    "lever_lstm_first_step": ("lstm_tuned", "first_step"),
}
"""Of lever-ups: which of `LEVER_MODELS`, and the protocol that it was trained for."""


def make(name: str) -> None:
    """Train a shipped model on fold 0 of its data and write it to data/checkpoints."""
    shipped = SHIPPED[name]
    data = open_interactions(shipped.data)
    split = split_interactions(data.sizes["interaction"])
    model, history = train_model(
        data,
        split,
        shipped.training,
        shipped.network,
        symmetries=shipped.symmetries,
        draw=shipped.draw,
    )
    seen = np.concatenate([split.train, split.validation])
    path = repo_root() / "data" / "checkpoints" / f"{name}{SUFFIX}"
    save_checkpoint(model, path, about_training(data, seen, shipped.training))
    channels = model.action_channels, model.effect_channels
    test = final_errors_m(model, TrainingArrays.from_dataset(data, split.test, *channels))
    validation = min(record.validation_error for record in history)
    plane = bool(plane_of(channels[1])) or channels[1] == ("z",)
    factor, unit = (1000, "mm") if plane else (180 / math.pi, "°")
    print(f"{path.name}: {history[-1].step} steps in {history[-1].seconds:.0f} s")
    print(f"validation {factor * validation:.2f} {unit}, test {factor * test.mean():.2f} {unit}")


def about_lever_training(
    data: xr.Dataset, split: Split, lever: LeverModel, trained_for: str
) -> dict[str, object]:
    """As `about_training`, and what the network was trained for and which view it has."""
    seen = np.concatenate([split.train, split.validation])
    about = about_training(data, seen, lever.training)
    return about | {"trained_for": trained_for, "view": lever.view}


def shipped_lever_model(
    name: str, trained_for: str, lever: LeverModel, data: xr.Dataset, split: Split
) -> tuple[EffectNetwork, dict[str, object]] | None:
    """The shipped checkpoint that this very training gave, if there is one, and its name."""
    for checkpoint, key in SHIPPED_LEVER.items():
        if key != (name, trained_for):
            continue
        try:
            model, about = load_checkpoint(checkpoint)
        except (FileNotFoundError, ValueError):
            return None
        expected = about_lever_training(data, split, lever, trained_for)
        network = replace(model.config, sigma_floor=lever.network.sigma_floor)
        scales = Normaliser.fit(lever_training(lever, data, split))
        if about == expected and network == lever.network and model.normaliser == scales:
            return model, {"checkpoint": checkpoint}
    return None


def make_lever(name: str) -> None:
    """Train a shipped model of lever-ups on fold 0 and write it to data/checkpoints."""
    model_name, trained_for = SHIPPED_LEVER[name]
    lever, data = LEVER_MODELS[model_name], open_interactions("lever_up")
    split = split_interactions(data.sizes["interaction"])
    model, history = train_lever_model(lever, data, split, trained_for)
    path = repo_root() / "data" / "checkpoints" / f"{name}{SUFFIX}"
    save_checkpoint(model, path, about_lever_training(data, split, lever, trained_for))
    validation = 1000 * min(record.validation_error for record in history)
    print(f"{path.name}: {history[-1].step} steps in {history[-1].seconds:.0f} s")
    print(f"validation {validation:.2f} mm")


@command(OSError, ValueError)
def main() -> int:
    """Train the chosen models on fold 0 of their data and write them to data/checkpoints.

    Models of data that are not there are left as they are; returns 1 if there are any.
    """
    parser = argparse.ArgumentParser(prog="make checkpoints", description=main.__doc__)
    names = [*SHIPPED, *SHIPPED_LEVER]
    parser.add_argument("--only", nargs="+", choices=sorted(names), default=names)
    missing = []
    for name in parser.parse_args().only:
        if name in SHIPPED_LEVER:
            make_lever(name)
            continue
        data = SHIPPED[name].data
        if (repo_root() / "data" / f"{data}{DATA_SUFFIX}").is_file():
            make(name)
            continue
        missing.append(data)
        print(f"{name}: left as it is; it learns from {data}, which is not shipped and not here")
    if missing:
        chosen = " ".join(dict.fromkeys(missing))
        print(
            "Collect what is missing (push_x10 in five to ten minutes of two cores, others faster) "
            "and try again:\n"
            f"  .venv/bin/python -m experiments.make_data --only {chosen} --to data"
        )
    return 1 if missing else 0


if __name__ == "__main__":
    sys.exit(main())
