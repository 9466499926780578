"""The tabletop: one PyBullet client with a table, the UR10, one object and the depth camera.

Use it as a context manager. The simulation is deterministic. With a four times finer time step and
twice the solver iterations, the final position of a push changes by 0.02 mm (median).
"""

import os
import weakref
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import replace
from typing import Any

import numpy as np
import pybullet
from pybullet_utils.bullet_client import BulletClient

from affordlib.geometry import extruded
from affordlib.perception import adapt_to_object
from affordlib.primitives import PUSH_GAP_M, LeverUp, Primitive, Push
from affordlib.types import (
    TABLE_X_M,
    TABLE_Y_M,
    Interaction,
    NothingSeenError,
    Observation,
    Obstacle,
    Step,
    UnreachableError,
    check_array,
    check_choice,
    check_count,
    check_finite,
    check_on_table,
    check_within,
)
from affordlib.world import robot
from affordlib.world.camera import CAMERAS, HIDDEN_M, View, add_scenery, depth_crop
from affordlib.world.execution import JointController, execute, put_down, unreached
from affordlib.world.objects import (
    PlacedObject,
    PlacedObstacles,
    TabletopObject,
    WorldConfig,
    mesh,
    set_friction,
)
from affordlib.world.trajectory import STEP_S, Command, plan_motion, segments_until

OBJECTS_PER_BUILD = 256  # after which the client is rebuilt: Bullet leaks 5 kB per removed object


class _Client(BulletClient):
    """A PyBullet client connected without options, because Bullet would print them."""

    def __init__(self) -> None:
        self._pid = os.getpid()
        self._client = pybullet.connect(pybullet.DIRECT)


