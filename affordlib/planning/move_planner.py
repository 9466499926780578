"""Plans of pushes and drags that the arm can follow: a model proposes, the kinematics vetoes."""

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch

from affordlib.geometry import unit_vector
from affordlib.planning.free_space import N_POSES, FreeSpace
from affordlib.planning.problem import PlanMode, Planner, PlanningProblem, Reachable
from affordlib.planning.robot import Robot
from affordlib.planning.rollout import poses_along
from affordlib.planning.skills import Skills
from affordlib.primitives import Drag, Move, Primitive
from affordlib.types import Goal, Observation, Plan, Step

MAX_PLANS = 12
"""Plans to one place that the kinematics may veto before another place is tried."""

REFUSED_WITHIN_M, REFUSED_WITHIN_RAD = 0.01, math.radians(6)
"""Actions this near to a refused action, in position [m] and direction [rad], are excluded."""

WAYPOINT_TOLERANCE_M = 0.01
ASIDE_RAD = (0.0, 0.6, -0.6, 1.2, -1.2)
"""Directions of waypoints relative to the goal's, in the order in which they are tried."""


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
                if not seen.obstacles or self.is_free(plan.steps[0], seen):
                    return plan
        return self._plan(seen, goal)

    def is_free(self, step: Step, seen: Observation) -> bool:
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
        plan = plan or self._plan_towards(whole, seen)
        if plan:
            return plan
        best = f"the best ends {1000 * min(self._ends_m):.1f} mm from it"
        planned = len(self._ends_m) > 1 and self._can_arrive(whole)
        if seen.obstacles or len(self._refused) > refused or not planned:
            at = "({:.3f}, {:.3f}) m".format(*goal.xy_m)
            past = " past the obstacles" * bool(seen.obstacles)
            why = f"the arm cannot bring it there{past}; of all plans, {best}"
            return Ending("unreachable", f"the position {at}: {why}")
        return Ending(
            "gave_up",
            f"{1000 * distance_m:.1f} mm from the goal, the planner finds no plan that the arm can "
            f"follow; {best}, and planning again from the same place gives the same",
        )

    def _can_arrive(self, whole: PlanningProblem) -> bool:
        """Whether the arm can make any action whose straight way ends at the goal."""
        angle = np.linspace(-np.pi, np.pi, 72, endpoint=False)
        way_m = np.outer(np.linspace(0.0, whole.effects.reach_m, 8), np.exp(1j * angle)).ravel()
        begins = np.subtract(whole.goal.xy_m, np.column_stack([way_m.real, way_m.imag]))
        return bool(whole.reachable(begins, np.tile(angle, 8)).any())

    def _plan_towards(self, whole: PlanningProblem, seen: Observation) -> Plan | None:
        """Plan to a place as near to the goal as a plan can come, from where the arm can go on."""
        goal, effects, here = whole.goal, whole.effects, np.array(seen.xy_m)
        far_m = min(0.98 * self.mode.max_steps * effects.reach_m, goal.distance_m(here))
        ahead = np.subtract(goal.xy_m, here)
        for aside_rad in ASIDE_RAD:
            stop = here + far_m * unit_vector(math.atan2(ahead[1], ahead[0]) + aside_rad)
            left, within_m = np.subtract(goal.xy_m, stop), WAYPOINT_TOLERANCE_M
            if np.hypot(*left) < 1e-6:  # the goal itself: half of the way is worth going
                within_m = 0.0 if seen.obstacles else max(goal.tolerance_m, far_m / 2)
            elif not whole.reachable(stop[None], np.array([math.atan2(left[1], left[0])]))[0]:
                continue
            try:
                near = Goal(tuple(stop.tolist()), goal.tolerance_m)
                problem = replace(whole, goal=near, reachable=self._allowed(effects.kind))
            except ValueError:  # off the table, or on an obstacle
                continue
            if plan := self._plan_to(problem, goal, within_m):
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
