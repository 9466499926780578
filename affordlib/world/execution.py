"""Carrying out one primitive on the object, from the first look to the object at rest.

Everything is planned before anything moves, so a way that is out of reach raises and moves nothing.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import pybullet

from affordlib.primitives import TIP_HEIGHT_M, Grasp, Primitive
from affordlib.types import Interaction, Observation, UnreachableError
from affordlib.world import robot
from affordlib.world.motion import (
    HOVER_HEIGHT_M,
    RECORD_EVERY,
    RESTING_M,
    ROLLING_M,
    STEPS_PER_WAYPOINT,
    Drive,
    Stretch,
    joint_move,
    line,
    poses,
    put_arm,
    tie_fingers,
    tool_pose,
    untie_fingers,
)

if TYPE_CHECKING:
    from affordlib.world.scene import Tabletop

SETTLE_STEPS = 120
RETREAT_M = 0.02
PUT_DOWN_M = 0.002
"""From this height an object that is put down is let go."""
RECORDED_SAMPLES = 26
"""One every 3 steps of 50 ms of a full primitive, as in the paper: t = 0 and 25 more."""

_UP = np.array([0.0, 0.0, 1.0, 0.0, 0.0])


@dataclass(frozen=True)
class Motion:
    """All joint waypoints of an action, found before anything moves.

    over_start: (6,) above the start; down: (n, 6) from there to it; poses_W: (n, 5) of the tool at
    the waypoints `paths` (n, 6), and gaps of the fingers (n,) there, of each stretch; retreat,
    lift: (n, 6), the way out.
    """

    over_start: np.ndarray
    down: np.ndarray
    poses_W: list[np.ndarray]
    paths: list[np.ndarray]
    gaps: list[np.ndarray]
    retreat: np.ndarray
    lift: np.ndarray


def plan_motion(
    primitive: Primitive, way: list[Stretch], offset: np.ndarray, approach: bool
) -> Motion:
    """The arm's motion along a way, given relative to a place: offset (5,) of its poses.

    Raises UnreachableError where any of it is out of reach.
    """
    home, tool = np.array(robot.HOME), primitive.tool
    # A gripper is symmetric: of its two equal yaws, take the one that turns the wrist less.
    turns = (0.0, math.pi) if tool == "gripper" else (0.0,)
    options = [[_in_table_frame(s, offset, turn) for s in way] for turn in turns]
    up = max(HOVER_HEIGHT_M + TIP_HEIGHT_M - way[0].poses[0, 2], 0.0) * _UP
    stretch_W, over_start = min(
        ((option, robot.joint_path(option[0][:1] + up, home, tool)[0]) for option in options),
        key=lambda option: abs(option[1][5] - home[5]),
    )
    gaps = [primitive.opening_m * s.poses[:, 4] for s in way]
    paths, near = [], over_start
    for one in stretch_W:
        paths.append(robot.joint_path(one, near, tool))
        near = paths[-1][-1]
    retreat, lift = _way_out(primitive, way, stretch_W, paths, tool, approach)
    down = over_start[None]
    if approach:
        down = line(stretch_W[0][0] + up, stretch_W[0][0], over_start, 1.0, tool)
    return Motion(over_start, down, stretch_W, paths, gaps, retreat, lift)


def place_offset(world: Tabletop, xy_m: tuple[float, float]) -> np.ndarray:
    """What is added to the poses (5,) of an action that is placed at (x, y) [m]."""
    return np.array([*xy_m, world.config.tip_offset_m, 0.0, 0.0])


def resist_rolling(world: Tabletop, resists: bool) -> None:
    """Let the table brake an object that can roll as it lies, or no longer.

    Bullet's cylinders gain speed as they roll on a level table, from 0.1 to some 0.3 m/s in 2.5 s:
    one that is let go at a thousandth of that runs away while the arm comes back for it. While an
    action is recorded nothing brakes, as nothing did when the models' data were collected.
    """
    resists = resists and world.object_rolls()
    pybullet.changeDynamics(
        world.body,
        -1,
        rollingFriction=RESTING_M if resists else ROLLING_M,
        physicsClientId=world.client,
    )


def execute(
    world: Tabletop,
    primitive: Primitive,
    way: list[Stretch],
    phase: np.ndarray,
    action: np.ndarray,
    seen: Observation,
    approach: bool,
) -> Interaction:
    """Follow a way of stretches; phase (n,) and action (n, 5) are what shall be recorded."""
    start = poses(np.array([world.object_state()]))[0]
    offset = place_offset(world, seen.xy_m)
    home, tool = np.array(robot.HOME), primitive.tool
    motion = plan_motion(primitive, way, offset, approach)
    gaps = motion.gaps

    closes = any(np.ptp(gap) > 0 for gap in gaps)
    drive = Drive(world, primitive.force_N, closes)
    if closes:
        tie_fingers(world)
    if approach:
        resist_rolling(world, True)
        over = joint_move(world.arm, motion.over_start, 1.0)
        drive.along(over, np.linspace(world.gap_m, gaps[0][0], 2))
        drive.along(motion.down, gaps[0][[0, 0]])
    else:
        put_arm(world, motion.paths[0][0], gaps[0][0])
    resist_rolling(world, False)

    floor = -math.inf
    for stretch, one, path, gap in zip(way, motion.poses_W, motion.paths, gaps, strict=True):
        if one[:, 2].min() < floor:
            one = one.copy()
            one[:, 2] = np.maximum(one[:, 2], floor)
            try:
                path = robot.joint_path(one, world.arm, tool)
            except UnreachableError:  # it stays where it felt the object, and is seen off its path
                path = np.repeat(world.arm[None], len(one), axis=0)
        gone = drive.along(path, gap, one, stretch.guarded, stretch.n_steps)
        if stretch.guarded and gone < 1.0:
            floor = float(np.interp(gone, np.linspace(0, 1, len(one)), one[:, 2]))
    drive.finish()
    resist_rolling(world, approach)

    if not primitive.holds:
        release = (
            np.array([world.gap_m, primitive.opening_m]) if closes else world.gap_m * np.ones(2)
        )
        if release[1] > release[0]:
            drive.along(np.repeat(world.arm[None], 13, axis=0), np.linspace(*release, 13))
        drive.along(np.concatenate([motion.retreat, motion.lift[1:]]), release[[1, 1]])
        if approach:
            drive.along(joint_move(world.arm, home, 1.0), release[[1, 1]])
    drive.wait(SETTLE_STEPS)
    if not primitive.holds:
        untie_fingers(world)
    interaction = _record(world, primitive, way, phase, action, seen, start, drive, offset)
    if not (approach or primitive.holds):
        put_arm(world, home, world.gap_m)
    return interaction


def put_down(world: Tabletop) -> None:
    """Lower what the hand holds to the table, open the fingers, rise and go home."""
    below_m = 0.0
    if world.obj is not None:
        below_m = pybullet.getAABB(world.body, physicsClientId=world.client)[0][2]
    here = np.append(tool_pose(world)[:4], 0.0)
    way = np.repeat(world.arm[None], 2, axis=0)
    if below_m > PUT_DOWN_M:
        way = line(here, here - (below_m - PUT_DOWN_M) * _UP, world.arm, 1.0, world.tool)
    wide = np.linspace(world.gap_m, max(world.gap_m, Grasp.opening_m), 13)
    drive = Drive(world, Grasp.force_N, closes=True)
    drive.along(way, wide[[0, 0]])
    drive.along(np.repeat(world.arm[None], 13, axis=0), wide)
    untie_fingers(world)
    drive.along(way[::-1], wide[[-1, -1]])
    drive.along(joint_move(world.arm, np.array(robot.HOME), 1.0), wide[[-1, -1]])


def refused(
    world: Tabletop, primitive: Primitive, phase: np.ndarray, seen: Observation
) -> Interaction:
    """The interaction that was out of the arm's reach: commanded, but nothing moved."""
    x, y, yaw = world.object_pose()
    return Interaction(
        primitive=primitive,
        stop_phase=float(phase[-1]),
        phase=phase,
        action=primitive.path(phase),
        effect=np.zeros((len(phase), 5)),
        rest_effect=np.zeros(5),
        image=seen.image,
        start_pose=(x, y, yaw),
        estimated_xy_m=seen.xy_m,
        tool=np.zeros((RECORDED_SAMPLES, 5)),
        tracking_error_m=0.0,
        penetration_m=0.0,
        left_table=False,
        fell=False,
        rolls=world.object_rolls(),
        reached=False,
    )


