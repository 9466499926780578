"""The robot's experience: collecting it, storing it, and cutting it into training batches."""

from affordlib.interactions.batches import Normaliser, Split, TrainingArrays, split_interactions
from affordlib.interactions.store import CorruptedDataError, open_interactions

__all__ = [
    "CorruptedDataError",
    "Normaliser",
    "Split",
    "TrainingArrays",
    "open_interactions",
    "split_interactions",
]
