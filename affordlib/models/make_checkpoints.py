"""`make checkpoints`: train the shipped models again from the shipped interactions."""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch

from affordlib.interactions import (
    Normaliser,
    TrainingArrays,
    open_interactions,
    split_interactions,
)
from affordlib.models.attention import AttentionConfig
from affordlib.models.calibration import fit_temperature
from affordlib.models.checkpoint import SUFFIX, build, save_checkpoint
from affordlib.models.cnp import CNPConfig
from affordlib.models.film import FiLMConfig
from affordlib.models.training import TrainingConfig, TrainingRecord, final_errors_m, train
from affordlib.paths import repo_root

if TYPE_CHECKING:
    import xarray as xr

    from affordlib.interactions import Split
    from affordlib.models.network import EffectNetwork, NetworkConfig


@dataclass(frozen=True)
class Shipped:
    """A shipped checkpoint: the data set it learns from, its network, and its training."""

    data: str
    network: NetworkConfig
    training: TrainingConfig


_PUSH_FRAME_TRAINING = TrainingConfig(
    steps=4000, n_targets=8, patience=99, beta=0.5, weight_decay=0.1, final_sigma_floor=0.005,
    ema=0.99,
)  # fmt: skip
SHIPPED: dict[str, Shipped] = {
    "push_cnp": Shipped("push", CNPConfig(), TrainingConfig(steps=5000, patience=20)),
    "push_attention": Shipped(
        "push", AttentionConfig(effect_channels=("x", "y", "yaw")), _PUSH_FRAME_TRAINING
    ),
    "push_film": Shipped(
        "push", FiLMConfig(effect_channels=("x", "y", "yaw")), _PUSH_FRAME_TRAINING
    ),
}
"""About ten minutes of one core for `push_cnp`, three to four for the others."""


def train_push_model(
    data: xr.Dataset,
    split: Split,
    config: TrainingConfig,
    model_config: NetworkConfig | None = None,
    progress: bool = True,
) -> tuple[EffectNetwork, list[TrainingRecord]]:
    """A network (default: the paper's), trained on a split's training part.

    Its validation part stops the training and calibrates σ.
    """
    model_config = model_config or CNPConfig()
    channels = model_config.action_channels, model_config.effect_channels
    training = TrainingArrays.from_dataset(data, split.train, *channels)
    validation = TrainingArrays.from_dataset(data, split.validation, *channels)
    torch.manual_seed(config.seed)
    model = build(model_config, Normaliser.fit(training))
    history = train(model, training, validation, config, progress)
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


def main() -> int:
    """Train the chosen models on fold 0 of their data and write them to data/checkpoints."""
    parser = argparse.ArgumentParser(prog="make checkpoints", description=main.__doc__)
    parser.add_argument("--only", nargs="+", choices=sorted(SHIPPED), default=list(SHIPPED))
    for name in parser.parse_args().only:
        shipped = SHIPPED[name]
        data = open_interactions(shipped.data)
        split = split_interactions(data.sizes["interaction"])
        model, history = train_push_model(data, split, shipped.training, shipped.network)
        seen = np.concatenate([split.train, split.validation])
        path = repo_root() / "data" / "checkpoints" / f"{name}{SUFFIX}"
        save_checkpoint(model, path, about_training(data, seen, shipped.training))
        channels = model.action_channels, model.effect_channels
        test = final_errors_m(model, TrainingArrays.from_dataset(data, split.test, *channels))
        validation = 1000 * min(record.validation_error_m for record in history)
        print(f"{path.name}: {history[-1].step} steps in {history[-1].seconds:.0f} s")
        print(f"validation {validation:.2f} mm, test {1000 * test.mean():.2f} mm")
    return 0


if __name__ == "__main__":
    sys.exit(main())
