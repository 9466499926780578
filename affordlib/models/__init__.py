"""Models that relate an object's image, an action and its effect."""

from affordlib.models.checkpoint import load_checkpoint, save_checkpoint
from affordlib.models.cnp import AffordanceCNP, CNPConfig
from affordlib.models.protocol import EffectModel, observe_pushes
from affordlib.models.training import TrainingConfig, train

__all__ = [
    "AffordanceCNP",
    "CNPConfig",
    "EffectModel",
    "TrainingConfig",
    "load_checkpoint",
    "observe_pushes",
    "save_checkpoint",
    "train",
]
