"""The tabletop: one PyBullet client with a table, the UR10, one object and the depth camera.

Use it as a context manager; everything in it is deterministic. Settings were measured: against a
four times finer step with twice the solver's iterations a push ends within 0.02 mm (median).
"""

from __future__ import annotations

import math
import weakref
from collections.abc import Sequence

import numpy as np
import pybullet
from scipy.spatial.transform import Rotation

from affordlib.perception import adapt_to_object
from affordlib.primitives import DURATION_S, PUSH_GAP_M, LeverUp, Primitive, Push, min_jerk
from affordlib.types import (
    LEVER_CROP_WIDTH_M,
    LEVER_IMAGE_PIXELS,
    TABLE_X_M,
    TABLE_Y_M,
    Interaction,
    Observation,
    Step,
    UnreachableError,
    check_array,
    check_count,
    check_finite,
    check_on_table,
    check_pair,
    check_within,
)
from affordlib.world import camera, motion, robot
from affordlib.world.config import WorldConfig
from affordlib.world.execution import execute, place_offset, plan_motion, put_down, refused
from affordlib.world.interventions import Interventions
from affordlib.world.motion import StepCallback
from affordlib.world.objects import TabletopObject, create_body, create_footprint

OBJECTS_PER_BUILD = 256
"""After so many objects the client is built anew: Bullet keeps 5 kB of each that is removed."""

N_SAMPLES = 301
"""Recorded samples over the phase: one every 3 simulation steps of a full primitive."""


