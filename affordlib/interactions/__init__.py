"""Interactions of the robot with objects: collection, storage and batches for training."""

from affordlib.interactions.dataset import InteractionTensors, Scaler, Split, split_interactions
from affordlib.interactions.store import CorruptedDataError, open_interactions
