"""Error statistics, baselines, predictions, cross-validation on logs, and planning tasks."""

from affordlib.evaluation.cross_validate import cross_validate
from affordlib.evaluation.metrics import error_row, refuse_seen
