"""`make checkpoints`: train the shipped models again from the shipped interactions."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING

import torch

from affordlib.interactions import (
    Normaliser,
    TrainingArrays,
    open_interactions,
    split_interactions,
)
from affordlib.models.checkpoint import SUFFIX, save_checkpoint
from affordlib.models.cnp import AffordanceCNP, CNPConfig
from affordlib.models.training import TrainingConfig, TrainingRecord, final_errors_m, train
from affordlib.paths import repo_root

if TYPE_CHECKING:
    import numpy as np
    import xarray as xr

    from affordlib.interactions import Split

SHIPPED = TrainingConfig(steps=5000, patience=20)
"""What the shipped `push_cnp` was trained with: about ten minutes on two cores."""


def train_push_model(
    data: xr.Dataset,
    split: Split,
    config: TrainingConfig,
    model_config: CNPConfig | None = None,
    progress: bool = True,
) -> tuple[AffordanceCNP, list[TrainingRecord]]:
    """The paper's network, trained on a split's training part and stopped on its validation."""
    training = TrainingArrays.from_dataset(data, split.train)
    validation = TrainingArrays.from_dataset(data, split.validation)
    torch.manual_seed(config.seed)
    model = AffordanceCNP(model_config or CNPConfig(), Normaliser.fit(training))
    history = train(model, training, validation, config, progress)
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
    """Train `push_cnp` on fold 0 of the 500 pushes and write it to data/checkpoints."""
    data = open_interactions("push")
    split = split_interactions(data.sizes["interaction"])
    model, history = train_push_model(data, split, SHIPPED)
    seen = sorted([*split.train, *split.validation])
    path = repo_root() / "data" / "checkpoints" / f"push_cnp{SUFFIX}"
    save_checkpoint(model, path, about_training(data, seen, SHIPPED))
    validation = 1000 * min(record.validation_error_m for record in history)
    test = final_errors_m(model, TrainingArrays.from_dataset(data, split.test))
    print(f"{path.name}: {history[-1].step} steps in {history[-1].seconds:.0f} s")
    print(f"validation {validation:.2f} mm, test {1000 * test.mean():.2f} mm")
    return 0


if __name__ == "__main__":
    sys.exit(main())
