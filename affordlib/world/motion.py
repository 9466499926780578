"""How the arm follows a commanded path, fast: joints planned ahead, motors set once a step.

Inverse kinematics runs at 20 Hz with a spline in between (the error is a few µm), so that
a push costs little more than the physics itself.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
import pybullet
from scipy.interpolate import CubicSpline

from affordlib.primitives import PUSH_GAP_M, Push, min_jerk
from affordlib.types import Interaction
from affordlib.world import robot

if TYPE_CHECKING:
    from collections.abc import Callable

    from affordlib.world.scene import Tabletop

    Film = Callable[["Tabletop"], None]

STEPS_PER_WAYPOINT = 12
RECORD_EVERY = 3
SETTLE_STEPS = 120
HOVER_HEIGHT_M = 0.16
RETREAT_M = 0.02
FINGER_FORCE_N = 200.0
ARM_FORCES_N_M = (330.0, 330.0, 150.0, 54.0, 54.0, 54.0)
_STEP_S = 1 / 240
_GAINS = [0.3] * 8
_FORCES = [*ARM_FORCES_N_M, FINGER_FORCE_N, FINGER_FORCE_N]


def poses(states: np.ndarray) -> np.ndarray:
    """(n, 5) channels `EFFECT_CHANNELS` (absolute) of states (n, 7), position and quaternion.

    Yaw is the heading of the body's x axis (of its y axis where x points up), unwrapped.
    """
    x, y, z, w = states[:, 3:].T
    ax = np.stack([1 - 2 * (y * y + z * z), 2 * (x * y + z * w)], axis=1)
    ay = np.stack([2 * (x * y - z * w), 1 - 2 * (x * x + z * z)], axis=1)
    yaw = np.arctan2(ax[:, 1], ax[:, 0])
    lying = np.hypot(*ax.T) < 0.5
    yaw = np.where(lying, np.arctan2(-ay[:, 0], ay[:, 1]), yaw)
    tilt = np.arccos(np.clip(1 - 2 * (x * x + y * y), -1.0, 1.0))
    return np.column_stack([states[:, :3], np.unwrap(yaw), tilt])


def put_arm(world: Tabletop, joints: np.ndarray, gap_m: float) -> None:
    """Place the arm (without motion) at joint angles (6,) with the fingers a gap [m] apart."""
    for joint, angle in zip(world.joints, (*joints, gap_m / 2, gap_m / 2), strict=True):
        pybullet.resetJointState(world.robot, joint, angle, 0.0, physicsClientId=world.client)
    world.arm = np.array(joints, dtype=float)


def _drive(world: Tabletop, waypoints: np.ndarray) -> np.ndarray:
    """Move through joint waypoints (n, 6), 50 ms apart; states (m, 7) of the object on the way.

    The states are recorded before the first step and after every `RECORD_EVERY` steps.
    """
    n_steps = (len(waypoints) - 1) * STEPS_PER_WAYPOINT
    grid = np.arange(n_steps + 1) / STEPS_PER_WAYPOINT
    targets = np.empty((n_steps + 1, 8))
    spline = CubicSpline(np.arange(len(waypoints)), waypoints, bc_type="clamped")
    targets[:, :6] = spline(grid)
    targets[:, 6:] = PUSH_GAP_M / 2
    velocities = (np.diff(targets, axis=0) / _STEP_S).tolist()
    targets = targets[1:].tolist()

    client, body, arm, joints = world.client, world.body, world.robot, world.joints
    film = world.film
    states = []
    for step in range(n_steps):
        if step % RECORD_EVERY == 0:
            states.append(pybullet.getBasePositionAndOrientation(body, client))
        pybullet.setJointMotorControlArray(
            arm,
            joints,
            pybullet.POSITION_CONTROL,
            targetPositions=targets[step],
            targetVelocities=velocities[step],
            forces=_FORCES,
            positionGains=_GAINS,
            physicsClientId=client,
        )
        pybullet.stepSimulation(client)
        if film is not None:
            film(world)
    states.append(pybullet.getBasePositionAndOrientation(body, client))
    world.arm = waypoints[-1]
    return np.array([(*position, *quaternion) for position, quaternion in states])


def _wait(world: Tabletop, n_steps: int) -> None:
    """Let the simulation run with the arm held where it is."""
    for _ in range(n_steps):
        pybullet.stepSimulation(world.client)
        if world.film is not None:
            world.film(world)


def _tool_W(world: Tabletop) -> np.ndarray:
    """Measured position (3,) of the point between the finger tips [m]."""
    palm = world.joints[5] + 1
    state = pybullet.getLinkState(
        world.robot, palm, computeForwardKinematics=1, physicsClientId=world.client
    )
    z_axis = np.array(pybullet.getMatrixFromQuaternion(state[5])).reshape(3, 3)[:, 2]
    return np.array(state[4]) + robot.TOOL_LENGTH_M * z_axis


def _joint_move(start: np.ndarray, end: np.ndarray, seconds: float) -> np.ndarray:
    """Joint waypoints (n, 6) of a smooth move between two postures."""
    n = max(2, math.ceil(seconds / (STEPS_PER_WAYPOINT * _STEP_S)))
    return start + min_jerk(np.linspace(0, 1, n + 1))[:, None] * (end - start)


def _line(start_W: np.ndarray, end_W: np.ndarray, yaw: float, near: np.ndarray, seconds: float):
    """Joint waypoints (n, 6) of a smooth straight line of the tool."""
    n = max(2, math.ceil(seconds / (STEPS_PER_WAYPOINT * _STEP_S)))
    share = min_jerk(np.linspace(0, 1, n + 1))[:, None]
    return robot.joint_path(start_W + share * (end_W - start_W), np.full(n + 1, yaw), near)


def _retime(action: np.ndarray, phase: np.ndarray, duration_s: float) -> tuple[np.ndarray, ...]:
    """Waypoint phases and tool positions of a path with a smooth start and stop of its own.

    action: (n, 5) at phases (n,); a full path already is minimum-jerk in phase and is kept.
    A prefix is followed along its own length, at the peak speed of the full primitive.
    """
    seconds = duration_s * float(min_jerk(phase[-1]))
    n = max(2, math.ceil(seconds / (STEPS_PER_WAYPOINT * _STEP_S) - 1e-9))
    share = min_jerk(np.linspace(0, 1, n + 1))
    # Along its length, a minimum-jerk path is the same path whatever its speed.
    length = np.concatenate([[0], np.cumsum(np.hypot(*np.diff(action[:, :2], axis=0).T))])
    if length[-1] < 1e-9:
        return np.zeros(n + 1), np.repeat(action[:1, :3], n + 1, axis=0)
    wanted = share * length[-1]
    at_phase = np.interp(wanted, length, phase)
    xyz = np.column_stack([np.interp(wanted, length, action[:, c]) for c in range(3)])
    return at_phase, xyz


def execute(
    world: Tabletop, primitive: Push, action: np.ndarray, phase: np.ndarray, approach: bool
) -> Interaction:
    """Follow a commanded path (n, 5) over the object with the fingers `PUSH_GAP_M` apart.

    All joints are planned before anything moves, so an unreachable path raises and moves nothing.
    """
    start_state = np.array(world.object_state())
    start_pose = (*start_state[:2], 0.0)
    image = world.look()
    at_phase, xyz = _retime(action, phase, primitive.duration_s)
    xyz_W = xyz + np.array(start_pose)
    home, up = np.array(robot.HOME), np.array([0, 0, HOVER_HEIGHT_M])
    # The gripper is symmetric: of its two equal yaws, take the one with less turning of the wrist.
    yaws = (float(action[0, 3]), float(action[0, 3]) + math.pi)
    yaw, over_start = min(
        ((yaw, robot.inverse_kinematics(xyz_W[0] + up, yaw, home)) for yaw in yaws),
        key=lambda option: abs(option[1][5] - home[5]),
    )
    path = robot.joint_path(xyz_W, np.full(len(xyz_W), yaw), over_start)
    back = xyz_W[0] - xyz_W[-1]
    distance = np.linalg.norm(back)
    clear = xyz_W[-1] + back * (RETREAT_M / max(distance, RETREAT_M))
    retreat = _line(xyz_W[-1], clear, yaw, path[-1], 0.25)
    lift = _line(clear, clear + up, yaw, retreat[-1], 0.5) if approach else retreat[-1:]
    descent = _line(xyz_W[0] + up, xyz_W[0], yaw, over_start, 1.0) if approach else path[:1]

    if approach:
        _drive(world, _joint_move(world.arm, over_start, 1.0))
        _drive(world, descent)
    else:
        put_arm(world, path[0], PUSH_GAP_M)
    states = _drive(world, path)
    tracking_error = float(np.linalg.norm(_tool_W(world) - xyz_W[-1]))
    _drive(world, np.concatenate([retreat, lift[1:]]))
    if approach:
        _drive(world, _joint_move(world.arm, home, 1.0))
    _wait(world, SETTLE_STEPS)

    recorded = poses(np.vstack([states, [world.object_state()]]))
    relative = recorded - np.array([*recorded[0, :4], 0.0])
    waypoint = np.arange(len(states)) * RECORD_EVERY / STEPS_PER_WAYPOINT
    at_sample = np.interp(waypoint, np.arange(len(at_phase)), at_phase)
    effect = np.column_stack([np.interp(phase, at_sample, relative[:-1, c]) for c in range(5)])
    return Interaction(
        primitive=primitive,
        stop_phase=float(phase[-1]),
        phase=phase,
        action=action,
        effect=effect,
        rest_effect=relative[-1],
        image=image,
        start_pose=(float(start_state[0]), float(start_state[1]), float(recorded[0, 3])),
        tracking_error_m=tracking_error,
    )
