"""Plans of pushes and drags that the arm can follow: a model proposes, the kinematics vetoes."""

import math
from collections import defaultdict
from collections.abc import Iterable
from dataclasses import replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import torch

from affordlib.planning.effect_map import EffectMap
from affordlib.planning.problem import PlanMode, Planner, PlanningProblem
from affordlib.planning.robot import Robot
from affordlib.planning.routes import Feasible, find_route
from affordlib.planning.skills import Skills
from affordlib.primitives import Drag, Move, Primitive
from affordlib.types import Goal, Observation, Obstacle, Plan

Point = tuple[float, float]

REFUSED_WITHIN_M, REFUSED_WITHIN_RAD = 0.01, math.radians(6)
"""Actions this near to a refused action, in position [m] and direction [rad], are excluded."""

WAYPOINT_TOLERANCE_M = 0.01


class Ending(NamedTuple):
    """How a closed loop ends: the `status` and `message` of its `ClosedLoopResult`."""

    status: str
    message: str


class MovePlanner:
    """Plans to a position; remembers which actions the kinematics has refused.

    max_plans: vetoed plans to one position before another route is tried; max_routes: vetoed routes
    before none is left. vetoes: number of refused actions.
    """

    def __init__(
        self,
        robot: Robot,
        skills: Skills,
        planner: Planner,
        mode: PlanMode,
        max_plans: int = 12,
        max_routes: int = 150,
    ) -> None:
        self.robot, self.skills, self.planner, self.mode = robot, skills, planner, mode
        self.max_plans, self.max_routes = max_plans, max_routes
        self.vetoes = 0
        self._goal_xy_m, self._ends_m = (0.0, 0.0), [math.inf]  # of the current goal and its plans
        self._obstacles: tuple[Obstacle, ...] = ()
        self._refused: list[tuple[str, np.ndarray, float]] = []
        self._blocked: dict[type[Primitive], set[tuple[int, int]]] = defaultdict(set)

    def plan(self, seen: Observation, goal: Goal, grip_yaw: float | None = None) -> Plan | Ending:
        """A plan that the arm can follow from the object's observed position, or an `Ending`.

        grip_yaw: drag with the hand at this yaw if possible, even if the image suggests a push.
        """
        if grip_yaw is not None and Drag.name in self.skills.models:
            plan = self._plan(seen, goal, Drag)
            if isinstance(plan, Plan):
                grips = (replace(step.primitive, grip_yaw=grip_yaw) for step in plan.steps)
                steps = zip(plan.steps, grips, strict=True)
                return replace(plan, steps=tuple(replace(s, primitive=grip) for s, grip in steps))
        return self._plan(seen, goal)

    def _plan(self, seen: Observation, goal: Goal, kind: type[Move] | None = None) -> Plan | Ending:
        effects = self.skills.effects(seen.image, kind)
        self._obstacles, distance_m = seen.obstacles, goal.distance_m(seen.xy_m)
        try:
            self._whole = self._problem(effects, seen.xy_m, goal)
        except ValueError as error:
            return Ending("unreachable", f"the position: {error}")
        plan, self._goal_xy_m, self._ends_m = None, goal.xy_m, [distance_m]
        if distance_m <= self.mode.max_steps * effects.reach_m:
            plan = self._plan_to(effects, seen.xy_m, goal, goal.tolerance_m)
        if plan is None:
            route = self._feasible_route(effects, seen.xy_m, goal.xy_m)
            if route is None:
                at, why = "({:.3f}, {:.3f}) m".format(*goal.xy_m), "the arm cannot bring it there"
                why += " past the obstacles" * bool(seen.obstacles)
                return Ending("unreachable", f"the position {at}: {why}")
            plan = self._plan_along(effects, seen.xy_m, goal, route)
        if not plan and seen.obstacles:
            best_mm = 1000 * min(self._ends_m)
            return Ending(
                "unreachable",
                f"the position: no plan is found that the arm can follow past the obstacles; the "
                f"best ends {best_mm:.1f} mm from the goal",
            )
        return plan or Ending(
            "gave_up",
            f"{1000 * distance_m:.1f} mm from the goal, the planner finds no plan that the arm can "
            f"follow; the best ends {1000 * min(self._ends_m):.1f} mm from it, and planning again "
            "from the same place gives the same",
        )

    def _plan_along(
        self, effects: EffectMap, start: Point, goal: Goal, route: list[Point]
    ) -> Plan | None:
        """Plan as far along a route as possible; straight towards the goal if a route continues."""
        farthest_m = 0.98 * self.mode.max_steps * effects.reach_m
        ahead = np.subtract(goal.xy_m, start)
        distance_m = float(np.hypot(*ahead))
        stops = [place for place in route if math.dist(start, place) <= farthest_m]
        if distance_m > farthest_m:
            straight = tuple((np.array(start) + farthest_m / distance_m * ahead).tolist())
            on_table = self.skills.table.holds(np.array([straight]), effects.radius_m)[0]
            if on_table and self._route(effects, straight, goal.xy_m):
                stops.append(straight)
        for stop in reversed(stops):
            within_m = WAYPOINT_TOLERANCE_M
            if stop == tuple(goal.xy_m):
                within_m = max(goal.tolerance_m, 0.5 * distance_m)
            plan = self._plan_to(effects, start, Goal(stop, goal.tolerance_m), within_m)
            if plan is not None:
                return plan
        return None

    def _plan_to(
        self, effects: EffectMap, start: Point, goal: Goal, within_m: float
    ) -> Plan | None:
        """A plan that ends within a distance of a goal and passes the kinematic check."""
        for _ in range(self.max_plans):
            plan = self.planner(self._problem(effects, start, goal))
            self._ends_m.append(math.dist(plan.predicted_end_xy_m, self._goal_xy_m))
            if not plan.steps or plan.predicted_distance_m > within_m:
                return None
            starts = [start, *(step.predicted_end_xy_m for step in plan.steps)]
            moves = zip(plan.steps, starts, strict=False)
            if self._first_refused((s.primitive, s.stop_phase, at) for s, at in moves) is None:
                return plan
        return None

    def _problem(self, effects: EffectMap, start: Point, goal: Goal) -> PlanningProblem:
        allowed = self._allowed(effects.kind)
        more = {"table": self.skills.table, "obstacles": self._obstacles}
        return PlanningProblem(start, goal, effects, self.mode, allowed, **more)

    def _feasible_route(
        self, effects: EffectMap, start: Point, goal_xy_m: Point
    ) -> list[Point] | None:
        """Places on a route to the goal, each action of which passes the kinematic check."""
        for _ in range(self.max_routes):
            route = self._route(effects, start, goal_xy_m)
            if route is None:
                return None
            moves = list(pairwise([start, *route]))
            k = self._first_refused((*_straight_action(effects, a, b), a) for a, b in moves)
            if k is None:
                return route
            if 0 < k < len(moves) - 1:
                place_at = self.skills.routes(effects.kind).place_at
                self._blocked[effects.kind].add((place_at(moves[k][0]), place_at(moves[k][1])))
        return None

    def _route(self, effects: EffectMap, start: Point, goal_xy_m: Point) -> list[Point] | None:
        kind = effects.kind
        routes, allowed = self.skills.routes(kind), self._allowed(kind)
        if self._obstacles:
            arm_can, space, action = allowed, self._whole.free_space, kind.towards(0.0)

            def allowed(xy_m, direction_rad, length_m):
                free = space.is_free_line(action, xy_m, direction_rad, length_m)
                return free & arm_can(xy_m, direction_rad)

            routes = routes.only(allowed)
        return find_route(routes, start, goal_xy_m, allowed, self._blocked[kind], effects.radius_m)

    def _allowed(self, kind: type[Primitive]) -> Feasible:
        """Where the arm can act: learned reachability, without the actions refused so far."""
        learned = self.skills.reachable(kind)
        refused = [(xy, angle) for name, xy, angle in self._refused if name == kind.name]

        def allowed(xy_m, direction_rad, length_m=None):
            ok = learned(xy_m, direction_rad)
            for xy, angle in refused:
                near = np.hypot(*(xy_m - xy).T) < REFUSED_WITHIN_M
                off = (direction_rad - angle + np.pi) % (2 * np.pi) - np.pi
                ok = ok & ~(near & (np.abs(off) < REFUSED_WITHIN_RAD))
            return ok

        return allowed

    def _first_refused(self, actions: Iterable[tuple[Primitive, float, Point]]) -> int | None:
        """Index of the first action that the kinematics refuses, which is then excluded; else None.

        actions: primitive, phase at which it stops, and position of the object before it. The
        primitives are checked, not a decoded trajectory or the grip of a drag.
        """
        for k, (action, stop_phase, at) in enumerate(actions):
            if not self.robot.can_reach(action, stop_phase, at):
                self.vetoes += 1
                self._refused.append((action.name, np.array(at), action.direction_rad))
                return k
        return None


def _straight_action(effects: EffectMap, start: Point, end: Point) -> tuple[Primitive, float]:
    """The action straight from one place to another, and the phase at which it arrives."""
    move = np.subtract(end, start)
    angle = math.atan2(move[1], move[0])
    phase = torch.linspace(0, 1, 101, dtype=torch.float64)
    with torch.no_grad():
        ahead = effects(torch.full_like(phase, angle), phase)[0][:, 0].numpy()
    stop = float(phase[min(int(np.searchsorted(ahead, np.hypot(*move))), 100)])
    return effects.kind.towards(angle), stop
