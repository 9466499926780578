"""Plans of pushes and drags that the arm can follow: a model proposes, the kinematics vetoes."""

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import cKDTree

from affordlib.planning.effect_map import poses_along
from affordlib.planning.free_space import N_POSES, FreeSpace
from affordlib.planning.problem import PlanMode, Planner, PlanningProblem, Reachable
from affordlib.planning.robot import Robot
from affordlib.planning.skills import Skills
from affordlib.primitives import Drag, Move, Primitive
from affordlib.types import TABLE_X_M, TABLE_Y_M, Goal, Observation, Plan, Step, on_table

MAX_PLANS = 12
"""Plans to one place that the kinematics may veto before another place is tried."""

REFUSED_WITHIN_M, REFUSED_WITHIN_RAD = 0.01, math.radians(6)
"""Actions this near to a refused action, in position [m] and direction [rad], are excluded."""

CELL_M, LONGEST_M = 0.04, 0.092
"""Distance [m] of neighbours in the grid of a way, and that of the farthest that are joined."""

BESIDE_M = 0.02 * np.array([[1, 0], [0, 1], [-1, 0], [0, -1]])
"""Where the arm should act, too, relative to a place on a way [m]."""


def find_way(problem: PlanningProblem) -> np.ndarray:
    """Places (n, 2) [m] from start to goal on the shortest way that the arm allows; none: (0, 2).

    A way leads over a grid. Near to where the arm cannot act, it counts as three times as long, and
    where an obstacle is, as ten times: there, plans may find what the grid does not.
    """
    effects, axes = problem.effects, (np.arange(*rim, CELL_M) for rim in (TABLE_X_M, TABLE_Y_M))
    grid = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)
    ends = problem.start_xy_m, problem.goal.xy_m
    places = np.vstack([*ends, grid[on_table(grid, effects.radius_m)]])
    pairs = cKDTree(places).query_pairs(LONGEST_M, output_type="ndarray")
    begin, end = np.vstack([pairs, pairs[:, ::-1]]).T
    n_actions = math.ceil(LONGEST_M / max(effects.reach_m, 0.01))
    ahead = (places[end] - places[begin]) / n_actions
    angle, long_m = np.arctan2(*ahead.T[::-1]), np.hypot(*ahead.T)
    begins = [places[begin] + k * ahead for k in range(n_actions)]
    allowed = np.all([problem.reachable(at, angle) for at in begins], axis=0)
    beside = [problem.reachable(places[begin] + by_m, angle) for by_m in BESIDE_M]
    cost = (n_actions * long_m + 0.1 * CELL_M) * np.where(np.all(beside, axis=0), 1, 3)
    if problem.obstacles:
        phases = torch.linspace(0, 1, 26).double()
        stops = np.interp(long_m, effects(0 * phases, phases)[0][:, 0], phases)
        turned, actions = np.zeros((len(angle), 1)), (torch.tensor(angle), torch.tensor(stops))
        spare = [problem.spare_m(np.hstack([at, turned]), *actions) for at in begins]
        cost *= np.where(np.min(spare, axis=0) < 0, 10, 1)
    graph = csr_array((cost[allowed], (begin[allowed], end[allowed])), (len(places),) * 2)
    _, before = dijkstra(graph, indices=0, return_predecessors=True)
    way = [1]
    while before[way[-1]] >= 0:
        way.append(before[way[-1]])
    return places[way[::-1]] if way[-1] == 0 else places[:0]


class Ending(NamedTuple):
    """How a closed loop ends: the `status` and `message` of its `ClosedLoopResult`."""

    status: str
    message: str


