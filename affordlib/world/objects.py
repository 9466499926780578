"""Objects on the table, one class per category; their PyBullet bodies; the world's parameters.

A category is a frozen dataclass of dimensions. The frame of a body has its origin in the object's
centre and z upwards when the object is placed; the x axis of a lying cylinder is its own axis.
Obstacles are fixed bodies that object and arm can touch. The robot knows where they are; its depth
cameras do not see them.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import partial
from typing import Any, ClassVar, Self

import numpy as np
import pybullet
from numpy.random import Generator
from pybullet_utils.bullet_client import BulletClient
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from affordlib.geometry import centroid, circle, edge_normals, extruded, is_convex, rectangle
from affordlib.types import (
    Checked,
    Obstacle,
    check_array,
    check_choice,
    check_within,
    number,
    on_table,
    parameter,
    point,
)
from affordlib.world.camera import CAMERAS, HIDDEN_M

Range = tuple[float, float]
SIZE_RANGE_M = (0.04, 0.08)
LARGEST_M = 0.3
N_EDGES = (3, 8)
CHAMFER_M = (0.006, 0.004)  # width and height around a prism's base: a blade can slide under it
HULL_MARGIN_M = 0.001  # by which PyBullet's collision shape of a convex hull exceeds its corners
_UPRIGHT = math.cos(math.radians(45))


@dataclass(frozen=True)
class TabletopObject(ABC):
    """An object on the table; all its fields are lengths [m]."""

    category: ClassVar[str]
    rollable: ClassVar[bool] = False  # whether it can roll as it is placed
    stable: ClassVar[bool] = False  # whether it stays upright when pushed, whatever its dimensions
    has_yaw: ClassVar[bool] = True  # whether its yaw can be seen
    volume_m3: ClassVar[property]
    footprint_m: ClassVar[property]  # corners (n, 2) of its outline from above, at yaw 0

    def __post_init__(self) -> None:
        self._check_lengths(*(field.name for field in fields(self)))

    def _check_lengths(self, *names: str) -> None:
        for name in names:
            about = f"{type(self).__name__}.{name}", getattr(self, name)
            object.__setattr__(self, name, check_within(*about, 0.005, LARGEST_M, "m"))

    @classmethod
    def sample(
        cls, rng: Generator, size_range_m: Range = SIZE_RANGE_M, height_range_m: Range | None = None
    ) -> Self:
        """Sample dimensions uniformly in size_range_m, heights in height_range_m if given."""
        sizes = rng.uniform(*size_range_m, size=len(fields(cls)))
        if height_range_m is not None:
            low, high = size_range_m
            share = (sizes[-1] - low) / max(high - low, 1e-9)
            sizes[-1] = height_range_m[0] + share * (height_range_m[1] - height_range_m[0])
        return cls(*(float(size) for size in sizes))

    height_m = property(lambda self: self.height)

    @abstractmethod
    def shape(self) -> dict[str, Any]:
        """Arguments for PyBullet; `frame`: rotation, `seen`: corners of parts for rendering."""

    def fallen(self, upward: np.ndarray) -> bool:
        """Return whether it fell over; upward: (3,), vertical components of its x, y, z axes."""
        return not self.rolls(upward) if self.rollable else bool(upward[2] < _UPRIGHT)

    def rolls(self, upward: np.ndarray) -> bool:
        """Return whether it can roll in its current orientation."""
        return self.rollable


@dataclass(frozen=True)
class Cuboid(TabletopObject):
    """A box with edges `length`, `width` and `height` [m], standing on its base."""

    length: float
    width: float
    height: float

    category = "cuboid"
    stable = True
    volume_m3 = property(lambda self: self.length * self.width * self.height)
    footprint_m = property(lambda self: rectangle((self.length, self.width)))

    def shape(self) -> dict[str, Any]:
        half = [self.length / 2, self.width / 2, self.height / 2]
        return {"shapeType": pybullet.GEOM_BOX, "halfExtents": half}


def _cylinder(diameter: float, length: float) -> dict[str, Any]:
    return {"shapeType": pybullet.GEOM_CYLINDER, "radius": diameter / 2, "height": length}


@dataclass(frozen=True)
class UprightCylinder(TabletopObject):
    """A cylinder of the given `diameter` and `height` [m], standing on its round base."""

    diameter: float
    height: float

    category = "upright_cylinder"
    stable = True
    has_yaw = False
    volume_m3 = property(lambda self: math.pi * self.diameter**2 / 4 * self.height)
    footprint_m = property(lambda self: circle(self.diameter / 2, 36))

    def shape(self) -> dict[str, Any]:
        return _cylinder(self.diameter, self.height)

    def rolls(self, upward: np.ndarray) -> bool:
        return bool(abs(upward[2]) < _UPRIGHT)


@dataclass(frozen=True)
class LyingCylinder(TabletopObject):
    """A cylinder of the given `length` and `diameter` [m], lying on its side."""

    length: float
    diameter: float

    category = "lying_cylinder"
    rollable = True
    height_m = property(lambda self: self.diameter)
    volume_m3 = property(lambda self: math.pi * self.diameter**2 / 4 * self.length)
    footprint_m = property(lambda self: rectangle((self.length, self.diameter)))

    def shape(self) -> dict[str, Any]:
        frame = pybullet.getQuaternionFromEuler((0, math.pi / 2, 0))
        return _cylinder(self.diameter, self.length) | {"frame": frame}

    def rolls(self, upward: np.ndarray) -> bool:
        return bool(abs(upward[0]) < _UPRIGHT)


@dataclass(frozen=True)
class Sphere(TabletopObject):
    """A ball of the given `diameter` [m]."""

    diameter: float

    category = "sphere"
    rollable = True
    has_yaw = False
    height_m = property(lambda self: self.diameter)
    volume_m3 = property(lambda self: math.pi * self.diameter**3 / 6)
    footprint_m = property(lambda self: circle(self.diameter / 2, 36))

    def shape(self) -> dict[str, Any]:
        return {"shapeType": pybullet.GEOM_SPHERE, "radius": self.diameter / 2}


@dataclass(frozen=True)
class Prism(TabletopObject):
    """An extruded convex polygon: `corners` (x, y) [m] counter-clockwise, and a `height` [m].

    Corners are shifted so that their centroid is the origin; all edges of the base are chamfered.
    """

    corners: tuple[tuple[float, float], ...]
    height: float

    category = "prism"

    def __post_init__(self) -> None:
        self._check_lengths("height")
        corners = check_array("prism corners", self.corners, 2)
        if corners.ndim != 2 or not N_EDGES[0] <= len(corners) <= N_EDGES[1]:
            raise ValueError(f"prism corners must be 3 to 8 points (x, y), got {corners.shape}")
        if not is_convex(corners) or np.abs(corners).max() > LARGEST_M:
            raise ValueError(
                "prism corners must go counter-clockwise around a convex polygon of at most "
                f"{LARGEST_M:g} m, got {self.corners!r}"
            )
        centred = tuple(map(tuple, (corners - centroid(corners)).tolist()))
        object.__setattr__(self, "corners", centred)

    @classmethod
    def sample(
        cls, rng: Generator, size_range_m: Range = SIZE_RANGE_M, height_range_m: Range | None = None
    ) -> Self:
        """Sample a polygon of 3 to 8 edges with corners on a circle of the sampled diameter."""
        n = int(rng.integers(N_EDGES[0], N_EDGES[1] + 1))
        angle = (np.arange(n) + rng.uniform(-0.3, 0.3, size=n)) * 2 * math.pi / n
        radius = rng.uniform(*size_range_m) / 2
        corners = radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        height = rng.uniform(*(height_range_m or size_range_m))
        return cls(tuple(map(tuple, corners.tolist())), float(height))

    volume_m3 = property(lambda self: float(ConvexHull(self._vertices()).volume))
    footprint_m = property(lambda self: np.array(self.corners))

    def _vertices(self, inset_m: float = 0.0) -> np.ndarray:
        """Return the corners (3n, 3) [m] of top, upper rim of the chamfer and base.

        inset_m: approximate distance by which all faces are moved inwards.
        """
        inradius = -ConvexHull(self.footprint_m).equations[:, 2].max()
        width, rise = np.minimum(CHAMFER_M, self.height / 3)
        half = self.height / 2
        outline = self.footprint_m * (1 - inset_m / inradius)
        base = self.footprint_m * (1 - inset_m / inradius - min(width / inradius, 0.5))
        levels = (outline, half - inset_m), (outline, rise - half), (base, inset_m - half)
        return np.vstack([np.insert(points, 2, z, axis=1) for points, z in levels])

    def shape(self) -> dict[str, Any]:
        felt = self._vertices(HULL_MARGIN_M).tolist()
        return {"shapeType": pybullet.GEOM_MESH, "vertices": felt, "seen": [self._vertices()]}


CATEGORIES: dict[str, type[TabletopObject]] = {
    kind.category: kind for kind in (Cuboid, UprightCylinder, LyingCylinder, Sphere, Prism)
}

STANDING = tuple(name for name, kind in CATEGORIES.items() if kind.stable)
ROLLABLE = tuple(name for name, kind in CATEGORIES.items() if kind.rollable)


def category_named(name: str) -> type[TabletopObject]:
    """Return the class of the object category `name`; raises ValueError with the known names."""
    return CATEGORIES[check_choice("object category", name, CATEGORIES)]


@dataclass(frozen=True)
class WorldConfig(Checked):
    """Physical parameters and sensor model; Bullet multiplies the frictions of two bodies."""

    table_friction: float = number(0.01, 2.0, default=0.5)
    object_friction: float = number(0.01, 2.0, default=0.5)
    finger_friction: float = number(0.01, 2.0, default=0.9)
    density_kg_m3: float = number(50.0, 10_000.0, "kg/m³", 600.0)
    com_offset_m: tuple[float, float, float] = point(3, 0.1, (0.0, 0.0, 0.0))  # of mass
    tip_offset_m: float = number(-0.008, 0.1, "m", 0.0)  # of the gripper's height, upwards
    camera: str = parameter(partial(check_choice, known=CAMERAS), "ideal")
    bias_m: tuple[float, float] = point(2, 0.1, (0.0, 0.0))  # of the object's estimated position
    noise_seed: int = 0  # of the camera


ROLLING_M, BRAKED_ROLLING_M = 1e-4, 1e-3
"""Rolling friction [m] of all bodies, and of a rollable object while no action is executed.

