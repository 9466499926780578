"""The planning problem that every planner solves, and the three settings of Table 3."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np
import torch

from affordlib.planning.effect_map import EffectMap, poses_along
from affordlib.planning.free_space import N_POSES, FreeSpace
from affordlib.types import (
    Checked,
    Goal,
    Obstacle,
    Plan,
    Step,
    check_choice,
    check_count,
    check_on_table,
    on_table,
    parameter,
)

Reachable = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""Function of positions (n, 2) and directions (n,): whether the arm can act there, (n,)."""


def everywhere(xy_m: np.ndarray, *_: np.ndarray) -> np.ndarray:
    """Say that the arm can act at all positions (n, 2), in all directions."""
    return np.ones(len(xy_m), bool)


@dataclass(frozen=True)
class PlanMode(Checked):
    """Maximum number of actions of a plan, and whether they may stop before phase 1."""

    max_steps: int = parameter(partial(check_count, least=1, most=10))
    partial: bool

    @classmethod
    def of(cls, mode: "str | PlanMode") -> "PlanMode":
        """Return a mode, or that of a name in `MODES`; raises ValueError for other names."""
        return mode if isinstance(mode, PlanMode) else MODES[check_choice("mode", mode, MODES)]


MODES: dict[str, PlanMode] = {
    "single_full": PlanMode(1, partial=False),
    "single_partial": PlanMode(1, partial=True),
    "multi_partial": PlanMode(3, partial=True),
}


@dataclass(frozen=True)
class PlanningProblem(Checked):
    """Bring an object from a start [m] to a goal, by actions with known effects.

    mode: a `PlanMode`, or its name in `MODES`. reachable: function of positions (n, 2) and
    directions (n,): whether the arm can act there (default: everywhere). pose_planner: plans the
    final rotation and lift, without which a plan cannot reach a goal that requires them. obstacles:
    which neither object nor hand may touch. Raises ValueError where the object would extend beyond
    the rim of the table, or an obstacle lies on it or its goal.
    """

    start_xy_m: tuple[float, float] = parameter(check_on_table)
    goal: Goal
    effects: EffectMap
    mode: str | PlanMode = parameter(lambda _, mode: PlanMode.of(mode), "multi_partial")
    reachable: Reachable = everywhere
    pose_planner: Callable[..., tuple[Step, ...] | None] | None = None
    obstacles: tuple[Obstacle, ...] = ()

    def __post_init__(self) -> None:
        super().__post_init__()
        (x, y), radius_m = self.goal.xy_m, self.effects.radius_m
        if not on_table(np.array([x, y]), radius_m):
            raise ValueError(
                f"goal xy_m = ({x:g}, {y:g}) m is off the table, or too near the rim of the table "
                f"for an object with a radius of {100 * radius_m:.1f} cm; move it inwards"
            )
        if self.obstacles:
            self.free_space.check(self.goal.xy_m)

    @cached_property
    def free_space(self) -> FreeSpace:
        """The free-space check for the obstacles and the object."""
        effects = self.effects
        return FreeSpace(self.obstacles, effects.image, self.start_xy_m, effects.outline_m)

    def spare_m(
        self, begins: np.ndarray, direction_rad: torch.Tensor, phase: torch.Tensor
    ) -> np.ndarray:
        """Gap minus margin [m] (n,) of actions to the obstacles; negative where they are not free.

        begins: (n, 3), x, y [m] and turn [rad] before them; direction_rad, phase: (n,).
        """
        poses = poses_along(self.effects, begins, direction_rad, phase, N_POSES)
        angle, stop = direction_rad.numpy(), phase.numpy()
        return self.free_space.spare_m(self.effects.kind.towards(0.0), angle, stop, poses)

    def plan_of(
        self, steps: tuple[Step, ...], planner: str, reaches_goal: bool, began_s: float
    ) -> Plan:
        """Make a `Plan` of some steps: append those that rotate and lift, and record the time.

        began_s: when planning began, by `time.perf_counter`.
        """
        goal, end_xy_m = self.goal, steps[-1].predicted_end_xy_m if steps else self.start_xy_m
        if reaches_goal and len(goal.errors(end_xy_m)) > 1:
            turned, std_m = (steps[-1].predicted_turn_rad, steps[-1].std_m) if steps else (0.0, 0.0)
            end = self.pose_planner and self.pose_planner(goal, end_xy_m, turned, std_m)
            steps, reaches_goal = steps + (end or ()), end is not None
        # A search with rounded values may end slightly nearer to the goal than its plan.
        reaches_goal &= goal.distance_m(end_xy_m) <= goal.tolerance_m
        seconds = time.perf_counter() - began_s
        return Plan(goal, self.start_xy_m, steps, planner, reaches_goal, seconds)


Planner = Callable[[PlanningProblem], Plan]
"""A planner, such as `plan_astar`, or one with settings: `partial(plan_continuous, seed=1)`."""
