"""Seeded schedules of disturbances: the object is shoved, knocked or toppled, or the goal moves.

They happen between actions, or during one through the world's callback per simulation step.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from affordlib.geometry import extruded
from affordlib.planning.robot import Execution
from affordlib.types import TABLE_X_M, TABLE_Y_M, Goal, Observation, Step
from affordlib.world import Tabletop
from affordlib.world.trajectory import STEP_S

KINDS = ("shove", "knock", "topple", "goal")
STEPS_PER_S = round(1 / STEP_S)
TIPPING_S = 1.0
TOPPLING = 1.5
"""Factor on the energy that tips an object onto its edge, since sliding dissipates some of it."""
EDGE_M = 0.15  # margin at the table's edge [m] into which disturbances move neither object nor goal


@dataclass(frozen=True)
class Disturbance:
    """One disturbance: before an action, or at_s seconds after the action began.

    kind: "shove" displaces the object by (x, y) [m] and rotates it [rad], only between actions;
    "knock" changes its velocity by (x, y) [m/s] and turn [rad/s]; "topple" tips it over towards (x,
    y); "goal" displaces the goal by (x, y) [m]. action: counted from 0. If the action ends before
    at_s, the disturbance happens at its end.
    """

    kind: str
    action: int
    x: float
    y: float
    turn: float = 0.0
    at_s: float | None = None

    def apply(self, world: Tabletop, goal: Goal) -> Goal:
        """Apply the disturbance to the world, and return the goal after it."""
        if self.kind == "goal":
            return replace(goal, xy_m=_inside(goal.xy_m[0] + self.x, goal.xy_m[1] + self.y))
        if self.kind == "shove":
            x, y, _ = world.object_pose()
            to = _inside(x + self.x, y + self.y)
            world.shove(to[0] - x, to[1] - y, self.turn)
        elif self.kind == "knock":
            _set_in_motion(world, (self.x, self.y, 0.0), (0.0, 0.0, self.turn))
        elif not world.placed.rolls():
            _topple(world, math.atan2(self.y, self.x))
        return goal


def _topple(world: Tabletop, direction_rad: float) -> None:
    """Give the object the spin that tips it over the edge of its base in a direction [rad]."""
    c, s = math.cos(direction_rad), math.sin(direction_rad)
    low, high = world.client.getAABB(world.placed.body)
    *centre, i, j, k, w = world.placed.state()
    half = world.obj.height_m / 2
    ends = extruded(world.obj.footprint_m, -half, half)
    corners = Rotation.from_quat([i, j, k, w]).apply(ends)[:, :2]
    out, up = float((corners @ (c, s)).max()), centre[2] - low[2]
    # For a box about its lower edge: inertia per mass, and the rise of its centre.
    inertia = ((2 * out) ** 2 + (high[2] - low[2]) ** 2) / 3
    rise = math.hypot(out, up) - up
    spin = math.sqrt(2 * 9.81 * rise * TOPPLING / inertia) * np.array([-s, c, 0.0])
    _set_in_motion(world, np.cross(spin, [-out * c, -out * s, up]), spin)


def _set_in_motion(world: Tabletop, linear: Sequence[float], angular: Sequence[float]) -> None:
    """Add to the object's velocity [m/s] and to its spin [rad/s]."""
    body, moving = world.placed.body, world.client.getBaseVelocity(world.placed.body)
    world.client.resetBaseVelocity(body, *np.add(moving, (linear, angular)).tolist())


def _inside(x: float, y: float) -> tuple[float, float]:
    """The nearest position outside the margin at the table's edge."""
    (x0, x1), (y0, y1) = TABLE_X_M, TABLE_Y_M
    return min(max(x, x0 + EDGE_M), x1 - EDGE_M), min(max(y, y0 + EDGE_M), y1 - EDGE_M)


class DisturbanceSchedule:
    """A `Robot` that wraps a tabletop and applies disturbances, each once, unknown to the robot.

    goal: the current one (for `run_closed_loop` give `schedule.current_goal`); happened: the
    disturbances applied so far, in order.
    """

    def __init__(self, world: Tabletop, goal: Goal, disturbances: Sequence[Disturbance]) -> None:
        self.world, self.goal = world, goal
        self.happened: list[Disturbance] = []
        self._waiting = list(disturbances)
        self._n_actions = 0

    def current_goal(self) -> Goal:
        return self.goal

    def observe(self) -> Observation:
        """Apply the disturbances due before the next action, then observe as the tabletop does."""
        self._apply([d for d in self._waiting if d.action <= self._n_actions and d.at_s is None])
        return self.world.observe()

    def execute(self, step: Step, seen: Observation | None = None) -> Execution:
        """Execute as the tabletop does, and apply the disturbances due during the action."""
        world, n_steps, on_step = self.world, 0, self.world.on_step
        due = [d for d in self._waiting if d.action <= self._n_actions and d.at_s is not None]

        def watch(world):
            nonlocal n_steps
            n_steps += 1
            for one in [d for d in due if n_steps >= STEPS_PER_S * d.at_s]:
                due.remove(one)
                self._apply([one], settle=False)
            if on_step is not None:
                on_step(world)

        world.on_step = watch if due else on_step
        try:
            done = world.execute(step, seen)
        finally:
            world.on_step = on_step
        self._apply(due)
        self._n_actions += 1
        return done

    def _apply(self, due: Sequence[Disturbance], settle: bool = True) -> None:
        for one in due:
            self._waiting.remove(one)
            self.happened.append(one)
            self.goal = one.apply(self.world, self.goal)
            if settle and one.kind in ("knock", "topple"):
                self.world.settle(TIPPING_S)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.world, name)