Bullet multiplies each by the other body's lateral friction, which gives 0.1 and 0.55 mm in total.
"""


def poses(states: np.ndarray) -> np.ndarray:
    """Convert states (n, 7), position and quaternion, to absolute `EFFECT_CHANNELS` (n, 5).

    Yaw is the heading of the body's x axis (of its y axis where x is vertical), unwrapped.
    """
    x, y, z, w = states[:, 3:].T
    ax = np.stack([1 - 2 * (y * y + z * z), 2 * (x * y + z * w)], axis=1)
    ay = np.stack([2 * (x * y - z * w), 1 - 2 * (x * x + z * z)], axis=1)
    yaw = np.arctan2(ax[:, 1], ax[:, 0])
    lying = np.hypot(*ax.T) < 0.5
    yaw = np.where(lying, np.arctan2(-ay[:, 0], ay[:, 1]), yaw)
    tilt = np.arccos(np.clip(1 - 2 * (x * x + y * y), -1.0, 1.0))
    return np.column_stack([states[:, :3], np.unwrap(yaw), tilt])


def set_friction(client: BulletClient, body: int, link: int, lateral: float, **more: float) -> None:
    """Set a link's lateral friction, and the contact parameters common to all bodies."""
    common = {"spinningFriction": 1e-3, "rollingFriction": ROLLING_M, "restitution": 0.0}
    client.changeDynamics(body, link, lateralFriction=lateral, **common, **more)