def _in_table_frame(stretch: Stretch, offset: np.ndarray, turn: float) -> np.ndarray:
    """Poses (n, 5), x, y, z, yaw and pitch, of a stretch given relative to the object."""
    return stretch.poses[:, [0, 1, 2, 3, 5]] + offset + np.array([0, 0, 0, turn, 0])


def _way_out(
    primitive: Primitive,
    way: list[Stretch],
    stretch_W: list[np.ndarray],
    paths: list[np.ndarray],
    tool: str,
    approach: bool,
) -> tuple[np.ndarray, np.ndarray]:
    """Joint waypoints that free the object: back along the way, then up (up only if it cages)."""
    stop = (len(paths[-1]) - 1) if way[-1].n_steps is None else way[-1].n_steps / STEPS_PER_WAYPOINT
    at = np.arange(len(paths[-1]))
    end = np.array([np.interp(stop, at, column) for column in stretch_W[-1].T])
    near = np.array([np.interp(stop, at, column) for column in paths[-1].T])
    back = np.zeros(5)
    caged = primitive.path(0.0)[0, 2] > TIP_HEIGHT_M or primitive.holds
    if not caged:
        back[:3] = stretch_W[0][0, :3] - end[:3]
        back *= RETREAT_M / max(np.linalg.norm(back), RETREAT_M)
    retreat = near[None]
    if not caged:
        retreat = line(end, end + back, retreat[-1], 0.25, tool)
    if primitive.holds or not (caged or approach):
        return retreat, retreat[-1:]
    rise = HOVER_HEIGHT_M if not caged else max(HOVER_HEIGHT_M - end[2], 0.0)
    return retreat, line(end + back, end + back + rise * _UP, retreat[-1], 0.5, tool)


