"""Pictures for people: figures, animations, and interactive widgets."""

from affordlib.show.explorers import conditioning_explorer, phase_explorer
from affordlib.show.goal_picker import GoalPicker
from affordlib.show.plots import (
    GOAL,
    NEUTRAL,
    PREDICTION,
    TRUTH,
    plot_closed_loop,
    plot_depth,
    plot_flow,
    plot_footprint,
    plot_obstacles,
    plot_outcome,
    plot_plan,
    plot_table,
    save_figure,
)
from affordlib.show.scene import Scene
