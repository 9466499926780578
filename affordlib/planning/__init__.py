"""Planning with (partial) actions on any `EffectModel`, and carrying plans out."""

from affordlib.planning.astar import plan_astar
from affordlib.planning.closed_loop import carry_out
from affordlib.planning.gradient import plan_gradient
from affordlib.planning.modes import MODES, PlanMode

__all__ = ["MODES", "PlanMode", "carry_out", "plan_astar", "plan_gradient"]