def _record(
    world: Tabletop,
    primitive: Primitive,
    way: list[Stretch],
    phase: np.ndarray,
    action: np.ndarray,
    seen: Observation,
    start: np.ndarray,
    drive: Drive,
    offset: np.ndarray,
) -> Interaction:
    """What was seen on the way, brought to the phases (n,) that are recorded."""
    recorded = poses(world.centred(np.array([(*p, *q) for p, q in drive.states])))
    rest = poses(np.array([world.object_state()]))[0]
    rest[3] = recorded[-1, 3] + (rest[3] - recorded[-1, 3] + math.pi) % (2 * math.pi) - math.pi
    origin = np.array([*start[:3], recorded[0, 3], 0.0])
    at_sample, at_waypoint = _phases_of_records(way)
    effect = recorded - origin
    tool = np.array(drive.tool) - np.array([*offset[:3], 0.0, 0.0])
    tool[:, 3] = np.unwrap(tool[:, 3])
    seldom = np.linspace(0, phase[-1], RECORDED_SAMPLES)
    x, y, z = world.object_state()[:3]
    return Interaction(
        primitive=primitive,
        stop_phase=float(phase[-1]),
        phase=phase,
        action=action,
        effect=np.column_stack([np.interp(phase, at_sample, effect[:, c]) for c in range(5)]),
        rest_effect=rest - origin,
        image=seen.image,
        start_pose=(float(start[0]), float(start[1]), float(recorded[0, 3])),
        tracking_error_m=drive.off_path_m,
        estimated_xy_m=seen.xy_m,
        tool=np.column_stack([np.interp(seldom, at_waypoint, tool[:, c]) for c in range(5)]),
        penetration_m=drive.penetration_m,
        left_table=not world.on_table((x, y, z)),
        fell=world.object_fell(),
        rolls=world.object_rolls(),
    )


def _phases_of_records(way: list[Stretch]) -> tuple[np.ndarray, np.ndarray]:
    """Phases of the states and of the tool poses that a drive has written down, in order."""
    per = STEPS_PER_WAYPOINT // RECORD_EVERY
    at_sample, at_waypoint = [], []
    for stretch in way:
        n_waypoints = len(stretch.phase) - 1
        records = n_waypoints * per if stretch.n_steps is None else stretch.n_steps // RECORD_EVERY
        samples = np.interp(np.arange(records) / per, np.arange(n_waypoints + 1), stretch.phase)
        at_sample.append(samples)
        at_waypoint.append(samples[::per])
        end = np.interp(records / per, np.arange(n_waypoints + 1), stretch.phase)
    return np.concatenate([*at_sample, [end]]), np.concatenate([*at_waypoint, [end]])