class PlacedObject:
    """An object placed on the table of a client at a pose: x, y [m] and a yaw [rad]."""

    def __init__(
        self, client: BulletClient, obj: TabletopObject, config: WorldConfig, pose: Sequence[float]
    ) -> None:
        x_m, y_m, yaw_rad = pose
        self.client, self.obj = client, obj
        self._centre_of_mass_m = np.array(config.com_offset_m)
        shape = obj.shape()
        frame, felt = shape.pop("frame", (0, 0, 0, 1)), shape.get("vertices")
        visual = mesh(shape.pop("seen", [felt])) if felt or "seen" in shape else dict(shape)
        if "height" in visual:
            visual["length"] = visual.pop("height")
        self.body = client.createMultiBody(
            baseMass=config.density_kg_m3 * obj.volume_m3,
            baseCollisionShapeIndex=client.createCollisionShape(
                **shape, collisionFrameOrientation=frame
            ),
            baseVisualShapeIndex=client.createVisualShape(
                **visual, visualFrameOrientation=frame, rgbaColor=(0.0, 0.62, 0.45, 1)
            ),
            baseInertialFramePosition=config.com_offset_m,
        )
        undamped = {"linearDamping": 0.0, "angularDamping": 0.0}
        set_friction(client, self.body, -1, config.object_friction, **undamped)
        c, s, (x, y, z) = math.cos(yaw_rad), math.sin(yaw_rad), config.com_offset_m
        position = (x_m + c * x - s * y, y_m + s * x + c * y, obj.height_m / 2 + z)
        orientation = pybullet.getQuaternionFromEuler((0, 0, yaw_rad))
        client.resetBasePositionAndOrientation(self.body, position, orientation)

    def states_of_centre(self, states: np.ndarray) -> np.ndarray:
        """Convert states (n, 7) of the centre of mass to those of the object's centre."""
        shift = Rotation.from_quat(states[:, 3:]).apply(self._centre_of_mass_m)
        return np.column_stack([states[:, :3] - shift, states[:, 3:]])

    def state(self) -> tuple[float, ...]:
        """Return position (x, y, z) [m] of the centre and quaternion (x, y, z, w)."""
        position, quaternion = self.client.getBasePositionAndOrientation(self.body)
        return tuple(self.states_of_centre(np.array([[*position, *quaternion]]))[0])

    def pose(self) -> tuple[float, float, float]:
        """Return (x, y) [m] and yaw [rad] in the table's frame."""
        x, y, _, yaw, _ = poses(np.array([self.state()]))[0].tolist()
        return x, y, yaw

    def _upward(self) -> np.ndarray:
        return Rotation.from_quat(self.state()[3:]).as_matrix()[2]

    def fell(self) -> bool:
        """Return whether the object fell over since it was placed."""
        return self.obj.fallen(self._upward())

    def rolls(self) -> bool:
        """Return whether the object can roll in its current orientation."""
        return self.obj.rolls(self._upward())

    def left_table(self) -> bool:
        """Return whether the object's centre is no longer above the table."""
        x, y, z = self.state()[:3]
        return not (z > 0 and on_table(np.array([x, y])))

    def brake(self, brakes: bool) -> None:
        """Set high rolling friction if the object can roll (Bullet accelerates it), or reset it."""
        rolling = BRAKED_ROLLING_M if brakes and self.rolls() else ROLLING_M
        self.client.changeDynamics(self.body, -1, rollingFriction=rolling)

    def displace(self, dx_m: float, dy_m: float, dyaw_rad: float) -> None:
        """Translate the object by (dx, dy) [m] and rotate it about the vertical by dyaw_rad."""
        centre, turn = np.array(self.state()[:3]), Rotation.from_euler("z", dyaw_rad)
        position, quaternion = self.client.getBasePositionAndOrientation(self.body)
        position = turn.apply(position - centre) + np.add(centre, (dx_m, dy_m, 0.0))
        orientation = (turn * Rotation.from_quat(quaternion)).as_quat()
        self.client.resetBasePositionAndOrientation(self.body, position, orientation)


