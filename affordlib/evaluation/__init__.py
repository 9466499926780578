"""The paper's tables as functions, and the baselines beside them."""

from affordlib.evaluation.metrics import (
    error_row,
    mean_length_errors_m,
    refuse_seen,
)

__all__ = ["error_row", "mean_length_errors_m", "refuse_seen"]