class Tabletop(Interventions):
    """A table, an arm and at most one object, in a PyBullet client of its own.

    n_averaged_images: over how many noisy images an observation averages.
    """

    def __init__(self, config: WorldConfig | None = None) -> None:
        self.config = config or WorldConfig()
        self._client = pybullet.connect(pybullet.DIRECT)
        self._disconnect = weakref.finalize(self, pybullet.disconnect, self._client)
        self.obj: TabletopObject | None = None
        self.on_step: StepCallback | None = None
        self.tool = ""
        self.n_averaged_images = 1
        self.reset()

    def __enter__(self) -> Tabletop:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Disconnect from PyBullet, as happens to a world that nothing refers to any more."""
        self._disconnect()

    @property
    def client(self) -> int:
        """PyBullet's number of this world; raises RuntimeError when it is closed."""
        if not self._disconnect.alive:
            raise RuntimeError("this world is closed; make a new Tabletop()")
        return self._client

    def reset(self, tool: str = "gripper") -> None:
        """Clear the table and park the arm with a tool: the same world, bit for bit, every time."""
        client = self.client
        if tool != self.tool or self._placed >= OBJECTS_PER_BUILD:
            self._build(tool)
        else:
            self._clear()
        self.obj, self.body = None, -1
        self.noise = np.random.default_rng(self.config.noise_seed)
        self._set_friction(self.table, -1, self.config.table_friction)
        for link in robot.touching_links(client, self.robot):
            self._set_friction(self.robot, link, self.config.finger_friction)
        motion.put_arm(self, np.array(robot.HOME), PUSH_GAP_M)

    def _build(self, tool: str) -> None:
        client = self.client
        pybullet.resetSimulation(physicsClientId=client)
        pybullet.setGravity(0, 0, -9.81, physicsClientId=client)
        pybullet.setPhysicsEngineParameter(
            fixedTimeStep=motion.STEP_S,
            numSolverIterations=50,
            restitutionVelocityThreshold=0.0,
            deterministicOverlappingPairs=1,
            physicsClientId=client,
        )
        half = [(TABLE_X_M[1] - TABLE_X_M[0]) / 2, (TABLE_Y_M[1] - TABLE_Y_M[0]) / 2, 0.05]
        shape = {"shapeType": pybullet.GEOM_BOX, "halfExtents": half, "physicsClientId": client}
        self.table = pybullet.createMultiBody(
            baseCollisionShapeIndex=pybullet.createCollisionShape(**shape),
            baseVisualShapeIndex=pybullet.createVisualShape(
                **shape, rgbaColor=(0.93, 0.90, 0.85, 1)
            ),
            basePosition=(sum(TABLE_X_M) / 2, sum(TABLE_Y_M) / 2, -0.05),
            physicsClientId=client,
        )
        self.tool, self.robot, self._placed = tool, robot.load_robot(client, tool), 0
        self.joints = (*robot.ARM_JOINTS, *robot.finger_joints(client, self.robot))
        self._fresh = pybullet.saveState(physicsClientId=client)

    def _clear(self) -> None:
        """Back to table and arm alone: exactly as when built, without loading them again."""
        client = self.client
        motion.untie_fingers(self)
        bodies = range(pybullet.getNumBodies(physicsClientId=client))
        for body in [pybullet.getBodyUniqueId(k, physicsClientId=client) for k in bodies]:
            if body not in (self.table, self.robot):
                pybullet.removeBody(body, physicsClientId=client)
        pybullet.restoreState(stateId=self._fresh, physicsClientId=client)

    def _set_friction(self, body: int, link: int, lateral: float) -> None:
        pybullet.changeDynamics(
            body,
            link,
            lateralFriction=lateral,
            spinningFriction=1e-3,
            rollingFriction=motion.ROLLING_M,
            restitution=0.0,
            physicsClientId=self.client,
        )

    def place(
        self,
        obj: TabletopObject,
        xy_m: tuple[float, float] = (0.0, 0.0),
        yaw_rad: float = 0.0,
        *,
        tool: str = "gripper",
        config: WorldConfig | None = None,
    ) -> None:
        """Clear the table, park the arm and stand an object at (x, y) [m], turned by a yaw.

        tool: "gripper" or "screwdriver"; config: from now on (default: as it is).
        """
        x, y = check_on_table("xy_m", xy_m)
        yaw = check_finite("yaw_rad", yaw_rad)
        if tool not in robot.TOOL_OFFSETS_M:
            raise ValueError(f"tool must be one of {sorted(robot.TOOL_OFFSETS_M)}, got {tool!r}")
        self.config = config or self.config
        self.reset(tool)
        self._placed += 1
        mass = self.config.density_kg_m3 * obj.volume_m3
        com = self.config.com_offset_m
        self.obj = obj
        self.body = create_body(self.client, obj, mass, (0.0, 0.62, 0.45, 1), com)
        self._set_friction(self.body, -1, self.config.object_friction)
        pybullet.changeDynamics(
            self.body, -1, linearDamping=0.0, angularDamping=0.0, physicsClientId=self.client
        )
        c, s = math.cos(yaw), math.sin(yaw)
        pybullet.resetBasePositionAndOrientation(
            self.body,
            (
                x + c * com[0] - s * com[1],
                y + s * com[0] + c * com[1],
                obj.height_m / 2 + com[2],
            ),
            pybullet.getQuaternionFromEuler((0, 0, yaw)),
            physicsClientId=self.client,
        )

    def _require_object(self) -> None:
        if self.obj is None:
            raise RuntimeError("there is no object on the table; call place(...) first")

    def centred(self, states: np.ndarray) -> np.ndarray:
        """States (n, 7) of the object's centre, given those of its centre of mass."""
        offset = np.array(self.config.com_offset_m)
        if not offset.any():
            return states
        shift = Rotation.from_quat(states[:, 3:]).apply(offset)
        return np.column_stack([states[:, :3] - shift, states[:, 3:]])

    def object_state(self) -> tuple[float, ...]:
        """Position (x, y, z) [m] and quaternion (x, y, z, w) of the object, seven numbers."""
        self._require_object()
        position, quaternion = pybullet.getBasePositionAndOrientation(self.body, self.client)
        return tuple(self.centred(np.array([[*position, *quaternion]]))[0])

    def object_pose(self) -> tuple[float, float, float]:
        """The object's (x, y) [m] and yaw [rad] in the frame of the table."""
        x, y, _, yaw, _ = motion.poses(np.array([self.object_state()]))[0]
        return float(x), float(y), float(yaw)

    def object_tilt_rad(self) -> float:
        """Angle between the object's own upright axis and the vertical [rad]."""
        return float(motion.poses(np.array([self.object_state()]))[0, 4])

    def _upward(self) -> np.ndarray:
        return Rotation.from_quat(self.object_state()[3:]).as_matrix()[2]

    def object_fell(self) -> bool:
        """Whether the object lies differently than it was placed."""
        self._require_object()
        return self.obj.fallen(self._upward())

    def object_rolls(self) -> bool:
        """Whether the object can roll as it lies now: a cylinder on its side, not upright."""
        self._require_object()
        return self.obj.rolls(self._upward())

    @staticmethod
    def on_table(xyz_m: tuple[float, float, float]) -> bool:
        """Whether a point (x, y, z) [m] is above the table."""
        x, y, z = xyz_m
        return z > 0 and TABLE_X_M[0] <= x <= TABLE_X_M[1] and TABLE_Y_M[0] <= y <= TABLE_Y_M[1]

    def observe(self) -> Observation:
        """The object's estimated position and its image; the arm must be parked.

        The position is the mean over `n_averaged_images` images, the image is the first of them.
        """
        self._require_object()
        x, y, _ = self.object_pose()
        image = None
        if self.config.camera == "kinect":
            views = [
                camera.kinect_view(self.client, self.noise) for _ in range(self.n_averaged_images)
            ]
            x, y = np.mean([xy for xy, _ in views], axis=0).tolist()
            image = views[0][1]
        x, y = x + self.config.bias_m[0], y + self.config.bias_m[1]
        if image is None:
            image = camera.depth_crop(self.client, (x, y))
        return Observation((x, y), image)

    def depth_image(self) -> np.ndarray:
        """Depth [m] and mask (2, 48, 48) of the table around the object, the arm parked."""
        return self.observe().image

    def depth_image_from(self, xy_m: tuple[float, float], turn_rad: float) -> np.ndarray:
        """Depth [m] and mask (2, 128, 128) around a point, the direction turn_rad to the right.

        xy_m: relative to the object, along the table's axes.
        """
        x, y, _ = self.object_pose()
        dx, dy = (check_within("xy_m", v, -1.0, 1.0, "m") for v in check_pair("xy_m", xy_m))
        at, turn_rad = (x + dx, y + dy), check_finite("turn_rad", turn_rad)
        return camera.depth_crop(
            self.client, at, LEVER_IMAGE_PIXELS, LEVER_CROP_WIDTH_M, turn_rad, samples=1
        )

    def picture(self, width: int = 320, height: int = 240) -> np.ndarray:
        """A colour picture (height, width, 3), uint8, of the robot at work, for people."""
        for name, pixels in (("width", width), ("height", height)):
            check_count(name, pixels, 16, 2048)
        return camera.picture(self.client, width, height)

    def mark(
        self,
        xy_m: tuple[float, float],
        rgb: tuple[float, float, float],
        yaw_rad: float = 0.0,
        scale: float = 1.0,
    ) -> None:
        """Show the object's footprint at (x, y) [m] on the table, in a colour; only seen."""
        self._require_object()
        x, y = check_on_table("xy_m", xy_m)
        yaw_rad, scale = check_finite("yaw_rad", yaw_rad), check_within("scale", scale, 0.1, 10.0)
        rgb = [check_within("rgb", share, 0.0, 1.0) for share in check_array("rgb", rgb, 3)]
        create_footprint(self.client, self.obj, (x, y), yaw_rad, (*rgb, 1.0), scale)

    def execute_primitive(
        self,
        primitive: Primitive,
        stop_phase: float = 1.0,
        *,
        approach: bool = False,
        smooth: bool = True,
        record_unreachable: bool = False,
    ) -> Interaction:
        """Execute a primitive on the object up to a phase, and record what happens.

        approach=False puts the arm at the start of the path and away in the end (collecting);
        approach=True moves it there through the air and back home (carrying out a plan), and the
        table brakes what rolls before and after what is recorded.
        The effect is recorded at `N_SAMPLES` phases in [0, stop_phase]. A partial action is the
        prefix of the path, re-timed to its own smooth stop, or with smooth=False cut off.
        Raises UnreachableError when the arm cannot follow the path; with record_unreachable=True
        the result is then an interaction in which nothing moved (`reached` is False).
        """
        primitive, phase, seen = self._look_before(primitive, stop_phase)
        way = motion.stretches(primitive, stop_phase, smooth)
        try:
            return execute(self, primitive, way, phase, primitive.path(phase), seen, approach)
        except UnreachableError:
            if not record_unreachable:
                raise
            return refused(self, primitive, phase, seen)

    def _look_before(
        self, primitive: Primitive, stop_phase: float
    ) -> tuple[Primitive, np.ndarray, Observation]:
        """The primitive aimed at what is seen, the phases to be recorded, and what is seen."""
        stop_phase = check_within("stop_phase", stop_phase, 0.0, 1.0)
        self._require_tool(primitive)
        seen = self._observe_for(primitive)
        return (
            adapt_to_object(primitive, seen.image),
            np.linspace(0.0, 1.0, N_SAMPLES) * stop_phase,
            seen,
        )

    def _require_tool(self, primitive: Primitive) -> None:
        if primitive.tool != self.tool:
            raise ValueError(
                f"primitive {primitive.name!r} needs the tool {primitive.tool!r}, and the arm "
                f"holds the {self.tool}; call place(..., tool={primitive.tool!r})"
            )

    def can_reach(
        self, primitive: Primitive, stop_phase: float = 1.0, at_xy_m: Sequence[float] | None = None
    ) -> bool:
        """Whether the arm can carry out an action, with approach and way out; nothing moves.

        at_xy_m: where the object is (default: where it is seen; the action is then aimed at it, as
        `execute_primitive` does). The kinematics are those by which `execute_primitive` plans.
        """
        stop_phase = check_within("stop_phase", stop_phase, 0.0, 1.0)
        at_xy_m = None if at_xy_m is None else check_on_table("at_xy_m", at_xy_m)
        if at_xy_m is None:
            seen = self.observe()
            at_xy_m, primitive = seen.xy_m, adapt_to_object(primitive, seen.image)
        way = motion.stretches(primitive, stop_phase)
        try:
            plan_motion(primitive, way, place_offset(self, at_xy_m), approach=True)
        except UnreachableError:
            return False
        return True

    def park(self) -> None:
        """Put down what the hand holds, open the fingers and take the arm home."""
        put_down(self)
        self.settle()

    def _observe_for(self, primitive: Primitive) -> Observation:
        """What the robot sees before it acts; a lever-up looks from the contact point."""
        if not isinstance(primitive, LeverUp):
            return self.observe()
        self._require_object()
        contact = (primitive.contact_x, primitive.contact_y)
        return Observation(self.object_pose()[:2], self.depth_image_from(contact, primitive.theta))

    def execute(self, step: Step) -> Interaction:
        """Execute a step of a plan, with approach: its decoded path if it has one."""
        if step.path_xy_m is None:
            return self.execute_primitive(step.primitive, step.stop_phase, approach=True)
        return self.execute_path(step.path_xy_m, step.primitive, step.stop_phase)

    def execute_path(
        self, path_xy_m: np.ndarray, primitive: Push | None = None, stop_phase: float = 1.0
    ) -> Interaction:
        """Move the gripper along a path (n, 2) [m] relative to the object, and record.

        Height and timing are those of the primitive (default: a push), up to stop_phase; the
        fingers face where the path leads.
        """
        stop_phase = check_within("stop_phase", stop_phase, 0.0, 1.0)
        primitive = primitive or Push(0.0)
        self._require_tool(primitive)
        path_xy_m = check_array("path_xy_m", path_xy_m, 2)
        phase, action = motion.along_path(path_xy_m, primitive, stop_phase)
        way = [motion.stretch_along(action, phase, DURATION_S * float(min_jerk(phase[-1])))]
        return execute(self, primitive, way, phase, action, self.observe(), approach=True)