def mesh(parts: list) -> dict[str, Any]:
    """Return the convex hulls of the corners (n, 3) of parts as triangles for the renderer."""
    hulls = [ConvexHull(part) for part in parts]
    triangles = np.concatenate([hull.points[hull.simplices] for hull in hulls])
    normals = np.concatenate([hull.equations[:, :3] for hull in hulls])
    facing = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    inward = (facing * normals).sum(axis=1) < 0
    triangles[inward] = triangles[inward, ::-1]
    return {
        "shapeType": pybullet.GEOM_MESH,
        "vertices": triangles.reshape(-1, 3).tolist(),
        "indices": list(range(3 * len(triangles))),
        "normals": np.repeat(normals, 3, axis=0).tolist(),
    }


class PlacedObstacles:
    """The obstacles in a client, with the lateral friction of the table.

    shown: ids of the bodies in pictures; touched: numbers of the obstacles that were touched so
    far, each with "object" or "arm".
    """

    def __init__(
        self, client: BulletClient, obstacles: Sequence[Obstacle], friction: float
    ) -> None:
        self.client, self.all = client, tuple(obstacles)
        self.shown: list[int] = []
        self.touched: set[tuple[int, str]] = set()
        self._felt: list[int] = []
        for one in self.all:
            felt, seen, at = _shapes(one)
            # Without a shape of its own to be seen, a body would be seen as what is felt.
            never = client.createVisualShape(**seen, visualFramePosition=(0, 0, -2 * HIDDEN_M))
            shape = client.createCollisionShape(**felt), never
            self._felt.append(client.createMultiBody(0, *shape, basePosition=at))
            set_friction(client, self._felt[-1], -1, friction)
            shown = client.createVisualShape(**seen, rgbaColor=(0.55, 0.45, 0.38, 1.0))
            at = {"basePosition": np.subtract(at, (0, 0, HIDDEN_M)).tolist()}
            self.shown.append(client.createMultiBody(baseVisualShapeIndex=shown, **at))

    def remove(self) -> None:
        """Remove the bodies from the client."""
        for body in (*self._felt, *self.shown):
            self.client.removeBody(body)

    def overlapping(self, body: int) -> list[int]:
        """Return the numbers of the obstacles that overlap a body."""
        close = self.client.getClosestPoints
        pairs = ((k, close(body, felt, 0.0)) for k, felt in enumerate(self._felt))
        return [k for k, points in pairs if any(point[8] < -1e-3 for point in points)]

    def feel(self, body: int, arm: int) -> None:
        """Note which obstacles the object's body and the arm touch at present."""
        for k, felt in enumerate(self._felt):
            for name, other in (("object", body), ("arm", arm)):
                contacts = self.client.getContactPoints(other, felt)
                if sum(contact[9] for contact in contacts) > 0.0:
                    self.touched.add((k, name))


def _shapes(one: Obstacle) -> tuple[dict[str, Any], dict[str, Any], tuple[float, ...]]:
    """Return arguments for PyBullet: the shape that is felt, the one seen, and their position."""
    if one.radius_m:
        disc = {"shapeType": pybullet.GEOM_CYLINDER, "radius": one.radius_m}
        at = (*one.corners_m[0], one.height_m / 2)
        return disc | {"height": one.height_m}, disc | {"length": one.height_m}, at
    corners = np.array(one.corners_m)
    outward = edge_normals(corners)
    before = np.roll(outward, 1, axis=0)
    inset = HULL_MARGIN_M / (1 + (outward * before).sum(axis=1, keepdims=True))
    inner = corners - inset * (outward + before)
    felt = extruded(inner, HULL_MARGIN_M, one.height_m - HULL_MARGIN_M).tolist()
    seen = mesh([extruded(corners, 0.0, one.height_m)])
    return {"shapeType": pybullet.GEOM_MESH, "vertices": felt}, seen, (0.0, 0.0, 0.0)
