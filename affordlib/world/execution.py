"""Executing one command on the object, from the arm's approach to the object at rest."""

import math
from typing import Any

import numpy as np

from affordlib.primitives import Grasp
from affordlib.types import Interaction, Observation, UnreachableError
from affordlib.world import robot
from affordlib.world.controller import JointController, Recording
from affordlib.world.placed_object import PlacedObject, poses
from affordlib.world.trajectory import UP, Command, joint_move, line, plan_motion, recorded_phases

SETTLE_STEPS = 120
PUT_DOWN_M = 0.002
"""From this height an object that is put down is let go."""
RECORDED_SAMPLES = 26
"""Of the measured tool: one every 3 steps of 50 ms, as in the paper: t = 0 and 25 more."""

_HOME = np.array(robot.HOME)


def execute(
    arm: JointController,
    placed: PlacedObject,
    command: Command,
    seen: Observation,
    tip_offset_m: float,
    approach: bool,
) -> Interaction:
    """Execute a command where the object was seen, the tool higher by an offset [m].

    approach: the arm moves there through the air and back home, and the table brakes what rolls
    before and after what is recorded; otherwise it is placed at the start, and home in the end.
    Raises UnreachableError, and moves nothing, when the arm cannot follow.
    """
    primitive = command.primitive
    start = poses(np.array([placed.state()]))[0]
    offset = np.array([*seen.xy_m, tip_offset_m, 0.0, 0.0])
    motion = plan_motion(primitive, command.segments, offset, approach)
    gaps = motion.gaps

    closes = any(np.ptp(gap) > 0 for gap in gaps)
    arm.set_fingers(primitive.force_N, closes)
    if closes:
        arm.tie_fingers()
    if approach:
        placed.brake(True)
        over = joint_move(arm.angles_rad, motion.over_start, 1.0)
        arm.follow(over, np.linspace(arm.gap_m, gaps[0][0], 2))
        arm.follow(motion.down, gaps[0][[0, 0]])
    else:
        arm.put(motion.paths[0][0], gaps[0][0])
    placed.brake(False)

    recording, floor = Recording(placed.body), -math.inf
    for segment, one, path, gap in zip(
        command.segments, motion.poses_W, motion.paths, gaps, strict=True
    ):
        if one[:, 2].min() < floor:
            one = one.copy()
            one[:, 2] = np.maximum(one[:, 2], floor)
            try:
                path = robot.joint_path(one, arm.angles_rad, primitive.tool)
            except UnreachableError:  # it stays where it felt the object, off its path
                path = np.repeat(arm.angles_rad[None], len(one), axis=0)
        covered = arm.follow(path, gap, recording, segment, one)
        if segment.guarded and covered < 1.0:
            floor = float(np.interp(covered, np.linspace(0, 1, len(one)), one[:, 2]))
    arm.record(recording)
    placed.brake(approach)

    if not primitive.holds:
        release = np.array([arm.gap_m, primitive.opening_m if closes else arm.gap_m])
        if release[1] > release[0]:
            arm.follow(np.repeat(arm.angles_rad[None], 13, axis=0), np.linspace(*release, 13))
        arm.follow(motion.out, release[[1, 1]])
        if approach:
            arm.follow(joint_move(arm.angles_rad, _HOME, 1.0), release[[1, 1]])
    arm.wait(SETTLE_STEPS)
    if not primitive.holds:
        arm.untie()
    interaction = _interaction(command, placed, recording, seen, start, offset)
    if not (approach or primitive.holds):
        arm.put(_HOME, arm.gap_m)
    return interaction


def _interaction(
    command: Command,
    placed: PlacedObject,
    recording: Recording,
    seen: Observation,
    start: np.ndarray,
    offset: np.ndarray,
) -> Interaction:
    """What was recorded, interpolated at the command's phases."""
    phase = command.phase
    recorded = poses(placed.states_of_centre(np.array(recording.states)))
    rest = poses(np.array([placed.state()]))[0]
    # The yaw nearest to the last recorded one, which is unwrapped.
    rest[3] = recorded[-1, 3] + (rest[3] - recorded[-1, 3] + math.pi) % (2 * math.pi) - math.pi
    origin = np.array([*start[:3], recorded[0, 3], 0.0])
    at_sample, at_waypoint = recorded_phases(command.segments)
    effect = recorded - origin
    tool = np.array(recording.tool) - np.array([*offset[:3], 0.0, 0.0])
    tool[:, 3] = np.unwrap(tool[:, 3])
    seldom = np.linspace(0, phase[-1], RECORDED_SAMPLES)
    return Interaction(
        **_commanded(command, placed, seen),
        effect=np.column_stack([np.interp(phase, at_sample, effect[:, c]) for c in range(5)]),
        rest_effect=rest - origin,
        start_pose=(float(start[0]), float(start[1]), float(recorded[0, 3])),
        tracking_error_m=recording.off_path_m,
        tool=np.column_stack([np.interp(seldom, at_waypoint, tool[:, c]) for c in range(5)]),
        penetration_m=recording.penetration_m,
        left_table=placed.left_table(),
        fell=placed.fell(),
    )


def _commanded(command: Command, placed: PlacedObject, seen: Observation) -> dict[str, Any]:
    """What an interaction tells of the action, and of what was seen, whether it was reached."""
    return {
        "primitive": command.primitive,
        "stop_phase": float(command.phase[-1]),
        "phase": command.phase,
        "action": command.action,
        "image": seen.image,
        "estimated_xy_m": seen.xy_m,
        "rolls": placed.rolls(),
    }


def unreached(command: Command, placed: PlacedObject, seen: Observation) -> Interaction:
    """The interaction that was out of the arm's reach: commanded, but nothing moved."""
    return Interaction(
        **_commanded(command, placed, seen),
        effect=np.zeros((len(command.phase), 5)),
        rest_effect=np.zeros(5),
        start_pose=placed.pose(),
        tool=np.zeros((RECORDED_SAMPLES, 5)),
        tracking_error_m=0.0,
        penetration_m=0.0,
        left_table=False,
        fell=False,
        reached=False,
    )


def put_down(arm: JointController, placed: PlacedObject | None) -> None:
    """Lower what the hand holds to the table, open the fingers, rise and go home."""
    below_m = 0.0 if placed is None else placed.lowest_m()
    here = np.append(arm.tool_pose()[:4], 0.0)
    down = np.repeat(arm.angles_rad[None], 2, axis=0)
    if below_m > PUT_DOWN_M:
        down = line(here, here - (below_m - PUT_DOWN_M) * UP, arm.angles_rad, 1.0, arm.tool)
    wide = np.linspace(arm.gap_m, max(arm.gap_m, Grasp.opening_m), 13)
    arm.set_fingers(Grasp.force_N, closing=True)
    arm.follow(down, wide[[0, 0]])
    arm.follow(np.repeat(arm.angles_rad[None], 13, axis=0), wide)
    arm.untie()
    arm.follow(down[::-1], wide[[-1, -1]])
    arm.follow(joint_move(arm.angles_rad, _HOME, 1.0), wide[[-1, -1]])
