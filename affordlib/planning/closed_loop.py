"""Carrying plans out in the world; the only part of planning that knows PyBullet.

`carry_out` trusts a plan. `pursue` looks after every action (Section 3.4 of the paper): is the
object where it should be, has the goal changed, has the object fallen? If so a new image, a new
plan. It ends in one of four ways, and says so.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from affordlib.planning.chase import Chase, Pursuit, action_limit, path_on_table
from affordlib.planning.continuous import plan_continuous
from affordlib.planning.disturbances import Disturbance
from affordlib.planning.finish import TURN_TOLERANCE_RAD
from affordlib.planning.modes import PlanMode, is_on_table
from affordlib.planning.moves import Demands
from affordlib.planning.repertoire import Repertoire
from affordlib.primitives import wrap_angle
from affordlib.types import (
    Goal,
    NothingSeenError,
    Outcome,
    Plan,
    UnreachableError,
    check_count,
    check_within,
)

if TYPE_CHECKING:
    import affordlib.world

__all__ = ["Pursuit", "action_limit", "carry_out", "pursue"]

Replan = Callable[[np.ndarray, tuple[float, float], Goal], Plan]
"""A planner as (image, start_xy_m, goal) → Plan."""

ENOUGH_M = 0.0003
"""What a corrective action leaves anyway; nearer to the goal than this, none is tried."""

HEIGHT_TOLERANCE_M = 0.003


def carry_out(
    world: affordlib.world.Tabletop,
    plan: Plan,
    corrections: int = 0,
    replan: Replan | None = None,
    enough_m: float = ENOUGH_M,
) -> Outcome:
    """Execute a plan's steps, as planned, and measure where the object rests.

    Open loop: the plan is not revised. Each action is carried out relative to where the object
    then stands, as actions are defined. The distance is taken after the gripper has retreated,
    unless it holds the object, and the object has rested 0.5 s. Raises UnreachableError when the
    arm cannot follow a step; it has the outcome of those before.

    corrections: after the last step, so many single actions at most, each the first of a plan that
    `replan` makes anew from what is then seen, and each only if the object is seen, and farther
    than enough_m [m] from the goal, the plan expects to bring it nearer, and the arm can do it.
    There are none after a plan that ends with the object in the hand.
    """
    if corrections and replan is None:
        raise ValueError(f"corrections = {corrections} need a planner; give replan as well")
    yaw_rad, z_m = world.object_pose()[2], world.object_state()[2]
    paths: list[np.ndarray] = []

    def measured():
        pose = world.object_pose()
        distance = plan.goal.distance_m(pose[:2])
        turned, lifted = wrap_angle(pose[2] - yaw_rad), world.object_state()[2] - z_m
        return Outcome(plan, distance, pose, world.object_tilt_rad(), tuple(paths), turned, lifted)

    for step in plan.steps:
        try:
            paths.append(path_on_table(world.follow(step)))
        except UnreachableError as error:
            error.outcome = measured()
            raise
    held = bool(plan.steps) and plan.steps[-1].primitive.holds
    for _ in range(0 if held else corrections):
        try:
            seen = world.perceive()
        except NothingSeenError:
            break
        off = plan.goal.distance_m(seen.xy_m)
        if off <= enough_m or not is_on_table(np.array([seen.xy_m]))[0] or not seen.image[1].any():
            break
        # A planner content within the goal's tolerance would have nothing to correct.
        exactly = replace(plan.goal, tolerance_m=min(plan.goal.tolerance_m, enough_m))
        steps = replan(seen.image, seen.xy_m, exactly).steps[:1]
        if not steps or plan.goal.distance_m(steps[0].predicted_end_xy_m) >= off:
            break
        if not world.can_reach(steps[0].primitive, steps[0].stop_phase):
            break
        paths.append(path_on_table(world.follow(steps[0])))
    return measured()


def pursue(
    world: affordlib.world.Tabletop,
    goal: Goal,
    repertoire: Repertoire,
    planner: Callable[..., Plan] = plan_continuous,
    turn_tolerance_rad: float = TURN_TOLERANCE_RAD,
    height_tolerance_m: float = HEIGHT_TOLERANCE_M,
    max_actions: int | None = None,
    disturbances: Sequence[Disturbance] = (),
    horizon: int = 3,
    on_action: Callable[[Plan, int], Goal | None] | None = None,
    on_plan: Callable[[Plan], None] | None = None,
) -> Pursuit:
    """Bring the object to a goal, whatever happens on the way: position, orientation, height.

    planner: called as plan_astar and plan_continuous are; horizon: the longest chain it is asked
    for. max_actions: default `action_limit` of the distance, renewed when the goal moves or
    somebody displaces the object (that at most three times). The position holds when the object is
    seen within the goal's own tolerance. disturbances: what shall happen.
    on_action: called with the plan and the number of actions taken, after each; it may return a
    new goal. on_plan: called with every plan before its first action. Never moves where the arm's
    kinematics says no.
    """
    check_within("height_tolerance_m", height_tolerance_m, 1e-5, 0.1, "m")
    check_within("turn_tolerance_rad", turn_tolerance_rad, 1e-4, math.pi, "rad")
    check_count("horizon", horizon, 1, 10)
    if max_actions is not None:
        check_count("max_actions", max_actions, least=0)
    demands = Demands(
        planner,
        PlanMode(horizon, partial=True),
        turn_tolerance_rad,
        height_tolerance_m,
        max_actions,
        on_action,
        on_plan,
    )
    chase = Chase(world, goal, repertoire, demands, disturbances)
    return chase.run()
