"""The tabletop: one PyBullet client with a table, the UR10, one object and the depth camera.

Use it as a context manager. The simulation is deterministic. With a four times finer time step and
twice the solver iterations, the final position of a push changes by 0.02 mm (median).
"""

import os
import weakref
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager

import numpy as np
import pybullet
from pybullet_utils.bullet_client import BulletClient

from affordlib.perception import adapt_to_object
from affordlib.primitives import PUSH_GAP_M, LeverUp, Primitive, Push
from affordlib.types import (
    LEVER_CROP_WIDTH_M,
    LEVER_IMAGE_PIXELS,
    TABLE_X_M,
    TABLE_Y_M,
    Interaction,
    NothingSeenError,
    Observation,
    Step,
    UnreachableError,
    check_array,
    check_choice,
    check_count,
    check_finite,
    check_on_table,
    check_within,
)
from affordlib.world import camera, robot
from affordlib.world.execution import JointController, execute, put_down, unreached
from affordlib.world.objects import PlacedObject, TabletopObject, WorldConfig, set_friction
from affordlib.world.trajectory import STEP_S, Command, plan_motion, segments_until

OBJECTS_PER_BUILD = 256
"""Number of objects after which the client is rebuilt; Bullet leaks 5 kB per removed object."""


class _Client(BulletClient):
    """A PyBullet client connected without options, because Bullet would print them."""

    def __init__(self) -> None:
        self._pid = os.getpid()
        self._client = pybullet.connect(pybullet.DIRECT)


