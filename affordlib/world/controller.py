"""The arm in a PyBullet client: follows waypoints of its joints, and measures what it can feel."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import pybullet
from pybullet_utils.bullet_client import BulletClient
from scipy.interpolate import CubicSpline

from affordlib.world import robot
from affordlib.world.trajectory import RECORD_EVERY, STEP_S, STEPS_PER_WAYPOINT, TrajectorySegment

GUARD_FORCE_N = 30.0
"""A guarded segment freezes when the object presses on the robot with more than this."""

ARM_FORCES_N_M = (330.0, 330.0, 150.0, 54.0, 54.0, 54.0)
_ARM_GAINS = [0.3] * 6
_STILL_FINGERS, _MOVING_FINGERS = [0.3] * 2, [0.02] * 2
"""Light fingers pulled hard to a far target would leap where a contact is lost for a step."""


@dataclass
class Recording:
    """What is measured while the arm acts on a body of the client.

    states: (n, 7) of the body every `RECORD_EVERY` steps; tool: (m, 5) measured x, y, z, yaw and
    finger gap every waypoint; how far the tool was off its path, and how deep bodies sank into
    each other, at most [m].
    """

    body: int
    states: list[tuple] = field(default_factory=list)
    tool: list[np.ndarray] = field(default_factory=list)
    off_path_m: float = 0.0
    penetration_m: float = 0.0


class JointController:
    """Drives the joints of an arm that it loads, holding a tool, into a client.

    after_step: called after every step of the simulation; angles_rad: (6,) joint angles and gap_m:
    distance of the fingers [m] where they were last sent.
    """

    def __init__(self, client: BulletClient, tool: str, after_step: Callable[[], None]) -> None:
        self.client, self.tool, self.after_step = client, tool, after_step
        self.robot = robot.load_robot(client, tool)
        self.links = robot.links(client, self.robot)
        self.fingers = self.links["left_finger"], self.links["right_finger"]
        self.joints = (*robot.ARM_JOINTS, *self.fingers)
        self.palm = self.links["palm"]

    def put(self, angles_rad: np.ndarray, gap_m: float) -> None:
        """Place the arm (without motion) at joint angles (6,) with the fingers a gap [m] apart."""
        targets = [*angles_rad, gap_m / 2, gap_m / 2]
        for joint, angle in zip(self.joints, targets, strict=True):
            self.client.resetJointState(self.robot, joint, angle, 0.0)
        self._set_motors(targetPositions=targets)
        self.angles_rad, self.gap_m = np.array(angles_rad, dtype=float), gap_m

    def set_fingers(self, force_N: float, closing: bool) -> None:
        """How hard each finger can press from now on, and whether it moves lightly, to close."""
        self.gains = _ARM_GAINS + (_MOVING_FINGERS if closing else _STILL_FINGERS)
        self.forces = [*ARM_FORCES_N_M, force_N, force_N]

    def follow(
        self,
        joints: np.ndarray,
        gaps_m: np.ndarray,
        recording: Recording | None = None,
        segment: TrajectorySegment | None = None,
        poses_W: np.ndarray | None = None,
    ) -> float:
        """Move through joint waypoints (n, 6) with finger gaps (n,); returns the share covered.

        recording: where to write, if this is recorded, what happens on this segment, whose poses
        (n, 3+) the tool should pass.
        """
        client = self.client
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
        n_steps = whole if segment is None or segment.n_steps is None else segment.n_steps
        guarded = segment is not None and segment.guarded
        drive = {"forces": self.forces, "positionGains": self.gains}
        now, frozen_at = (targets[0].tolist(), [0.0] * 8), None
        for step in range(n_steps):
            if recording is not None and step % RECORD_EVERY == 0:
                at_waypoint = step % STEPS_PER_WAYPOINT == 0
                wanted = None if frozen_at else poses_W[step // STEPS_PER_WAYPOINT]
                self.record(recording, at_waypoint, wanted)
            if frozen_at is None:
                now = commands[step], velocities[step]
                if guarded and self._pressed(recording.body):
                    frozen_at, now = step, (commands[step], [0.0] * 8)
            self._set_motors(targetPositions=now[0], targetVelocities=now[1], **drive)
            client.stepSimulation()
            self.after_step()
        self.angles_rad, self.gap_m = np.array(now[0][:6]), 2 * now[0][6]
        if n_steps < whole:  # stand still where it was last sent
            still = [*self.angles_rad, self.gap_m / 2, self.gap_m / 2]
            self._set_motors(targetPositions=still, **drive)
        return 1.0 if frozen_at is None else frozen_at / whole

    def _set_motors(self, **targets: list[float]) -> None:
        self.client.setJointMotorControlArray(
            self.robot, self.joints, pybullet.POSITION_CONTROL, **targets
        )

    def wait(self, n_steps: int) -> None:
        """Let the simulation run with the arm held where it is."""
        for _ in range(n_steps):
            self.client.stepSimulation()
            self.after_step()

    def record(
        self, recording: Recording, with_tool: bool = True, wanted_W: np.ndarray | None = None
    ) -> None:
        """Write down the body's state, the tool's against where it is wanted, and the contacts."""
        state = self.client.getBasePositionAndOrientation(recording.body)
        recording.states.append((*state[0], *state[1]))
        if not with_tool:
            return
        recording.tool.append(self.tool_pose())
        if wanted_W is not None:
            off_m = math.dist(recording.tool[-1][:3], wanted_W[:3])
            recording.off_path_m = max(recording.off_path_m, off_m)
        for contact in self.client.getContactPoints(recording.body):
            recording.penetration_m = max(recording.penetration_m, -contact[8])

    def _pressed(self, body: int) -> bool:
        contacts = self.client.getContactPoints(self.robot, body)
        return sum(contact[9] for contact in contacts) > GUARD_FORCE_N

    def tool_pose(self) -> np.ndarray:
        """Measured x, y, z [m] of the tool's point, its yaw [rad], the gap of the fingers [m]."""
        state = self.client.getLinkState(self.robot, self.palm, computeForwardKinematics=1)
        axes = np.array(pybullet.getMatrixFromQuaternion(state[5])).reshape(3, 3)
        along, below = robot.TOOL_OFFSETS_M[self.tool]
        tip = np.array(state[4]) + along * axes[:, 0] + below * axes[:, 2]
        fingers = self.client.getJointStates(self.robot, self.fingers)
        yaw = math.atan2(axes[1, 0], axes[0, 0])
        return np.array([*tip, yaw, fingers[0][0] + fingers[1][0]])

    def tie_fingers(self) -> None:
        """Tie the two fingers by a gear: between two motors alone a held object wanders."""
        self.untie()
        gear = self.client.createConstraint(
            self.robot,
            self.fingers[0],
            self.robot,
            self.fingers[1],
            pybullet.JOINT_GEAR,
            (0, 1, 0),
            (0, 0, 0),
            (0, 0, 0),
        )
        self.client.changeConstraint(gear, gearRatio=-1, maxForce=300, erp=0.5)

    def untie(self) -> None:
        """Let go: take away the gear between the fingers, and what ties an object to them."""
        client = self.client
        for k in reversed(range(client.getNumConstraints())):
            client.removeConstraint(client.getConstraintUniqueId(k))

    def tie_held(self, body: int) -> None:
        """Fix what both tied fingers hold to the hand: friction creeps by 0.3 mm a second."""
        client = self.client
        contacts = client.getContactPoints(self.robot, body)
        touching = {contact[3] for contact in contacts}
        if client.getNumConstraints() != 1 or not touching.issuperset(self.fingers):
            return
        hand = client.getLinkState(self.robot, self.palm)[:2]
        held = client.getBasePositionAndOrientation(body)
        position, orientation = pybullet.multiplyTransforms(*pybullet.invertTransform(*hand), *held)
        bodies = self.robot, self.palm, body, -1
        joint = client.createConstraint(
            *bodies, pybullet.JOINT_FIXED, (0, 0, 0), position, (0, 0, 0), orientation
        )
        client.changeConstraint(joint, maxForce=20)
