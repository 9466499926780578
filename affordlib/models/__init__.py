"""Models that relate an object's image, an action and its effect."""

from affordlib.models.base import (
    EffectModel,
    EffectNetwork,
    NetworkConfig,
    condition_on_final_effect,
    condition_on_primitives,
)
from affordlib.models.checkpoint import build, load_checkpoint, save_checkpoint
from affordlib.models.cnp import AffordanceCNP, CNPConfig
from affordlib.models.domain import OutOfRangeWarning, TrainingDomain
from affordlib.models.evaluation import (
    coverage,
    final_error,
    final_errors_m,
    fit_sigma_scale,
    network_predictions,
    refuse_seen,
)
from affordlib.models.film import CircularHarmonics, FiLMConfig, FiLMNetwork
from affordlib.models.lever_up import lever_up_tensors, predict_steps
from affordlib.models.training import TrainingConfig, about_training, train, train_model
