"""Models that relate an object's image, an action and its effect."""

from affordlib.models.calibration import calibration_rows, coverage, fit_temperature
from affordlib.models.checkpoint import build, load_checkpoint, save_checkpoint
from affordlib.models.cnp import AffordanceCNP, CNPConfig
from affordlib.models.ensemble import Ensemble
from affordlib.models.film import FiLMConfig, FiLMNetwork
from affordlib.models.network import EffectNetwork, NetworkConfig, OutOfRangeWarning
from affordlib.models.protocol import EffectModel, condition_on_primitives
from affordlib.models.training import TrainingConfig, train, train_literal, train_model

__all__ = [
    "AffordanceCNP",
    "CNPConfig",
    "EffectModel",
    "EffectNetwork",
    "Ensemble",
    "FiLMConfig",
    "FiLMNetwork",
    "NetworkConfig",
    "OutOfRangeWarning",
    "TrainingConfig",
    "build",
    "calibration_rows",
    "condition_on_primitives",
    "coverage",
    "fit_temperature",
    "load_checkpoint",
    "save_checkpoint",
    "train",
    "train_literal",
    "train_model",
]