class MovePlanner:
    """Plans to a position; remembers which actions the kinematics has refused."""

    def __init__(self, robot: Robot, skills: Skills, planner: Planner, mode: PlanMode) -> None:
        self.robot, self.skills, self.planner, self.mode = robot, skills, planner, mode
        self._ends_m: list[float] = []  # distances of the plans' ends from the current goal
        self._refused: list[tuple[str, np.ndarray, float]] = []

    def plan(self, seen: Observation, goal: Goal, grip_yaw: float | None = None) -> Plan | Ending:
        """A plan that the arm can follow from the object's observed position, or an `Ending`.

        grip_yaw: drag with the hand at this yaw if possible, even if the image suggests a push.
        """
        if grip_yaw is not None and Drag.name in self.skills.models:
            plan = self._plan(seen, goal, Drag)
            if isinstance(plan, Plan):
                grip = {"grip_yaw": grip_yaw}
                steps = (replace(s, primitive=replace(s.primitive, **grip)) for s in plan.steps)
                plan = replace(plan, steps=tuple(steps))
                if not seen.obstacles or self.passes(plan.steps[0], seen):
                    return plan
        return self._plan(seen, goal)

    def passes(self, step: Step, seen: Observation) -> bool:
        """Whether a push or drag, planned before, passes the obstacles from where the object is."""
        effects = self.skills.effects(seen.image, type(step.primitive))
        space = FreeSpace(seen.obstacles, seen.image, seen.xy_m, effects.outline_m)
        known, here = [[step.primitive.direction_rad], [step.stop_phase]], [[*seen.xy_m, 0.0]]
        poses = poses_along(effects, np.array(here), *torch.tensor(known).double(), N_POSES)
        return bool(space.spare_m(step.primitive, *np.array(known), poses)[0] >= 0)

    def _plan(self, seen: Observation, goal: Goal, kind: type[Move] | None = None) -> Plan | Ending:
        effects, refused = self.skills.effects(seen.image, kind), len(self._refused)
        try:
            known = seen.xy_m, goal, effects, self.mode, self._allowed(effects.kind)
            whole = PlanningProblem(*known, obstacles=seen.obstacles)
        except ValueError as error:
            return Ending("unreachable", f"the position: {error}")
        distance_m = goal.distance_m(seen.xy_m)
        plan, self._ends_m = None, [distance_m]
        if distance_m <= self.mode.max_steps * effects.reach_m:
            plan = self._plan_to(whole, goal, goal.tolerance_m)
        way = () if plan else find_way(whole)
        if plan := plan or (self._plan_along(way, whole) if len(way) else None):
            return plan
        best = f"of all plans, the best ends {1000 * min(self._ends_m):.1f} mm from it"
        best = best if len(self._ends_m) > 1 else "no way leads there"
        if seen.obstacles or len(self._refused) > refused or not len(way):
            (x, y), past = goal.xy_m, " past the obstacles" * bool(seen.obstacles)
            why = f"the arm cannot bring it there{past}; {best}"
            return Ending("unreachable", f"the position ({x:.3f}, {y:.3f}) m: {why}")
        return Ending(
            "gave_up",
            f"{1000 * distance_m:.1f} mm from the goal, the planner finds no plan that the arm can "
            f"follow; {best}, and planning again from the same place gives the same",
        )

    def _plan_along(self, way: np.ndarray, whole: PlanningProblem) -> Plan | None:
        """Plan to a place on a way (n, 2), as far along it as one plan comes."""
        gone_m = np.append(0.0, np.hypot(*np.diff(way, axis=0).T).cumsum())
        far_m = min(0.98 * self.mode.max_steps * whole.effects.reach_m, gone_m[-1])
        for along_m in (far_m, 0.7 * far_m, 0.4 * far_m):
            x, y = (float(np.interp(along_m, gone_m, axis)) for axis in way.T)
            try:
                near = Goal((x, y), whole.goal.tolerance_m)
                problem = replace(whole, goal=near, reachable=self._allowed(whole.effects.kind))
            except ValueError:  # on an obstacle
                continue
            if plan := self._plan_to(problem, whole.goal, within_m=0.01):
                return plan
        return None

    def _plan_to(self, problem: PlanningProblem, goal: Goal, within_m: float) -> Plan | None:
        """A plan that ends within a distance of the problem's goal and that the arm can follow."""
        for _ in range(MAX_PLANS):
            plan = self.planner(problem)
            self._ends_m.append(goal.distance_m(plan.predicted_end_xy_m))
            if not plan.steps or plan.predicted_distance_m > within_m:
                return None
            if self._can_follow(plan):
                return plan
            problem = replace(problem, reachable=self._allowed(problem.effects.kind))
        return None

    def _allowed(self, kind: type[Primitive]) -> Reachable:
        """Where the arm can act: learned reachability, without the actions refused so far."""
        learned = self.skills.reachable(kind)
        refused = [(xy, angle) for name, xy, angle in self._refused if name == kind.name]

        def allowed(xy_m, direction_rad, *_):
            ok = learned(xy_m, direction_rad)
            for xy, angle in refused:
                near = np.hypot(*(xy_m - xy).T) < REFUSED_WITHIN_M
                off = (direction_rad - angle + np.pi) % (2 * np.pi) - np.pi
                ok = ok & ~(near & (np.abs(off) < REFUSED_WITHIN_RAD))
            return ok

        return allowed

    def _can_follow(self, plan: Plan) -> bool:
        """Whether the kinematics allows all actions; one that it refuses is then excluded.

        The primitives are checked, not a decoded trajectory or the grip of a drag.
        """
        starts = [plan.start_xy_m, *(step.predicted_end_xy_m for step in plan.steps)]
        for step, at in zip(plan.steps, starts, strict=False):
            if not self.robot.can_reach(step.primitive, step.stop_phase, at):
                action = step.primitive
                self._refused.append((action.name, np.array(at), action.direction_rad))
                return False
        return True
