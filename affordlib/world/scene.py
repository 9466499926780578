"""The tabletop: one PyBullet client with a table, the UR10, one object and the depth camera.

Use it as a context manager; everything in it is deterministic. Settings were measured: against a
four times finer step with twice the solver's iterations a push ends within 0.02 mm (median).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import pybullet

from affordlib.primitives import PUSH_GAP_M, Push
from affordlib.types import (
    TABLE_X_M,
    TABLE_Y_M,
    Interaction,
    check_finite,
    check_on_table,
    check_within,
)
from affordlib.world import camera, motion, robot
from affordlib.world.objects import DENSITY_KG_M3, create_body, create_footprint

if TYPE_CHECKING:
    from affordlib.types import Step
    from affordlib.world.motion import Film
    from affordlib.world.objects import Cuboid, UprightCylinder

STEP_S = 1 / 240
N_SAMPLES = 301
"""Recorded samples over the phase: one every 3 simulation steps of a full push."""


@dataclass(frozen=True)
class WorldConfig:
    """Friction coefficients (Bullet multiplies the two bodies') and the object's density."""

    table_friction: float = 0.5
    object_friction: float = 0.5
    finger_friction: float = 0.9
    density_kg_m3: float = DENSITY_KG_M3

    def __post_init__(self) -> None:
        for name in ("table_friction", "object_friction", "finger_friction"):
            check_within(name, getattr(self, name), 0.01, 2.0)
        check_within("density_kg_m3", self.density_kg_m3, 50.0, 10_000.0, "kg/m³")


class Tabletop:
    """A table, an arm and at most one object, in a PyBullet client of its own."""

    def __init__(self, config: WorldConfig | None = None) -> None:
        self.config = config or WorldConfig()
        self.client = pybullet.connect(pybullet.DIRECT)
        self.thing: Cuboid | UprightCylinder | None = None
        self.film: Film | None = None
        self.reset()

    def __enter__(self) -> Tabletop:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Disconnect from PyBullet; the world cannot be used afterwards."""
        if self.client >= 0:
            pybullet.disconnect(self.client)
            self.client = -1

    def reset(self) -> None:
        """Clear the table and park the arm: the same world, bit for bit, every time."""
        client = self.client
        pybullet.resetSimulation(physicsClientId=client)
        pybullet.setGravity(0, 0, -9.81, physicsClientId=client)
        pybullet.setPhysicsEngineParameter(
            fixedTimeStep=STEP_S,
            numSolverIterations=50,
            restitutionVelocityThreshold=0.0,
            deterministicOverlappingPairs=1,
            physicsClientId=client,
        )
        self.thing, self.body = None, -1
        self._add_table()
        self.robot = robot.load_robot(client)
        self.joints = (*robot.ARM_JOINTS, *robot.finger_joints(client, self.robot))
        for finger in self.joints[-2:]:
            pybullet.changeDynamics(
                self.robot,
                finger,
                lateralFriction=self.config.finger_friction,
                spinningFriction=1e-3,
                rollingFriction=1e-3,
                restitution=0.0,
                physicsClientId=client,
            )
        motion.put_arm(self, np.array(robot.HOME), PUSH_GAP_M)

    def _add_table(self) -> None:
        half = [(TABLE_X_M[1] - TABLE_X_M[0]) / 2, (TABLE_Y_M[1] - TABLE_Y_M[0]) / 2, 0.05]
        shape = {"shapeType": pybullet.GEOM_BOX, "halfExtents": half}
        self.table = pybullet.createMultiBody(
            baseCollisionShapeIndex=pybullet.createCollisionShape(
                **shape, physicsClientId=self.client
            ),
            baseVisualShapeIndex=pybullet.createVisualShape(
                **shape, rgbaColor=(0.93, 0.90, 0.85, 1), physicsClientId=self.client
            ),
            basePosition=(sum(TABLE_X_M) / 2, sum(TABLE_Y_M) / 2, -0.05),
            physicsClientId=self.client,
        )
        pybullet.changeDynamics(
            self.table,
            -1,
            lateralFriction=self.config.table_friction,
            spinningFriction=1e-3,
            rollingFriction=1e-3,
            restitution=0.0,
            physicsClientId=self.client,
        )

    def place(
        self,
        thing: Cuboid | UprightCylinder,
        xy_m: tuple[float, float] = (0.0, 0.0),
        yaw_rad: float = 0.0,
    ) -> None:
        """Clear the table, park the arm and stand an object at (x, y) [m], turned by a yaw."""
        x, y = check_on_table("xy_m", xy_m)
        yaw = check_finite("yaw_rad", yaw_rad)
        self.reset()
        mass = self.config.density_kg_m3 * thing.volume_m3
        self.thing, self.body = thing, create_body(self.client, thing, mass, (0.0, 0.62, 0.45, 1))
        pybullet.changeDynamics(
            self.body,
            -1,
            lateralFriction=self.config.object_friction,
            spinningFriction=1e-3,
            rollingFriction=1e-3,
            restitution=0.0,
            linearDamping=0.0,
            angularDamping=0.0,
            physicsClientId=self.client,
        )
        pybullet.resetBasePositionAndOrientation(
            self.body,
            (x, y, thing.height_m / 2),
            pybullet.getQuaternionFromEuler((0, 0, yaw)),
            physicsClientId=self.client,
        )

    def _require_object(self) -> None:
        if self.thing is None:
            raise RuntimeError("there is no object on the table; call place(...) first")

    def object_state(self) -> tuple[float, ...]:
        """Position (x, y, z) [m] and quaternion (x, y, z, w) of the object, seven numbers."""
        self._require_object()
        position, quaternion = pybullet.getBasePositionAndOrientation(self.body, self.client)
        return (*position, *quaternion)

    def object_pose(self) -> tuple[float, float, float]:
        """The object's (x, y) [m] and yaw [rad] in the frame of the table."""
        x, y, _, yaw, _ = motion.poses(np.array([self.object_state()]))[0]
        return float(x), float(y), float(yaw)

    def object_tilt_rad(self) -> float:
        """Angle between the object's own upright axis and the vertical [rad]."""
        return float(motion.poses(np.array([self.object_state()]))[0, 4])

    def look(self) -> np.ndarray:
        """Depth [m] and mask (2, 48, 48) of the table around the object, the arm parked."""
        self._require_object()
        return camera.depth_crop(self.client, self.object_pose()[:2])

    def picture(self, width: int = 320, height: int = 240) -> np.ndarray:
        """A colour picture (height, width, 3), uint8, of the robot at work, for people."""
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
        create_footprint(self.client, self.thing, (x, y), yaw_rad, (*rgb, 1.0), scale)

    def interact(
        self, primitive: Push, stop_phase: float = 1.0, *, approach: bool = False
    ) -> Interaction:
        """Execute a primitive on the object up to a phase, and record what happens.

        approach=False puts the arm at the start of the path (collecting experience);
        approach=True moves it there through the air and back home (carrying out a plan).
        The effect is recorded at `N_SAMPLES` phases in [0, stop_phase]. A partial action is the
        prefix of the path, re-timed to its own smooth stop.
        Raises UnreachableError when the arm cannot follow the path.
        """
        check_within("stop_phase", stop_phase, 0.0, 1.0)
        phase = np.linspace(0.0, 1.0, N_SAMPLES) * stop_phase
        return motion.execute(self, primitive, primitive.path(phase), phase, approach)

    def follow(self, step: Step) -> Interaction:
        """Carry out a step of a plan, with approach: its decoded path if it has one."""
        if step.path_xy_m is None:
            return self.interact(step.primitive, step.stop_phase, approach=True)
        return self.follow_path(step.path_xy_m, step.primitive, step.stop_phase)

    def follow_path(
        self, path_xy_m: np.ndarray, primitive: Push | None = None, stop_phase: float = 1.0
    ) -> Interaction:
        """Move the gripper along a path (n, 2) [m] relative to the object, and record.

        Height and timing are those of the primitive (default: a push), up to stop_phase; the
        fingers face where the path leads.
        """
        path = np.asarray(path_xy_m, dtype=float)
        if path.ndim != 2 or path.shape[1] != 2 or len(path) < 2 or not np.isfinite(path).all():
            raise ValueError(f"path_xy_m must be finite points (n, 2), n ≥ 2, got {path.shape}")
        primitive = primitive or Push(0.0)
        phase = np.linspace(0.0, 1.0, len(path)) * check_within("stop_phase", stop_phase, 0.0, 1.0)
        action = primitive.path(phase)
        action[:, :2] = path
        heading = path[-1] - path[0]
        if np.hypot(*heading) > 1e-6:
            action[:, 3] = math.atan2(heading[1], heading[0])
        return motion.execute(self, primitive, action, phase, approach=True)
