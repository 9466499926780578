"""Carrying plans out in the world; the only part of planning that knows PyBullet."""

from __future__ import annotations

from typing import TYPE_CHECKING

from affordlib.types import Outcome, Plan

if TYPE_CHECKING:
    from affordlib.world import Tabletop


def carry_out(world: Tabletop, plan: Plan) -> Outcome:
    """Execute a plan's steps, as planned, and measure where the object rests.

    Open loop: the plan is never revised. Each action is carried out relative to where the object
    then stands, as actions are defined. The distance is taken after the gripper has retreated and
    the object has rested 0.5 s. Raises UnreachableError when the arm cannot follow a step.
    """
    paths = []
    for step in plan.steps:
        seen = world.follow(step)
        paths.append(seen.effect[:, :2] + seen.start_pose[:2])
    pose = world.object_pose()
    distance = plan.goal.distance_m(pose[:2])
    return Outcome(plan, distance, pose, world.object_tilt_rad(), tuple(paths))