class Tabletop(AbstractContextManager):
    """A table, an arm and at most one object, in a separate PyBullet client.

    on_step: called with the world after every step of the simulation; obstacles: those on the
    table, and which of them were touched.
    """

    def __init__(self, config: WorldConfig | None = None) -> None:
        self.config = config or WorldConfig()
        self._client: BulletClient | None = _Client()
        self.arm: JointController | None = None
        self.on_step: Callable[[Tabletop], None] | None = None
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
        self.arm.untie()
        for body in [client.getBodyUniqueId(k) for k in range(client.getNumBodies())]:
            if body not in (self._table, self.arm.robot, *self._scenery):
                client.removeBody(body)
        client.restoreState(stateId=self._fresh)
        self._placed: PlacedObject | None = None
        self.obstacles = PlacedObstacles(client, (), 0.0)
        self._marks: list[int] = []
        self.noise = np.random.default_rng(self.config.noise_seed)
        set_friction(client, self._table, -1, self.config.table_friction)
        for name in ("left_finger", "right_finger", "blade", "rod"):
            if name in self.arm.links:
                finger = self.arm.robot, self.arm.links[name]
                set_friction(client, *finger, self.config.finger_friction)
        self.arm.put(robot.HOME, PUSH_GAP_M)

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
        half = [np.ptp(TABLE_X_M) / 2, np.ptp(TABLE_Y_M) / 2, 0.05]
        shape = {"shapeType": pybullet.GEOM_BOX, "halfExtents": half}
        self._table = client.createMultiBody(
            baseCollisionShapeIndex=client.createCollisionShape(**shape),
            baseVisualShapeIndex=client.createVisualShape(**shape, rgbaColor=(0.93, 0.90, 0.85, 1)),
            basePosition=(sum(TABLE_X_M) / 2, sum(TABLE_Y_M) / 2, -0.05),
        )
        world = weakref.proxy(self)  # a reference cycle would keep the client connected
        self.arm = JointController(client, tool, lambda: world._after_step())
        self._scenery = add_scenery(client)
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
        obstacles: Sequence[Obstacle] = (),
    ) -> None:
        """Clear the table, park the arm and place an object at (x, y) [m] with a yaw [rad].

        tool: "gripper", "screwdriver" or "rod"; config: new parameters (default: unchanged).
        """
        xy_m, yaw_rad = check_on_table("xy_m", xy_m), check_finite("yaw_rad", yaw_rad)
        self.config = config or self.config
        self.reset(check_choice("tool", tool, robot.TOOL_OFFSETS_M))
        self._n_placed += 1
        self._placed = PlacedObject(self.client, obj, self.config, (*xy_m, yaw_rad))
        self.set_obstacles(obstacles)

    def set_obstacles(self, obstacles: Sequence[Obstacle]) -> None:
        """Replace the obstacles on the table; raises ValueError if one lies on the object."""
        new = PlacedObstacles(self.client, obstacles, self.config.table_friction)
        if wrong := new.overlapping(self.placed.body):
            new.remove()
            x, y, _ = self.object_pose()
            raise ValueError(f"obstacles[{wrong[0]}] lies on the object at ({x:.3f}, {y:.3f}) m")
        self.obstacles.remove()
        self.obstacles = new
        self._n_placed += len(obstacles)

    def _after_step(self) -> None:
        if self.obstacles.all:
            self.obstacles.feel(self.placed.body, self.arm.robot)
        if self.on_step is not None:
            self.on_step(self)

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

    def shove(self, dx_m: float, dy_m: float, dyaw_rad: float = 0.0) -> None:
        """Displace, rotate and settle the object; ValueError if it would leave the table."""
        (x, y, _), turn = self.object_pose(), check_finite("dyaw_rad", dyaw_rad)
        to = x + check_finite("dx_m", dx_m), y + check_finite("dy_m", dy_m)
        check_on_table("dx_m, dy_m: the shoved object's centre", to)
        self.placed.displace(dx_m, dy_m, turn)
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

    def observe(self, lever: LeverUp | None = None) -> Observation:
        """Return the estimated position and image of the object; the arm must be parked.

        lever: the image (2, 128, 128) is around its contact, and the lever points right.
        """
        xy_m, bias_m = np.array(self.object_pose()[:2]), self.config.bias_m
        if lever is None:
            seen = CAMERAS[self.config.camera](self.client, xy_m, bias_m, self.noise)
            return replace(seen, obstacles=self.obstacles.all)
        check_choice("camera of a lever-up", self.config.camera, ("ideal",))
        x, y = (xy_m + bias_m).tolist()
        contact = x + lever.contact_x, y + lever.contact_y
        return Observation((x, y), depth_crop(self.client, *contact, lever.theta))

    def depth_image(self) -> np.ndarray:
        """Return depth [m] and mask (2, 48, 48) around the object; the arm must be parked."""
        return self.observe().image

    def picture(self, width: int = 320, height: int = 240, **view: Any) -> np.ndarray:
        """Render a colour picture (height, width, 3), uint8, of the robot and the table.

        view: fields of `affordlib.world.camera.View`; by default, the whole arm is in view.
        """
        hidden = [*self._scenery, *self.obstacles.shown, *self._marks]
        size = check_count("width", width, 16, 2048), check_count("height", height, 16, 2048)
        return View(**view).picture(self.client, hidden, *size)

    def mark(
        self,
        xy_m: Sequence[float],
        rgb: Sequence[float],
        yaw_rad: float = 0.0,
        scale: float = 1.0,
        height_m: float | None = None,
    ) -> None:
        """Draw the object's footprint at (x, y) [m], in a colour, unseen by the robot's camera.

        height_m: extrude it to a body of this height; by default it lies flat on the table.
        """
        xy_m, yaw_rad = check_on_table("xy_m", xy_m), check_finite("yaw_rad", yaw_rad)
        outline = check_within("scale", scale, 0.1, 10.0) * self.obj.footprint_m
        rgb = [check_within("rgb", share, 0.0, 1.0) for share in check_array("rgb", rgb, 3)]
        # Larger sheets lie lower, so that a larger one appears as a frame around a smaller one.
        top = 0.001 / scale if height_m is None else check_within("height_m", height_m, 0.0, 1.0)
        sheet = mesh([extruded(outline, -0.005, top)])
        shape = self.client.createVisualShape(**sheet, rgbaColor=(*rgb, 1))
        turn = pybullet.getQuaternionFromEuler((0, 0, yaw_rad))
        at = {"basePosition": (*xy_m, -HIDDEN_M), "baseOrientation": turn}
        self._marks.append(self.client.createMultiBody(baseVisualShapeIndex=shape, **at))

    def unmark(self) -> None:
        """Remove all marks."""
        while self._marks:
            self.client.removeBody(self._marks.pop())

    def can_reach(self, primitive: Primitive, stop_phase: float, at_xy_m: Sequence[float]) -> bool:
        """Return whether the arm can execute an action at (x, y) [m], with approach and retreat."""
        stop_phase = check_within("stop_phase", stop_phase, 0.0, 1.0)
        origin_m = *check_on_table("at_xy_m", at_xy_m), self.config.tip_offset_m
        try:
            plan_motion(primitive, segments_until(primitive, stop_phase), origin_m, approach=True)
        except UnreachableError:
            return False
        return True

    def execute(self, step: Step, seen: Observation | None = None) -> Interaction:
        """Execute a step of a plan, with approach, along its decoded path if it has one.

        seen: an observation of the object, to which the action is relative (default: a new one).
        """
        if step.path_xy_m is None:
            return self.execute_primitive(step.primitive, step.stop_phase, approach=True, seen=seen)
        command = Command.along(step.path_xy_m, step.primitive, step.stop_phase)
        return self._execute(command, seen or self.observe())

    def execute_primitive(
        self,
        primitive: Primitive,
        stop_phase: float = 1.0,
        *,
        approach: bool = False,
        record_unreachable: bool = False,
        seen: Observation | None = None,
    ) -> Interaction:
        """Execute a primitive on the object up to a phase, and record the effect at 301 phases.

        approach: the arm moves there and back home through the air, and rollable objects are braked
        before and after; otherwise it is placed at the start of the path, and finally at home.
        A partial action, a prefix of the path, is re-timed to a smooth stop. If the arm cannot
        reach, raises UnreachableError, or with record_unreachable returns an interaction in which
        nothing moved. seen: as in `execute`.
        """
        stop_phase = check_within("stop_phase", stop_phase, 0.0, 1.0)
        seen = seen or self.observe(primitive if isinstance(primitive, LeverUp) else None)
        command = Command.of(adapt_to_object(primitive, seen.image), stop_phase)
        try:
            return self._execute(command, seen, approach)
        except UnreachableError:
            if not record_unreachable:
                raise
            return unreached(command, self.placed, seen)

    def execute_path(self, path_xy_m: np.ndarray) -> Interaction:
        """Move the gripper along a path (n, 2) [m] relative to the object, and record the effect.

        Height and timing are those of a push. The gripper's yaw is the direction from the first to
        the last point.
        """
        path_xy_m = check_array("path_xy_m", path_xy_m, 2)
        return self._execute(Command.along(path_xy_m, Push(0.0), 1.0), self.observe())

    def _execute(self, command: Command, seen: Observation, approach: bool = True) -> Interaction:
        return execute(self.arm, self.placed, command, seen, self.config.tip_offset_m, approach)
