"""A seeded schedule of what goes wrong: the object shoved, knocked or toppled, the goal moved.

Between actions, or in the middle of one, by the world's callback at every simulation step.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from affordlib.planning.robot import Execution
from affordlib.types import (
    TABLE_X_M,
    TABLE_Y_M,
    Goal,
    Observation,
    Step,
    check_choice,
    check_count,
    check_field,
)

KINDS = ("shove", "knock", "topple", "goal")
STEPS_PER_S = 240
TIPPING_S = 1.0
EDGE_M = 0.15
"""Of the table, where nothing is shoved to and no goal is put; what is there is moved away."""


@dataclass(frozen=True)
class Disturbance:
    """One thing that happens: before an action, or at_s seconds after it began to move.

    kind: "shove" displaces the object by (x, y) [m] and turns it [rad], only between actions;
    "knock" changes its velocity by (x, y) [m/s] and turn [rad/s]; "topple" tips it over towards
    (x, y); "goal" displaces the goal by (x, y) [m]. action: counted from 0; what should happen in
    the middle of an action that has ended by then happens at its end.
    """

    kind: str
    action: int
    x: float
    y: float
    turn: float = 0.0
    at_s: float | None = None

    def __post_init__(self) -> None:
        check_choice("kind", self.kind, KINDS)
        check_count("action", self.action, least=0)
        for name in ("x", "y", "turn"):
            check_field(self, name)
        if self.at_s is not None:
            check_field(self, "at_s", 0.0, 60.0, "s")
            if self.kind == "shove":
                raise ValueError("a shove happens between actions; give no at_s, or take a knock")

    def apply(self, world: affordlib.world.Tabletop, goal: Goal) -> Goal:
        """Let it happen, and return the goal as it is then."""
        if self.kind == "goal":
            return replace(goal, xy_m=_inside(goal.xy_m[0] + self.x, goal.xy_m[1] + self.y))
        if self.kind == "shove":
            x, y, _ = world.object_pose()
            to = _inside(x + self.x, y + self.y)
            world.shove(to[0] - x, to[1] - y, self.turn)
        elif self.kind == "knock":
            world.placed.knock(self.x, self.y, self.turn)
        elif not world.object_rolls():
            world.placed.topple(math.atan2(self.y, self.x))
        return goal


def _inside(x: float, y: float) -> tuple[float, float]:
    """The nearest place that is not at the table's edge."""
    (x0, x1), (y0, y1) = TABLE_X_M, TABLE_Y_M
    return min(max(x, x0 + EDGE_M), x1 - EDGE_M), min(max(y, y0 + EDGE_M), y1 - EDGE_M)


class DisturbanceSchedule:
    """A `Robot` at a tabletop where disturbances happen, each once, without the robot's knowledge.

    goal: as it has become (for `run_closed_loop` give `schedule.current_goal`); happened: the
    disturbances up to now, in order.
    """

    def __init__(
        self, world: affordlib.world.Tabletop, goal: Goal, disturbances: Sequence[Disturbance] = ()
    ) -> None:
        self.world, self.goal = world, goal
        self.happened: list[Disturbance] = []
        self._waiting = list(disturbances)
        self._n_actions = 0

    def current_goal(self) -> Goal:
        """The goal as it is now."""
        return self.goal

    def observe(self) -> Observation:
        """As the tabletop does, after what comes before the next action has happened."""
        self._apply([d for d in self._waiting if d.action <= self._n_actions and d.at_s is None])
        return self.world.observe()

    def execute(self, step: Step) -> Execution:
        """As the tabletop does; what comes in the middle of the action happens when it is due."""
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
            done = world.execute(step)
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
        """All else as the tabletop does."""
        return getattr(self.world, name)
