"""Planning with (partial) actions on any `EffectModel`, and executing the plans."""

from affordlib.planning.astar import BranchTable, plan_astar, search
from affordlib.planning.closed_loop import (
    ClosedLoopConfig,
    ClosedLoopResult,
    execute_plan,
    run_closed_loop,
)
from affordlib.planning.continuous import plan_continuous
from affordlib.planning.effect_map import EffectMap, make_steps, roll_out
from affordlib.planning.free_space import FreeSpace, corners_of, gaps_m, placed
from affordlib.planning.gradient import Reading, descend, plan_gradient
from affordlib.planning.grasp_rotate import predict_trajectories
from affordlib.planning.problem import MODES, PlanMode, Planner, PlanningProblem
from affordlib.planning.robot import Execution, Robot
from affordlib.planning.skills import Skills
from affordlib.types import Goal
