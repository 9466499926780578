"""Models that relate an object's image, an action and its effect."""

from affordlib.models.base import EffectNetwork, NetworkConfig
from affordlib.models.calibration import coverage, fit_sigma_scale
from affordlib.models.checkpoint import build, load_checkpoint, save_checkpoint
from affordlib.models.cnp import AffordanceCNP, CNPConfig
from affordlib.models.domain import OutOfRangeWarning, TrainingDomain
from affordlib.models.film import FiLMConfig, FiLMNetwork
from affordlib.models.protocol import EffectModel, condition_on_primitives
from affordlib.models.training import TrainingConfig, train, train_model
