"""The tabletop: one PyBullet client with a table, the UR10, one object and the depth camera.

Use it as a context manager; everything in it is deterministic. Settings were measured: against a
four times finer step with twice the solver's iterations a push ends within 0.02 mm (median).
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
"""After so many objects the client is built again: Bullet keeps 5 kB of each that is removed."""


class _Client(BulletClient):
    """PyBullet with a client's number, connected without options, which Bullet would print."""

    def __init__(self) -> None:
        self._pid = os.getpid()
        self._client = pybullet.connect(pybullet.DIRECT)


class Tabletop(AbstractContextManager):
    """A table, an arm and at most one object, in a PyBullet client of its own.

    n_averaged_images: over how many noisy images an observation averages; on_step: called with the
    world after every step of the simulation.
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
        """Disconnect from PyBullet, as happens to a world that nothing refers to any more."""
        if self._client is not None:
            self._client.disconnect()
            self._client = None

    @property
    def client(self) -> BulletClient:
        """PyBullet with this world's number; raises RuntimeError when it is closed."""
        if self._client is None:
            raise RuntimeError("this world is closed; make a new Tabletop()")
        return self._client

    def reset(self, tool: str = "gripper") -> None:
        """Clear the table and park the arm with a tool: the same world, bit for bit, every time."""
        client = self.client
        if self.arm is None or tool != self.arm.tool or self._n_placed >= OBJECTS_PER_BUILD:
            self._build(tool)
        else:  # exactly as when built, without loading table and arm again
            self.arm.untie()
            for body in [client.getBodyUniqueId(k) for k in range(client.getNumBodies())]:
                if body not in (self._table, self.arm.robot):
                    client.removeBody(body)
            client.restoreState(stateId=self._fresh)
        self._placed: PlacedObject | None = None
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
        world = weakref.proxy(self)  # no circle of references: it would keep the client connected
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
        """Clear the table, park the arm and stand an object at (x, y) [m], turned by a yaw.

        tool: "gripper", "screwdriver" or "rod"; config: from now on (default: as it is).
        """
        xy_m, yaw_rad = check_on_table("xy_m", xy_m), check_finite("yaw_rad", yaw_rad)
        self.config = config or self.config
        self.reset(check_choice("tool", tool, robot.TOOL_OFFSETS_M))
        self._n_placed += 1
        self._placed = PlacedObject(self.client, obj, self.config, xy_m, yaw_rad)

    @property
    def placed(self) -> PlacedObject:
        """The object on the table; raises NothingSeenError when there is none."""
        if self._placed is None:
            raise NothingSeenError("there is no object on the table; call place(...) first")
        return self._placed

    @property
    def obj(self) -> TabletopObject:
        """The object on the table: its category and dimensions."""
        return self.placed.obj

    def object_state(self) -> tuple[float, ...]:
        """Position (x, y, z) [m] and quaternion (x, y, z, w) of the object, seven numbers."""
        return self.placed.state()

    def object_pose(self) -> tuple[float, float, float]:
        """The object's (x, y) [m] and yaw [rad] in the frame of the table."""
        return self.placed.pose()

    def object_fell(self) -> bool:
        """Whether the object lies differently than it was placed."""
        return self.placed.fell()

    def object_rolls(self) -> bool:
        """Whether the object can roll as it lies now: a cylinder on its side, not upright."""
        return self.placed.rolls()

    def shove(self, dx_m: float, dy_m: float, dyaw_rad: float = 0.0) -> None:
        """Displace the object by (dx, dy) [m], turn it by a yaw [rad], and let it settle.

        Raises ValueError, and moves nothing, when its centre would leave the table.
        """
        self.placed.displace(dx_m, dy_m, dyaw_rad)
        self.settle()

    def settle(self, seconds: float = 0.5) -> None:
        """Let the world run while the arm holds what it holds and the table brakes what rolls."""
        steps = round(check_within("seconds", seconds, 0.0, 60.0, "s") / STEP_S)
        if self._placed is not None:
            self.placed.brake(True)
            self.arm.tie_held(self.placed.body)
        self.arm.wait(steps)

    def park(self) -> None:
        """Put down what the hand holds, open the fingers and take the arm home."""
        put_down(self.arm)
        self.settle()

    def observe(self) -> Observation:
        """The object's estimated position and its image; the arm must be parked.

        The position is the mean over `n_averaged_images` images, the image is the first of them.
        A Kinect's image is centred where the object is seen in it, whatever the mean and `bias_m`.
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
        """The image (2, 128, 128) around a lever-up's contact, its direction to the right."""
        if self.config.camera != "ideal":
            raise ValueError(f'camera must be "ideal" for a lever-up, got {self.config.camera!r}')
        x, y = np.add(self.object_pose()[:2], self.config.bias_m).tolist()
        window = (x + lever.contact_x, y + lever.contact_y), LEVER_IMAGE_PIXELS, LEVER_CROP_WIDTH_M
        return Observation((x, y), camera.depth_crop(self.client, *window, lever.theta, samples=1))

    def depth_image(self) -> np.ndarray:
        """Depth [m] and mask (2, 48, 48) of the table around the object, the arm parked."""
        return self.observe().image

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
        self.placed.draw_outline(xy_m, rgb, yaw_rad, scale)

    def can_reach(
        self, primitive: Primitive, stop_phase: float = 1.0, at_xy_m: Sequence[float] | None = None
    ) -> bool:
        """Whether the arm can execute an action, with approach and way out; nothing moves.

        at_xy_m: where the object is (default: where it is observed, and the action adapted to it).
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
        """Execute a step of a plan, with approach: its decoded path if it has one."""
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
        """Execute a primitive on the object up to a phase, and record what happens.

        approach: the arm moves there and back home through the air, and the table brakes what
        rolls before and after; otherwise it is put at the start of the path, and away in the end.
        The effect is recorded at 301 phases in [0, stop_phase]. A partial action is the prefix of
        the path, re-timed to its own smooth stop, or with smooth=False stopped abruptly.
        Raises UnreachableError out of the arm's reach, or returns, with record_unreachable=True,
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
        """Move the gripper along a path (n, 2) [m] relative to the object, and record.

        Height and timing are those of the primitive (default: a push), up to stop_phase; the
        fingers face where the path leads.
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
                f"primitive {primitive.name!r} needs the tool {primitive.tool!r}, and the arm "
                f"holds the {self.arm.tool}; call place(..., tool={primitive.tool!r})"
            )