class Tabletop(AbstractContextManager):
    """A table, an arm and at most one object, in a separate PyBullet client.

    n_averaged_images: number of noisy images over which an observation averages; on_step: called
    with the world after every step of the simulation.
    """

    def __init__(self, config: WorldConfig | None = None) -> None:
        self.config = config or WorldConfig()
        self._client: BulletClient | None = _Client()
        self.arm: JointController | None = None
        self.on_step: Callable[[Tabletop], None] | None = None
        self.n_averaged_images = 1
        self.reset()

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Disconnect from PyBullet; this also happens when the world is garbage-collected."""
        if self._client is not None:
            self._client.disconnect()
            self._client = None

    @property
    def client(self) -> BulletClient:
        """The PyBullet client of this world; raises RuntimeError if the world is closed."""
        if self._client is None:
            raise RuntimeError("this world is closed; make a new Tabletop()")
        return self._client

    def reset(self, tool: str = "gripper") -> None:
        """Clear the table and park the arm with a tool; the state is bit-identical every time."""
        client = self.client
        if self.arm is None or tool != self.arm.tool or self._n_placed >= OBJECTS_PER_BUILD:
            self._build(tool)
        else:  # same state as after building, without loading table and arm again
            self.arm.untie()
            for body in [client.getBodyUniqueId(k) for k in range(client.getNumBodies())]:
                if body not in (self._table, self.arm.robot):
                    client.removeBody(body)
            client.restoreState(stateId=self._fresh)
        self._placed: PlacedObject | None = None
        self._marks: list[int] = []
        self.noise = np.random.default_rng(self.config.noise_seed)
        set_friction(client, self._table, -1, self.config.table_friction)
        for name in ("left_finger", "right_finger", "blade", "rod"):
            if name in self.arm.links:
                finger = self.arm.robot, self.arm.links[name]
                set_friction(client, *finger, self.config.finger_friction)
        self.arm.put(np.array(robot.HOME), PUSH_GAP_M)

    def _build(self, tool: str) -> None:
        client = self.client
        client.resetSimulation()
        client.setGravity(0, 0, -9.81)
        client.setPhysicsEngineParameter(
            fixedTimeStep=STEP_S,
            numSolverIterations=50,
            restitutionVelocityThreshold=0.0,
            deterministicOverlappingPairs=1,
        )
        half = [(TABLE_X_M[1] - TABLE_X_M[0]) / 2, (TABLE_Y_M[1] - TABLE_Y_M[0]) / 2, 0.05]
        shape = {"shapeType": pybullet.GEOM_BOX, "halfExtents": half}
        self._table = client.createMultiBody(
            baseCollisionShapeIndex=client.createCollisionShape(**shape),
            baseVisualShapeIndex=client.createVisualShape(**shape, rgbaColor=(0.93, 0.90, 0.85, 1)),
            basePosition=(sum(TABLE_X_M) / 2, sum(TABLE_Y_M) / 2, -0.05),
        )
        world = weakref.proxy(self)  # a reference cycle would keep the client connected
        self.arm = JointController(client, tool, lambda: world.on_step and world.on_step(world))
        self._n_placed = 0
        self._fresh = client.saveState()

    def place(
        self,
        obj: TabletopObject,
        xy_m: tuple[float, float] = (0.0, 0.0),
        yaw_rad: float = 0.0,
        *,
        tool: str = "gripper",
        config: WorldConfig | None = None,
    ) -> None:
        """Clear the table, park the arm and place an object at (x, y) [m] with a yaw [rad].

        tool: "gripper", "screwdriver" or "rod"; config: new parameters (default: unchanged).
        """
        xy_m, yaw_rad = check_on_table("xy_m", xy_m), check_finite("yaw_rad", yaw_rad)
        self.config = config or self.config
        self.reset(check_choice("tool", tool, robot.TOOL_OFFSETS_M))
        self._n_placed += 1
        self._placed = PlacedObject(self.client, obj, self.config, xy_m, yaw_rad)

    @property
    def placed(self) -> PlacedObject:
        """The object on the table; raises NothingSeenError if there is none."""
        if self._placed is None:
            raise NothingSeenError("there is no object on the table; call place(...) first")
        return self._placed

    @property
    def obj(self) -> TabletopObject:
        """Category and dimensions of the object on the table."""
        return self.placed.obj

    def object_state(self) -> tuple[float, ...]:
        """Return position (x, y, z) [m] and quaternion (x, y, z, w) of the object, 7 numbers."""
        return self.placed.state()

    def object_pose(self) -> tuple[float, float, float]:
        """Return the object's (x, y) [m] and yaw [rad] in the table's frame."""
        return self.placed.pose()

    def object_fell(self) -> bool:
        """Return whether the object fell over since it was placed."""
        return self.placed.fell()

    def object_rolls(self) -> bool:
        """Return whether the object can roll in its current orientation, as a lying cylinder."""
        return self.placed.rolls()

    def shove(self, dx_m: float, dy_m: float, dyaw_rad: float = 0.0) -> None:
        """Displace the object by (dx, dy) [m], rotate it by dyaw_rad, and let it settle.

        Raises ValueError, without moving it, if its centre would leave the table.
        """
        self.placed.displace(dx_m, dy_m, dyaw_rad)
        self.settle()

    def settle(self, seconds: float = 0.5) -> None:
        """Simulate `seconds` while the arm keeps its hold and a rolling object is braked."""
        steps = round(check_within("seconds", seconds, 0.0, 60.0, "s") / STEP_S)
        if self._placed is not None:
            self.placed.brake(True)
            self.arm.tie_held(self.placed.body)
        self.arm.wait(steps)

    def park(self) -> None:
        """Put down the held object, if any, open the fingers and move the arm home."""
        put_down(self.arm)
        self.settle()

    def observe(self) -> Observation:
        """Return the object's estimated position and its image; the arm must be parked.

        The position is the mean over `n_averaged_images` images; the image is the first of them.
        A Kinect's image is centred on the object as seen in it, independent of mean and `bias_m`.
        """
        x, y, _ = self.object_pose()
        views = []
        if self.config.camera == "kinect":
            images = range(self.n_averaged_images)
            views = [camera.kinect_view(self.client, self.noise) for _ in images]
            x, y = np.mean([xy for xy, _ in views], axis=0).tolist()
        xy = x + self.config.bias_m[0], y + self.config.bias_m[1]
        image = views[0][1] if views else camera.depth_crop(self.client, xy)
        return Observation(xy, image)

    def _observe_edge(self, lever: LeverUp) -> Observation:
        """Return the image (2, 128, 128) around a lever-up's contact, the lever pointing right."""
        if self.config.camera != "ideal":
            raise ValueError(f'camera must be "ideal" for a lever-up, got {self.config.camera!r}')
        x, y = np.add(self.object_pose()[:2], self.config.bias_m).tolist()
        window = (x + lever.contact_x, y + lever.contact_y), LEVER_IMAGE_PIXELS, LEVER_CROP_WIDTH_M
        return Observation((x, y), camera.depth_crop(self.client, *window, lever.theta, samples=1))

    def depth_image(self) -> np.ndarray:
        """Return depth [m] and mask (2, 48, 48) around the object; the arm must be parked."""
        return self.observe().image

    def picture(
        self,
        width: int = 320,
        height: int = 240,
        at_m: Sequence[float] = (-0.05, 0.0, 0.06),
        distance_m: float = 1.0,
        yaw_deg: float = 62.0,
        pitch_deg: float = -33.0,
        field_deg: float = 45.0,
    ) -> np.ndarray:
        """Render a colour picture (height, width, 3), uint8, of the robot and the table.

        The camera looks at a point `at_m` (x, y, z) from a distance, with a vertical field of view;
        with the yaw 0 it looks along y, with the pitch -90 straight down.
        """
        for name, pixels in (("width", width), ("height", height)):
            check_count(name, pixels, 16, 2048)
        view = (
            check_within("distance_m", distance_m, 0.2, 3.0, "m"),
            check_within("yaw_deg", yaw_deg, -360.0, 360.0, "°"),
            check_within("pitch_deg", pitch_deg, -90.0, 0.0, "°"),
            check_within("field_deg", field_deg, 1.0, 120.0, "°"),
        )
        (at_m,) = check_array("at_m", [at_m], 1, 3)
        at_m = [check_within("at_m", value, -2.0, 2.0, "m") for value in at_m]
        self._move_marks(1.0)
        picture = camera.picture(self.client, (width, height), at_m, *view)
        self._move_marks(-1.0)
        return picture

    def mark(
        self,
        xy_m: tuple[float, float],
        rgb: tuple[float, float, float],
        yaw_rad: float = 0.0,
        scale: float = 1.0,
    ) -> None:
        """Draw the object's footprint at (x, y) [m], in a colour, unseen by the robot's camera."""
        self._marks.append(self.placed.draw_outline(xy_m, rgb, yaw_rad, scale))

    def _move_marks(self, up_m: float) -> None:
        for body in self._marks:
            (x, y, z), turn = self.client.getBasePositionAndOrientation(body)
            self.client.resetBasePositionAndOrientation(body, (x, y, z + up_m), turn)

    def can_reach(
        self, primitive: Primitive, stop_phase: float = 1.0, at_xy_m: Sequence[float] | None = None
    ) -> bool:
        """Return whether the arm can execute an action with approach and retreat; nothing moves.

        at_xy_m: position of the object (default: observed, and the action is adapted to the image).
        """
        stop_phase = check_within("stop_phase", stop_phase, 0.0, 1.0)
        if at_xy_m is None:
            seen = self.observe()
            at_xy_m, primitive = seen.xy_m, adapt_to_object(primitive, seen.image)
        offset = np.array([*check_on_table("at_xy_m", at_xy_m), self.config.tip_offset_m, 0.0, 0.0])
        try:
            plan_motion(primitive, segments_until(primitive, stop_phase), offset, approach=True)
        except UnreachableError:
            return False
        return True

    def execute(self, step: Step) -> Interaction:
        """Execute a step of a plan, with approach, along its decoded path if it has one."""
        if step.path_xy_m is None:
            return self.execute_primitive(step.primitive, step.stop_phase, approach=True)
        return self.execute_path(step.path_xy_m, step.primitive, step.stop_phase)

    def execute_primitive(
        self,
        primitive: Primitive,
        stop_phase: float = 1.0,
        *,
        approach: bool = False,
        smooth: bool = True,
        record_unreachable: bool = False,
    ) -> Interaction:
        """Execute a primitive on the object up to a phase, and record the effect.

        approach: the arm moves there and back home through the air, and rollable objects are braked
        before and after; otherwise it is placed at the start of the path, and finally at home.
        The effect is recorded at 301 phases in [0, stop_phase]. A partial action is a prefix of
        the path, re-timed to a smooth stop, or stopped abruptly with smooth=False.
        If the arm cannot reach, raises UnreachableError, or with record_unreachable=True returns
        an interaction in which nothing moved (`reached` is False).
        """
        stop_phase = check_within("stop_phase", stop_phase, 0.0, 1.0)
        self._require_tool(primitive)
        seen = self._observe_edge(primitive) if isinstance(primitive, LeverUp) else self.observe()
        command = Command.of(adapt_to_object(primitive, seen.image), stop_phase, smooth)
        try:
            return execute(self.arm, self.placed, command, seen, self.config.tip_offset_m, approach)
        except UnreachableError:
            if not record_unreachable:
                raise
            return unreached(command, self.placed, seen)

    def execute_path(
        self, path_xy_m: np.ndarray, primitive: Push | None = None, stop_phase: float = 1.0
    ) -> Interaction:
        """Move the gripper along a path (n, 2) [m] relative to the object, and record the effect.

        Height and timing are those of the primitive (default: a push) up to stop_phase. The
        gripper's yaw is the direction from the first to the last point.
        """
        stop_phase = check_within("stop_phase", stop_phase, 0.0, 1.0)
        primitive = primitive or Push(0.0)
        self._require_tool(primitive)
        command = Command.along(check_array("path_xy_m", path_xy_m, 2), primitive, stop_phase)
        seen = self.observe()
        return execute(self.arm, self.placed, command, seen, self.config.tip_offset_m, True)

    def _require_tool(self, primitive: Primitive) -> None:
        if primitive.tool != self.arm.tool:
            raise ValueError(
                f"primitive {primitive.name!r} needs the tool {primitive.tool!r}, but the arm "
                f"holds the {self.arm.tool}; call place(..., tool={primitive.tool!r})"
            )
