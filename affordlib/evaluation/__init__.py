"""Error statistics, baselines beside the models, their predictions, and planning tasks."""

from affordlib.evaluation.metrics import error_row, refuse_seen
