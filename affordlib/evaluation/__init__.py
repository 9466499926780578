"""The paper's tables as functions, and the baselines beside them."""

from affordlib.evaluation.effect_prediction import (
    error_row,
    mean_length_errors_m,
    refuse_seen,
)
from affordlib.evaluation.planning import (
    PlanningTask,
    constructed_tasks,
    measure,
    planning_rows,
    uniform_tasks,
)

__all__ = [
    "PlanningTask",
    "constructed_tasks",
    "error_row",
    "mean_length_errors_m",
    "measure",
    "planning_rows",
    "refuse_seen",
    "uniform_tasks",
]
