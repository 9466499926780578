"""Planning with (partial) actions on any `EffectModel`, and carrying plans out."""

from affordlib.planning.astar import plan_astar
from affordlib.planning.closed_loop import Pursuit, action_limit, carry_out, pursue
from affordlib.planning.continuous import plan_continuous
from affordlib.planning.disturbances import Disturbance, draw_disturbances
from affordlib.planning.effect_map import EffectMap, map_effects
from affordlib.planning.gradient import plan_gradient
from affordlib.planning.modes import MODES, PlanMode
from affordlib.planning.poses import plan_lift, plan_turn
from affordlib.planning.repertoire import Repertoire

__all__ = [
    "MODES",
    "Disturbance",
    "EffectMap",
    "PlanMode",
    "Pursuit",
    "Repertoire",
    "action_limit",
    "carry_out",
    "draw_disturbances",
    "map_effects",
    "plan_astar",
    "plan_continuous",
    "plan_gradient",
    "plan_lift",
    "plan_turn",
    "pursue",
]
