"""Plans of moves that the arm can follow: the learned model proposes, the kinematics vetoes."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
import torch

from affordlib.planning.effect_map import EffectMap
from affordlib.planning.problem import (
    PlanMode,
    PlanningProblem,
    Reachable,
    check_has_room,
    is_on_table,
)
from affordlib.planning.routes import CELL_M, Feasible, find_route, places
from affordlib.planning.skills import Skills
from affordlib.primitives import Primitive
from affordlib.types import Goal, Observation, Plan, Step

if TYPE_CHECKING:
    from affordlib.world import Tabletop

MAX_VETOES = 12
"""Of plans to one place; then another way is looked for."""

MAX_REFUSED_WAYS = 150
BARRED_M, BARRED_RAD = 0.01, math.radians(6)
WAYPOINT_M = 0.01


class Ended(Exception):
    """A closed loop has come to an end: its status, and a message."""


class MovePlanner:
    """Finds steps towards a position; remembers what the kinematics has refused.

    plans: all that were accepted; vetoes: how often the kinematics said no.
    """

    def __init__(
        self,
        world: Tabletop,
        skills: Skills,
        planner: Callable[[PlanningProblem], Plan],
        mode: PlanMode,
    ) -> None:
        self.world, self.skills, self.planner, self.mode = world, skills, planner, mode
        self.plans: list[Plan] = []
        self.vetoes = 0
        self._barred: list[tuple[str, np.ndarray, float]] = []
        self._barred_moves: dict[str, list[tuple[int, int, int]]] = {}

    def steps(self, seen: Observation, goal: Goal, so_far: str) -> list[Step]:
        """The steps of a plan, from where the object is seen, that the arm can follow.

        Raises `Ended` where there is none; so_far: what to say has been done.
        """
        effects = self.skills.effects(seen.image)
        try:
            check_has_room(goal, effects.radius_m)
        except ValueError as error:
            raise Ended("unreachable", f"the position: {error}") from None
        off = goal.distance_m(seen.xy_m)
        plan = None
        if off <= self.mode.max_steps * effects.reach_m:
            plan = self._plan_to(effects, seen, goal, goal.tolerance_m)
        if plan is None:
            way = self._way(effects, seen, goal)
            if way is None:
                x, y = goal.xy_m
                raise Ended(
                    "unreachable",
                    f"the position ({x:.3f}, {y:.3f}) m: from where the object is, no chain of "
                    "actions that the arm can carry out leads there",
                )
            plan = self._plan_along(effects, seen, goal, way)
        if plan is None:
            raise Ended(
                "gave_up",
                f"after {so_far}: no action is foreseen to bring the object nearer to its "
                f"position than {1000 * off:.1f} mm",
            )
        self.plans.append(plan)
        return list(plan.steps)

    def _plan_along(
        self, effects: EffectMap, seen: Observation, goal: Goal, way: list[tuple[float, float]]
    ) -> Plan | None:
        """A plan that goes as far along a way as it can, straight ahead if a way leads on."""
        here, ahead = np.array(seen.xy_m), np.subtract(goal.xy_m, seen.xy_m)
        farthest = 0.98 * self.mode.max_steps * effects.reach_m
        off = float(np.hypot(*ahead))
        routes = self.skills.routes(effects.kind)
        stops = [tuple(place) for place in way if math.dist(here, place) <= farthest]
        if off > farthest:
            straight = tuple((here + farthest / off * ahead).tolist())
            barred, room = self._barred_moves[effects.kind.name], effects.radius_m
            judged = self._judged(effects.kind)
            if is_on_table(np.array([straight]), room)[0] and find_route(
                routes, straight, goal.xy_m, judged, barred, room
            ):
                stops.append(straight)
        for stop in reversed(stops):
            last = stop == tuple(goal.xy_m)
            within = max(goal.tolerance_m, 0.5 * off) if last else WAYPOINT_M
            plan = self._plan_to(effects, seen, Goal(stop, goal.tolerance_m), within)
            if plan is not None:
                return plan
        return None

    def _plan_to(
        self, effects: EffectMap, seen: Observation, aim: Goal, within_m: float
    ) -> Plan | None:
        """A plan that ends within a distance of a goal and that the kinematics lets pass."""
        kind = effects.kind
        for _ in range(MAX_VETOES):
            allowed = self._allowed(kind)
            plan = self.planner(PlanningProblem(seen.xy_m, aim, effects, self.mode, allowed))
            if not plan.steps or plan.predicted_distance_m > within_m:
                return None
            if not self._vetoed(plan):
                return plan
        return None

    def _allowed(self, kind: type[Primitive]) -> Reachable:
        """Where the arm can act: what was learned, less what its kinematics has refused."""
        learned = self.skills.reachable(kind)
        barred = [(xy, angle) for name, xy, angle in self._barred if name == kind.name]

        def judge(xy_m: np.ndarray, direction_rad: np.ndarray) -> np.ndarray:
            good = np.ones(len(xy_m), bool) if learned is None else learned(xy_m, direction_rad)
            for xy, angle in barred:
                near = np.hypot(*(xy_m - xy).T) < BARRED_M
                off = (direction_rad - angle + np.pi) % (2 * np.pi) - np.pi
                good = good & ~(near & (np.abs(off) < BARRED_RAD))
            return good

        return judge

    def _judged(self, kind: type[Primitive]) -> Feasible:
        """The same, of actions of any length."""
        allowed = self._allowed(kind)
        return lambda xy_m, direction_rad, _: allowed(xy_m, direction_rad)

    def _vetoed(self, plan: Plan) -> bool:
        """Whether the arm's kinematics refuses a step; that place and direction are barred then."""
        at = plan.start_xy_m
        for step in plan.steps:
            if not self.world.can_reach(step.primitive, step.stop_phase, at):
                self._bar(step.primitive, at)
                return True
            at = step.predicted_end_xy_m
        return False

    def _bar(self, action: Primitive, xy_m: tuple[float, float]) -> None:
        self.vetoes += 1
        self._barred.append((action.name, np.array(xy_m), action.direction_rad))

    def _way(
        self, effects: EffectMap, seen: Observation, goal: Goal
    ) -> list[tuple[float, float]] | None:
        """Places on the way to a goal, every action of it checked by the kinematics."""
        kind = effects.kind
        routes = self.skills.routes(kind)
        barred = self._barred_moves.setdefault(kind.name, [])
        x, y = places()
        for _ in range(MAX_REFUSED_WAYS):
            judged, room = self._judged(kind), effects.radius_m
            way = find_route(routes, seen.xy_m, goal.xy_m, judged, barred, room)
            if way is None:
                return None
            at = seen.xy_m
            for k, place in enumerate(way):
                action, stop = _action_for(effects, np.subtract(place, at))
                if not self.world.can_reach(action, stop, at):
                    self._bar(action, at)
                    if 0 < k < len(way) - 1:
                        cell = np.argmin(abs(x[:, 0] - at[0])), np.argmin(abs(y[0] - at[1]))
                        move = np.rint(np.subtract(place, at) / CELL_M)
                        number = int(np.flatnonzero((routes.moves == move).all(axis=1))[0])
                        barred.append((number, int(cell[0]), int(cell[1])))
                    break
                at = place
            else:
                return way
        return None


def _action_for(effects: EffectMap, move_m: np.ndarray) -> tuple[Primitive, float]:
    """The action straight along a move (2,) [m], and the phase at which it has gone so far."""
    angle = math.atan2(move_m[1], move_m[0])
    phase = torch.linspace(0, 1, 101, dtype=torch.float64)
    with torch.no_grad():
        ahead = effects(torch.full_like(phase, angle), phase)[0][:, 0].numpy()
    stop = float(phase[min(int(np.searchsorted(ahead, np.hypot(*move_m))), 100)])
    return effects.kind.towards(angle), stop
