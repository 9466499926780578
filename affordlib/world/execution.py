"""Execution of one command on the object, from the arm's approach to the object at rest.

The arm follows joint waypoints and measures its own pose and contact forces.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
import pybullet
from pybullet_utils.bullet_client import BulletClient
from scipy.interpolate import CubicSpline

from affordlib.primitives import EMPTY_M, GRIPPER, YAW, Grasp, Z
from affordlib.types import Interaction, Observation, UnreachableError
from affordlib.world import robot
from affordlib.world.objects import PlacedObject, poses
from affordlib.world.trajectory import (
    RECORD_EVERY,
    STEP_S,
    STEPS_PER_WAYPOINT,
    UP,
    Command,
    TrajectorySegment,
    interpolated,
    joint_move,
    line,
    plan_motion,
    recorded_phases,
)

SETTLE_STEPS = 120
PUT_DOWN_M = 0.002  # above its support, from where an object is released when it is put down
RECORDED_SAMPLES = 26  # of the tool: at t = 0 and every 3 steps of 50 ms (as in the paper)
GUARD_FORCE_N = 30.0  # between object and robot, above which a guarded segment stops
ARM_FORCES_N_M = (330.0, 330.0, 150.0, 54.0, 54.0, 54.0)
_STILL_FINGERS, _MOVING_FINGERS = [0.3] * 2, [0.02] * 2
"""Position gains of the fingers: with high ones, closing fingers jump when contact is lost."""


@dataclass
class Recording:
    """Measurements while the arm acts on a body of the client."""

    body: int
    segment: TrajectorySegment | None = None  # that is executed, in the table's frame
    states: list[tuple] = field(default_factory=list)  # (n, 7), every `RECORD_EVERY` steps
    tool: list[np.ndarray] = field(default_factory=list)  # (m, 5), see `tool_pose`
    off_path_m: float = 0.0  # largest tracking error of the tool
    penetration_m: float = 0.0  # largest one of two bodies


class JointController:
    """Loads an arm with a tool into a client and controls its joints.

    after_step: called after every step of the simulation; angles_rad: (6,) joint angles and gap_m:
    gap between the fingers [m], both as last commanded; raised_m: height [m] by which the hand
    has lifted the object that it closed on.
    """

    def __init__(self, client: BulletClient, tool: str, after_step: Callable[[], None]) -> None:
        self.client, self.tool, self.after_step = client, tool, after_step
        self.robot = robot.load_robot(client, tool)
        numbers = range(client.getNumJoints(self.robot))  # of the links, too
        self.links = {client.getJointInfo(self.robot, k)[12].decode(): k for k in numbers}
        self.fingers = self.links["left_finger"], self.links["right_finger"]
        self.joints = (*range(len(robot.HOME)), *self.fingers)
        self.palm = self.links["palm"]
        self._gear: int | None = None
        self._grip: int | None = None

    def put(self, angles_rad: np.ndarray, gap_m: float) -> None:
        """Set the joint angles (6,) [rad] and the gap of the fingers [m] without motion."""
        targets = [*angles_rad, gap_m / 2, gap_m / 2]
        for joint, angle in zip(self.joints, targets, strict=True):
            self.client.resetJointState(self.robot, joint, angle, 0.0)
        self._motors()(targetPositions=targets)
        self.angles_rad, self.gap_m = np.array(angles_rad, dtype=float), gap_m
        self.raised_m = 0.0

    def set_fingers(self, force_N: float, closing: bool) -> None:
        """Set the maximum force [N] of each finger, and low position gains if they will close."""
        self.gains = [0.3] * 6 + (_MOVING_FINGERS if closing else _STILL_FINGERS)
        self.forces = [*ARM_FORCES_N_M, force_N, force_N]

    def follow(
        self, joints: np.ndarray, gaps_m: np.ndarray, recording: Recording | None = None
    ) -> float:
        """Move through joint waypoints (n, 6) with finger gaps (n,); return the share completed.

        recording: receives the measurements during its segment; by default, none are made.
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
        # Velocity is fed forward, so the target must be this step's; the next one's would lead.
        commands = targets[:-1].tolist()
        guarded = recording is not None and recording.segment.guarded
        drive = {"forces": self.forces, "positionGains": self.gains}
        # Looked up once, because a client looks up its functions at every access.
        set_motors, simulate = partial(self._motors(), **drive), client.stepSimulation
        now, frozen_at = (targets[0].tolist(), [0.0] * 8), None
        for step in range(whole):
            if recording is not None and step % RECORD_EVERY == 0:
                at_waypoint = step % STEPS_PER_WAYPOINT == 0
                wanted = None if frozen_at else recording.segment.poses[step // STEPS_PER_WAYPOINT]
                self.record(recording, at_waypoint, wanted)
            if frozen_at is None:
                now = commands[step], velocities[step]
                contacts = client.getContactPoints(self.robot, recording.body) if guarded else ()
                if sum(contact[9] for contact in contacts) > GUARD_FORCE_N:
                    frozen_at, now = step, (commands[step], [0.0] * 8)
            set_motors(targetPositions=now[0], targetVelocities=now[1])
            simulate()
            self.after_step()
        self.angles_rad, self.gap_m = np.array(now[0][:6]), 2 * now[0][6]
        return 1.0 if frozen_at is None else frozen_at / whole

    def _motors(self) -> Callable[..., None]:
        """Return a function that commands targets to the joints of arm and fingers."""
        control = self.client.setJointMotorControlArray
        return partial(control, self.robot, self.joints, pybullet.POSITION_CONTROL)

    def wait(self, n_steps: int) -> None:
        """Simulate n_steps steps while the arm holds its position."""
        simulate = self.client.stepSimulation
        for _ in range(n_steps):
            simulate()
            self.after_step()

    def record(
        self, recording: Recording, with_tool: bool = True, wanted_W: np.ndarray | None = None
    ) -> None:
        """Record the body's state and, with_tool, the tool's pose, its error and penetrations."""
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

    def tool_pose(self) -> np.ndarray:
        """Measure x, y, z [m] of the tool's tip, its yaw [rad] and the gap of the fingers [m]."""
        state = self.client.getLinkState(self.robot, self.palm, computeForwardKinematics=1)
        axes = np.array(pybullet.getMatrixFromQuaternion(state[5])).reshape(3, 3)
        along, below = robot.TOOL_OFFSETS_M[self.tool]
        tip = np.array(state[4]) + along * axes[:, 0] + below * axes[:, 2]
        fingers = self.client.getJointStates(self.robot, self.fingers)
        yaw = math.atan2(axes[1, 0], axes[0, 0])
        return np.array([*tip, yaw, fingers[0][0] + fingers[1][0]])

    def tie_fingers(self) -> None:
        """Couple the two fingers with a gear; between two separate motors a held object drifts."""
        self.untie()
        left, right = self.fingers
        links, axis, origin = (self.robot, left, self.robot, right), (0, 1, 0), (0, 0, 0)
        self._gear = self.client.createConstraint(*links, pybullet.JOINT_GEAR, axis, origin, origin)
        self.client.changeConstraint(self._gear, gearRatio=-1, maxForce=300, erp=0.5)

    def untie(self) -> None:
        """Remove the gear between the fingers and the joint that fixes an object to the hand."""
        for joint in (self._grip, self._gear):
            if joint is not None:
                self.client.removeConstraint(joint)
        self._grip = self._gear = None

    def tie_held(self, body: int) -> None:
        """Fix an object held by both coupled fingers to the hand, since it creeps by 0.3 mm/s."""
        client = self.client
        touching = {contact[3] for contact in client.getContactPoints(self.robot, body)}
        if self._gear is None or self._grip is not None or not touching.issuperset(self.fingers):
            return
        hand = client.getLinkState(self.robot, self.palm)[:2]
        held = client.getBasePositionAndOrientation(body)
        position, orientation = pybullet.multiplyTransforms(*pybullet.invertTransform(*hand), *held)
        bodies = self.robot, self.palm, body, -1
        self._grip = client.createConstraint(
            *bodies, pybullet.JOINT_FIXED, (0, 0, 0), position, (0, 0, 0), orientation
        )
        client.changeConstraint(self._grip, maxForce=20)


def execute(
    arm: JointController,
    placed: PlacedObject,
    command: Command,
    seen: Observation,
    tip_offset_m: float,
    approach: bool,
) -> Interaction:
    """Execute a command at the object's observed position, with the tool raised by an offset [m].

    approach: the arm moves there through the air and back home, and rollable objects are braked
    before and after the recording; otherwise the arm is placed at the start and, finally, at home.
    Raises UnreachableError, without moving, if the arm cannot follow the command.
    """
    primitive = command.primitive
    if primitive.tool != arm.tool:
        raise ValueError(
            f"primitive {primitive.name!r} needs the tool {primitive.tool!r}, but the arm "
            f"holds the {arm.tool}; call place(..., tool={primitive.tool!r})"
        )
    start = poses(np.array([placed.state()]))[0]
    origin_m = *seen.xy_m, tip_offset_m
    segments, *motion = plan_motion(primitive, command.segments, origin_m, approach)
    above, down, paths, back = motion
    gaps = [primitive.opening_m * segment.poses[:, GRIPPER] for segment in segments]

    closes = any(np.ptp(gap) > 0 for gap in gaps)
    arm.set_fingers(primitive.force_N, closes)
    if closes:
        arm.tie_fingers()
    if approach:
        placed.brake(True)
        over = joint_move(arm.angles_rad, above, 1.0)
        arm.follow(over, np.linspace(arm.gap_m, gaps[0][0], 2))
        arm.follow(down, gaps[0][[0, 0]])
    else:
        arm.put(paths[0][0], gaps[0][0])
    placed.brake(False)

    recording, floor = Recording(placed.body), -math.inf
    for segment, path, gap in zip(segments, paths, gaps, strict=True):
        recording.segment, one = segment, segment.poses
        if one[:, Z].min() < floor:
            one[:, Z] = np.maximum(one[:, Z], floor)
            try:
                path = robot.joint_path(one, arm.angles_rad, primitive.tool)
            except UnreachableError:  # the arm stays where it felt the object, off its path
                path = np.repeat(arm.angles_rad[None], len(one), axis=0)
        covered = arm.follow(path, gap, recording)
        if segment.guarded and covered < 1.0:
            floor = float(np.interp(covered, np.linspace(0, 1, len(one)), one[:, Z]))
    arm.record(recording)
    placed.brake(approach)

    if primitive.holds and closes:
        heights_m = np.array(recording.tool)[:, Z]
        arm.raised_m = float(heights_m[-1] - heights_m.min())
    if not primitive.holds:
        release = np.array([arm.gap_m, primitive.opening_m if closes else arm.gap_m])
        if release[1] > release[0]:
            arm.follow(np.repeat(arm.angles_rad[None], 13, axis=0), np.linspace(*release, 13))
        arm.follow(back, release[[1, 1]])
        if approach:
            arm.follow(joint_move(arm.angles_rad, robot.HOME, 1.0), release[[1, 1]])
    arm.wait(SETTLE_STEPS)
    if not primitive.holds:
        arm.untie()
    interaction = _interaction(command, placed, recording, seen, start, origin_m)
    if not (approach or primitive.holds):
        arm.put(robot.HOME, arm.gap_m)
    return interaction


def _interaction(
    command: Command,
    placed: PlacedObject,
    recording: Recording,
    seen: Observation,
    start: np.ndarray,
    origin_m: Sequence[float],
) -> Interaction:
    """Build the interaction from the recording, interpolated at the command's phases."""
    recorded = poses(placed.states_of_centre(np.array(recording.states)))
    rest = poses(np.array([placed.state()]))[0]
    # Choose the multiple of 2π nearest to the last recorded yaw, which is unwrapped.
    last = recorded[-1, YAW]
    rest[YAW] = last + (rest[YAW] - last + math.pi) % (2 * math.pi) - math.pi
    origin = np.array([*start[: Z + 1], recorded[0, YAW], 0.0])
    tool = np.array(recording.tool) - [*origin_m, 0.0, 0.0]
    tool[:, YAW] = np.unwrap(tool[:, YAW])
    at_sample, at_waypoint = recorded_phases(command.segments)
    seldom = np.linspace(0, command.phase[-1], RECORDED_SAMPLES)
    return replace(
        unreached(command, placed, seen),
        reached=True,
        effect=interpolated(command.phase, at_sample, recorded - origin),
        rest_effect=rest - origin,
        start_pose=(float(start[0]), float(start[1]), float(recorded[0, YAW])),
        tracking_error_m=recording.off_path_m,
        tool=interpolated(seldom, at_waypoint, tool),
        penetration_m=recording.penetration_m,
        left_table=placed.left_table(),
        fell=placed.fell(),
    )


def unreached(command: Command, placed: PlacedObject, seen: Observation) -> Interaction:
    """Return the interaction for a command out of the arm's reach, in which nothing moved."""
    return Interaction(
        primitive=command.primitive,
        stop_phase=float(command.phase[-1]),
        phase=command.phase,
        action=command.action,
        image=seen.image,
        estimated_xy_m=seen.xy_m,
        rolls=placed.rolls(),
        effect=np.zeros((len(command.phase), 5)),
        rest_effect=np.zeros(5),
        start_pose=placed.pose(),
        tool=np.zeros((RECORDED_SAMPLES, 5)),
        reached=False,
    )


def put_down(arm: JointController) -> None:
    """Lower the held object to its height before the lift, open the fingers, rise and go home."""
    *pose, gap_m = arm.tool_pose()
    here, below_m = np.array([*pose, 0.0, 0.0]), arm.raised_m if gap_m > EMPTY_M else 0.0
    down = np.repeat(arm.angles_rad[None], 2, axis=0)
    if below_m > PUT_DOWN_M:
        down = line(here, here - (below_m - PUT_DOWN_M) * UP, arm.angles_rad, 1.0, arm.tool)
    wide = np.linspace(arm.gap_m, max(arm.gap_m, Grasp.opening_m), 13)
    arm.set_fingers(Grasp.force_N, closing=True)
    arm.follow(down, wide[[0, 0]])
    arm.follow(np.repeat(arm.angles_rad[None], 13, axis=0), wide)
    arm.untie()
    arm.follow(down[::-1], wide[[-1, -1]])
    arm.follow(joint_move(arm.angles_rad, robot.HOME, 1.0), wide[[-1, -1]])
    arm.raised_m = 0.0
