"""How the arm follows a commanded path, fast: joints planned ahead, motors set once a step.

Inverse kinematics runs at 20 Hz with a spline in between (the error is a few µm), so that
an interaction costs little more than the physics itself.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import pybullet
from scipy.interpolate import CubicSpline

from affordlib.primitives import Primitive, min_jerk
from affordlib.world import robot

if TYPE_CHECKING:
    from affordlib.world.scene import Tabletop

StepCallback = Callable[["Tabletop"], None]
"""Called with the world after every step of the simulation."""

STEPS_PER_WAYPOINT = 12
RECORD_EVERY = 3
HOVER_HEIGHT_M = 0.16
GUARD_FORCE_N = 30.0
ARM_FORCES_N_M = (330.0, 330.0, 150.0, 54.0, 54.0, 54.0)
ROLLING_M, RESTING_M = 1e-4, 1e-3
"""Rolling friction [m] of all bodies, and of a round object that is left alone.

Bullet multiplies each by the lateral friction of the other body: 0.1 and 0.55 mm in all.
"""
STEP_S = 1 / 240
_WAYPOINT_S = STEPS_PER_WAYPOINT * STEP_S
_ARM_GAINS = [0.3] * 6
_STILL_FINGERS, _MOVING_FINGERS = [0.3] * 2, [0.02] * 2
"""Light fingers pulled hard to a far target would leap where a contact is lost for a step."""


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
    angles = [*joints, gap_m / 2, gap_m / 2]
    for joint, angle in zip(world.joints, angles, strict=True):
        pybullet.resetJointState(world.robot, joint, angle, 0.0, physicsClientId=world.client)
    pybullet.setJointMotorControlArray(
        world.robot,
        world.joints,
        pybullet.POSITION_CONTROL,
        targetPositions=angles,
        physicsClientId=world.client,
    )
    world.arm, world.gap_m = np.array(joints, dtype=float), gap_m


@dataclass(frozen=True)
class Stretch:
    """Waypoints 50 ms apart: poses (n, 6) as in `Leg`, phases (n,) at which they are passed.

    n_steps: how many simulation steps of it are taken before the arm is stopped dead (default:
    all). A guarded stretch freezes when the robot presses on the object.
    """

    poses: np.ndarray
    phase: np.ndarray
    guarded: bool = False
    n_steps: int | None = None


def stretches(primitive: Primitive, stop_phase: float, smooth: bool = True) -> list[Stretch]:
    """The way of a primitive up to a phase, leg by leg.

    smooth: the leg that is broken off keeps its path and gets a minimum-jerk stop of its own;
    otherwise it is followed at full speed and cut off.
    """
    way = []
    for segment, begin, end in zip(
        primitive.segments, primitive.segment_phases[:-1], primitive.segment_phases[1:], strict=True
    ):
        if way and begin >= stop_phase - 1e-9:
            break
        local = min(1.0, (stop_phase - begin) / (end - begin))
        covered = float(min_jerk(local)) if smooth else 1.0
        n = max(2, math.ceil(segment.seconds * covered / _WAYPOINT_S - 1e-9))
        share = covered * min_jerk(np.linspace(0, 1, n + 1))
        at_phase = np.linspace(0, 1, n + 1)
        if covered < 1.0:
            fine = np.linspace(0, local, 301)
            at_phase = np.interp(share, min_jerk(fine), fine)
        steps = None
        if not smooth and local < 1.0:
            steps = RECORD_EVERY * round(local * segment.seconds / STEP_S / RECORD_EVERY)
        phase = begin + at_phase * (end - begin)
        way.append(Stretch(segment.at(share), phase, segment.guarded, steps))
    return way


def along_path(
    path_xy_m: np.ndarray, primitive: Primitive, stop_phase: float
) -> tuple[np.ndarray, np.ndarray]:
    """Phases (n,) and action (n, 5) along points (n, 2), the fingers facing where they lead."""
    path = np.asarray(path_xy_m, dtype=float)
    if path.ndim != 2 or path.shape[1] != 2 or len(path) < 2 or not np.isfinite(path).all():
        raise ValueError(f"path_xy_m must be finite points (n, 2), n ≥ 2, got {path.shape}")
    phase = np.linspace(0.0, 1.0, len(path)) * stop_phase
    action = primitive.path(phase)
    action[:, :2] = path
    heading = path[-1] - path[0]
    if np.hypot(*heading) > 1e-6:
        action[:, 3] = math.atan2(heading[1], heading[0])
    return phase, action


def stretch_along(action: np.ndarray, phase: np.ndarray, seconds: float) -> Stretch:
    """A given path, action (n, 5) at phases (n,), followed along its length with a smooth stop."""
    n = max(2, math.ceil(seconds / _WAYPOINT_S - 1e-9))
    # Along its length, a minimum-jerk path is the same path whatever its speed.
    length = np.concatenate([[0], np.cumsum(np.hypot(*np.diff(action[:, :2], axis=0).T))])
    if length[-1] < 1e-9:
        return Stretch(np.repeat([[*action[0], 0.0]], n + 1, axis=0), np.zeros(n + 1))
    wanted = min_jerk(np.linspace(0, 1, n + 1)) * length[-1]
    columns = [np.interp(wanted, length, action[:, c]) for c in range(5)]
    return Stretch(np.column_stack([*columns, np.zeros(n + 1)]), np.interp(wanted, length, phase))


def tie_fingers(world: Tabletop) -> None:
    """Tie the two fingers by a gear, so that a held object stays in the middle.

    Driven by two motors alone, a held object is in neutral balance and wanders.
    """
    untie_fingers(world)
    left, right = world.joints[-2:]
    gear = pybullet.createConstraint(
        world.robot,
        left,
        world.robot,
        right,
        jointType=pybullet.JOINT_GEAR,
        jointAxis=(0, 1, 0),
        parentFramePosition=(0, 0, 0),
        childFramePosition=(0, 0, 0),
        physicsClientId=world.client,
    )
    pybullet.changeConstraint(
        gear, gearRatio=-1, maxForce=300, erp=0.5, physicsClientId=world.client
    )


def untie_fingers(world: Tabletop) -> None:
    """Let go: take away the gear between the fingers, and what ties an object to them."""
    client = world.client
    for k in reversed(range(pybullet.getNumConstraints(physicsClientId=client))):
        gear = pybullet.getConstraintUniqueId(k, physicsClientId=client)
        pybullet.removeConstraint(gear, physicsClientId=client)


def tie_held(world: Tabletop) -> None:
    """Fix what both tied fingers hold to the hand, until `untie_fingers`.

    Friction in Bullet creeps: what is held slips by some 0.3 mm a second.
    """
    client, palm = world.client, world.joints[5] + 1
    contacts = pybullet.getContactPoints(world.robot, world.body, physicsClientId=client)
    touching = {contact[3] for contact in contacts}
    gears = pybullet.getNumConstraints(physicsClientId=client)
    if gears != 1 or not touching.issuperset(world.joints[-2:]):
        return
    hand = pybullet.getLinkState(world.robot, palm, physicsClientId=client)[:2]
    held = pybullet.getBasePositionAndOrientation(world.body, client)
    at, turned = pybullet.multiplyTransforms(*pybullet.invertTransform(*hand), *held)
    joint = pybullet.createConstraint(
        world.robot,
        palm,
        world.body,
        -1,
        jointType=pybullet.JOINT_FIXED,
        jointAxis=(0, 0, 0),
        parentFramePosition=at,
        childFramePosition=(0, 0, 0),
        parentFrameOrientation=turned,
        physicsClientId=client,
    )
    pybullet.changeConstraint(joint, maxForce=20, physicsClientId=client)


class Drive:
    """Moves the arm along waypoints and writes down what it sees on the way.

    states: (n, 7) of the object every `RECORD_EVERY` steps; tool: (m, 5) measured x, y, z, yaw
    and finger gap every waypoint; how far the tool was off its path, and how deep bodies sank
    into each other, at most [m].
    """

    def __init__(self, world: Tabletop, finger_force_N: float, closes: bool) -> None:
        self.world = world
        self.gains = _ARM_GAINS + (_MOVING_FINGERS if closes else _STILL_FINGERS)
        self.forces = [*ARM_FORCES_N_M, finger_force_N, finger_force_N]
        self.states: list[tuple] = []
        self.tool: list[np.ndarray] = []
        self.off_path_m = 0.0
        self.penetration_m = 0.0

    def _sense(self, pose_W: np.ndarray | None) -> None:
        """Measure the tool against where it should be, and the contacts of the object."""
        world = self.world
        measured = tool_pose(world)
        self.tool.append(measured)
        if pose_W is not None:
            self.off_path_m = max(self.off_path_m, math.dist(measured[:3], pose_W[:3]))
        for contact in pybullet.getContactPoints(world.body, physicsClientId=world.client):
            self.penetration_m = max(self.penetration_m, -contact[8])

    def _pressed(self) -> bool:
        contacts = pybullet.getContactPoints(
            self.world.robot, self.world.body, physicsClientId=self.world.client
        )
        return sum(contact[9] for contact in contacts) > GUARD_FORCE_N

    def along(
        self,
        joints: np.ndarray,
        gaps_m: np.ndarray,
        poses_W: np.ndarray | None = None,
        guarded: bool = False,
        n_steps: int | None = None,
    ) -> float:
        """Move through joint waypoints (n, 6) with finger gaps (n,); returns the share gone.

        poses_W: (n, 3+) where the tool should be at the waypoints, if that is to be recorded.
        """
        world = self.world
        client, body, arm, indices = world.client, world.body, world.robot, world.joints
        whole = (len(joints) - 1) * STEPS_PER_WAYPOINT
        grid = np.arange(whole + 1) / STEPS_PER_WAYPOINT
        targets = np.empty((whole + 1, 8))
        targets[:, :6] = joints[0]
        if np.ptp(joints, axis=0).any():
            targets[:, :6] = CubicSpline(np.arange(len(joints)), joints, bc_type="clamped")(grid)
        targets[:, 6:] = (np.interp(grid, np.arange(len(gaps_m)), gaps_m) / 2)[:, None]
        velocities = (np.diff(targets, axis=0) / STEP_S).tolist()
        # With the velocity fed forward, the target of the next step would put the arm ahead.
        commands = targets[:-1].tolist()
        n_steps = whole if n_steps is None else n_steps
        record, on_step = poses_W is not None, world.on_step
        now, frozen_at = (targets[0].tolist(), [0.0] * 8), None
        for step in range(n_steps):
            if record and step % RECORD_EVERY == 0:
                self.states.append(pybullet.getBasePositionAndOrientation(body, client))
                if step % STEPS_PER_WAYPOINT == 0:
                    here = None if frozen_at else poses_W[step // STEPS_PER_WAYPOINT]
                    self._sense(here)
            if frozen_at is None:
                now = commands[step], velocities[step]
                if guarded and self._pressed():
                    frozen_at, now = step, (commands[step], [0.0] * 8)
            pybullet.setJointMotorControlArray(
                arm,
                indices,
                pybullet.POSITION_CONTROL,
                targetPositions=now[0],
                targetVelocities=now[1],
                forces=self.forces,
                positionGains=self.gains,
                physicsClientId=client,
            )
            pybullet.stepSimulation(client)
            if on_step is not None:
                on_step(world)
        world.arm, world.gap_m = np.array(now[0][:6]), 2 * now[0][6]
        if n_steps < whole:
            self.hold()
        return 1.0 if frozen_at is None else frozen_at / whole

    def hold(self) -> None:
        """Command the arm to stand still where it was last sent."""
        world = self.world
        pybullet.setJointMotorControlArray(
            world.robot,
            world.joints,
            pybullet.POSITION_CONTROL,
            targetPositions=[*world.arm, world.gap_m / 2, world.gap_m / 2],
            forces=self.forces,
            positionGains=self.gains,
            physicsClientId=world.client,
        )

    def wait(self, n_steps: int) -> None:
        """Let the simulation run with the arm held where it is."""
        for _ in range(n_steps):
            pybullet.stepSimulation(self.world.client)
            if self.world.on_step is not None:
                self.world.on_step(self.world)

    def finish(self) -> None:
        """Write down the last state."""
        self.states.append(
            pybullet.getBasePositionAndOrientation(self.world.body, self.world.client)
        )
        self._sense(None)


def tool_pose(world: Tabletop) -> np.ndarray:
    """Measured x, y, z [m] of the tool's point, its yaw [rad] and the gap of the fingers [m]."""
    palm = world.joints[5] + 1
    state = pybullet.getLinkState(
        world.robot, palm, computeForwardKinematics=1, physicsClientId=world.client
    )
    axes = np.array(pybullet.getMatrixFromQuaternion(state[5])).reshape(3, 3)
    along, below = robot.TOOL_OFFSETS_M[world.tool]
    tip = np.array(state[4]) + along * axes[:, 0] + below * axes[:, 2]
    fingers = pybullet.getJointStates(world.robot, world.joints[-2:], physicsClientId=world.client)
    return np.array([*tip, math.atan2(axes[1, 0], axes[0, 0]), fingers[0][0] + fingers[1][0]])


def joint_move(start: np.ndarray, end: np.ndarray, seconds: float) -> np.ndarray:
    """Joint waypoints (n, 6) of a smooth move between two postures."""
    n = max(2, math.ceil(seconds / _WAYPOINT_S))
    return start + min_jerk(np.linspace(0, 1, n + 1))[:, None] * (end - start)


def line(start_W: np.ndarray, end_W: np.ndarray, near: np.ndarray, seconds: float, tool: str):
    """Joint waypoints (n, 6) of a smooth straight line between two poses (x, y, z, yaw, pitch)."""
    n = max(2, math.ceil(seconds / _WAYPOINT_S))
    share = min_jerk(np.linspace(0, 1, n + 1))[:, None]
    return robot.joint_path(start_W + share * (end_W - start_W), near, tool)
