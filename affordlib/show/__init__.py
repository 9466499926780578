"""Pictures for people: figures, animations and the goal picker."""

from affordlib.show.animation import Film, show_animation
from affordlib.show.goal_picker import GoalPicker
from affordlib.show.plots import (
    GOAL,
    NEUTRAL,
    PREDICTION,
    TRUTH,
    plot_depth,
    plot_footprint,
    plot_outcome,
    plot_plan,
    plot_table,
    save_figure,
)

__all__ = [
    "GOAL",
    "NEUTRAL",
    "PREDICTION",
    "TRUTH",
    "Film",
    "GoalPicker",
    "plot_depth",
    "plot_footprint",
    "plot_outcome",
    "plot_plan",
    "plot_table",
    "save_figure",
    "show_animation",
]
