"""Interactions of the robot with objects: collection, storage and batches for training."""

from affordlib.interactions.dataset import (
    Batch,
    InteractionTensors,
    Scaler,
    Split,
    condition_on_poses,
    condition_on_recorded_action,
    sample_mixed,
    split_interactions,
)
from affordlib.interactions.store import (
    CorruptedDataError,
    dataset_sha256,
    open_interactions,
    stored_sha256,
)
