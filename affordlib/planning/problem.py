"""What every planner solves, and the three settings of Table 3."""

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from affordlib.planning.effect_map import EffectMap
from affordlib.types import (
    TABLE_X_M,
    TABLE_Y_M,
    Goal,
    Plan,
    Step,
    check_choice,
    check_count,
    check_on_table,
)

Reachable = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""Which of the positions (n, 2) and directions (n,) the arm can act at."""


def everywhere(xy_m: np.ndarray, *_: np.ndarray) -> np.ndarray:
    """The arm can act at all positions (n, 2), in all directions."""
    return np.ones(len(xy_m), bool)


@dataclass(frozen=True)
class PlanMode:
    """How many actions a plan may have, and whether they may stop before the end."""

    max_steps: int
    partial: bool

    def __post_init__(self) -> None:
        check_count("max_steps", self.max_steps, 1, 10)


MODES: dict[str, PlanMode] = {
    "single_full": PlanMode(1, partial=False),
    "single_partial": PlanMode(1, partial=True),
    "multi_partial": PlanMode(3, partial=True),
}


def is_on_table(xy_m: np.ndarray, radius_m: float = 0.0) -> np.ndarray:
    """Which of the points (n, 2) lie on the table, farther than a radius [m] from its rim."""
    (x0, x1), (y0, y1) = TABLE_X_M, TABLE_Y_M
    inside = np.array(xy_m) - (x0 + radius_m, y0 + radius_m)
    return ((inside >= 0) & (inside <= (x1 - x0 - 2 * radius_m, y1 - y0 - 2 * radius_m))).all(-1)


def check_has_room(goal: Goal, radius_m: float) -> None:
    """Raise ValueError where an object of a radius [m] would not stand on the table as a whole."""
    if not is_on_table(np.array([goal.xy_m]), radius_m)[0]:
        x, y = goal.xy_m
        raise ValueError(
            f"goal xy_m = ({x:g}, {y:g}) m is too near the rim of the table for an object that "
            f"reaches {100 * radius_m:.1f} cm from its middle"
        )


@dataclass(frozen=True)
class PlanningProblem:
    """Bring an object from a start [m] to a goal, by actions with known effects.

    mode: a `PlanMode`, or its name in `MODES`. reachable: a function of positions (n, 2) and
    directions (n,) that says where the arm can act (default: everywhere). pose_planner: what turns
    and lifts the object at the end, without which a plan cannot reach a goal that asks for it.
    Raises ValueError where the object would not stand on the table as a whole.
    """

    start_xy_m: tuple[float, float]
    goal: Goal
    effects: EffectMap
    mode: str | PlanMode = "multi_partial"
    reachable: Reachable = everywhere
    pose_planner: Callable[..., tuple[Step, ...] | None] | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "start_xy_m", check_on_table("start_xy_m", self.start_xy_m))
        if not isinstance(self.mode, PlanMode):
            object.__setattr__(self, "mode", MODES[check_choice("mode", self.mode, MODES)])
        check_has_room(self.goal, self.effects.radius_m)

    def plan_of(
        self, steps: tuple[Step, ...], planner: str, reaches_goal: bool, began_s: float
    ) -> Plan:
        """The plan of some steps, with what turns and lifts the object at their end, and its time.

        began_s: when planning began, by `time.perf_counter`.
        """
        goal, end_xy_m = self.goal, steps[-1].predicted_end_xy_m if steps else self.start_xy_m
        if reaches_goal and (goal.turn_rad is not None or goal.height_m is not None):
            turned, std_m = (steps[-1].predicted_turn_rad, steps[-1].std_m) if steps else (0.0, 0.0)
            end = self.pose_planner and self.pose_planner(goal, end_xy_m, turned, std_m)
            steps, reaches_goal = steps + (end or ()), end is not None
        # A search that rounds may have been a hair nearer to the goal than its plan.
        reaches_goal &= goal.distance_m(end_xy_m) <= goal.tolerance_m
        seconds, about = time.perf_counter() - began_s, self.effects.warning
        return Plan(goal, self.start_xy_m, steps, planner, reaches_goal, seconds, about)
