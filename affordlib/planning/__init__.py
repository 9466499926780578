"""Planning with (partial) actions on any `EffectModel`, and executing the plans."""

from affordlib.planning.astar import plan_astar
from affordlib.planning.closed_loop import (
    ClosedLoopConfig,
    ClosedLoopResult,
    execute_plan,
    run_closed_loop,
)
from affordlib.planning.continuous import plan_continuous
from affordlib.planning.effect_map import EffectMap
from affordlib.planning.free_space import FreeSpace
from affordlib.planning.gradient import plan_gradient
from affordlib.planning.problem import MODES, PlanMode, Planner, PlanningProblem, Table
from affordlib.planning.robot import Execution, Robot
from affordlib.planning.skills import Skills
