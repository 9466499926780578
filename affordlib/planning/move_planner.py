"""Plans of pushes and drags that the arm can follow: a model proposes, the kinematics vetoes."""

import math
from collections import defaultdict
from collections.abc import Callable, Iterable
from dataclasses import replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import torch

from affordlib.planning.effect_map import EffectMap
from affordlib.planning.problem import PlanMode, PlanningProblem, check_has_room, is_on_table
from affordlib.planning.robot import Robot
from affordlib.planning.routes import Feasible, find_route, place_at
from affordlib.planning.skills import Skills
from affordlib.primitives import Drag, Move, Primitive
from affordlib.types import Goal, Observation, Plan

Point = tuple[float, float]

MAX_VETOED_PLANS = 12
"""Maximum number of vetoed plans to one position before another route is tried."""

MAX_VETOED_ROUTES = 150
REFUSED_WITHIN_M, REFUSED_WITHIN_RAD = 0.01, math.radians(6)
"""Actions this near to a refused action, in position [m] and direction [rad], are excluded."""

WAYPOINT_TOLERANCE_M = 0.01


class Ending(NamedTuple):
    """How a closed loop ends: one of `closed_loop.STATUSES`, and a message."""

    status: str
    message: str


class MovePlanner:
    """Plans to a position; remembers which actions the kinematics has refused.

    vetoes: number of refused actions.
    """

    def __init__(
        self,
        robot: Robot,
        skills: Skills,
        planner: Callable[[PlanningProblem], Plan],
        mode: PlanMode,
    ) -> None:
        self.robot, self.skills, self.planner, self.mode = robot, skills, planner, mode
        self.vetoes = 0
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
        try:
            check_has_room(goal, effects.radius_m)
        except ValueError as error:
            return Ending("unreachable", f"the position: {error}")
        distance_m = goal.distance_m(seen.xy_m)
        plan = None
        if distance_m <= self.mode.max_steps * effects.reach_m:
            plan = self._plan_to(effects, seen.xy_m, goal, goal.tolerance_m)
        if plan is None:
            route = self._feasible_route(effects, seen.xy_m, goal.xy_m)
            if route is None:
                at = "({:.3f}, {:.3f}) m".format(*goal.xy_m)
                return Ending("unreachable", f"the position {at}: the arm cannot bring it there")
            plan = self._plan_along(effects, seen.xy_m, goal, route)
        nearest = f"no action is predicted to bring it nearer than {1000 * distance_m:.1f} mm"
        return plan or Ending("gave_up", nearest)

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
            if is_on_table(np.array([straight]), effects.radius_m)[0] and self._route(
                effects, straight, goal.xy_m
            ):
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
        for _ in range(MAX_VETOED_PLANS):
            allowed = self._allowed(effects.kind)
            plan = self.planner(PlanningProblem(start, goal, effects, self.mode, allowed))
            if not plan.steps or plan.predicted_distance_m > within_m:
                return None
            starts = [start, *(step.predicted_end_xy_m for step in plan.steps)]
            moves = zip(plan.steps, starts, strict=False)
            if self._first_refused((s.primitive, s.stop_phase, at) for s, at in moves) is None:
                return plan
        return None

    def _feasible_route(
        self, effects: EffectMap, start: Point, goal_xy_m: Point
    ) -> list[Point] | None:
        """Places on a route to the goal, each action of which passes the kinematic check."""
        for _ in range(MAX_VETOED_ROUTES):
            route = self._route(effects, start, goal_xy_m)
            if route is None:
                return None
            moves = list(pairwise([start, *route]))
            k = self._first_refused((*_straight_action(effects, a, b), a) for a, b in moves)
            if k is None:
                return route
            if 0 < k < len(moves) - 1:
                self._blocked[effects.kind].add((place_at(moves[k][0]), place_at(moves[k][1])))
        return None

    def _route(self, effects: EffectMap, start: Point, goal_xy_m: Point) -> list[Point] | None:
        kind = effects.kind
        routes, allowed = self.skills.routes(kind), self._allowed(kind)
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
