"""Objects on the table, one class per category; their PyBullet bodies; the world's parameters.

A category is a frozen dataclass of dimensions. The frame of a body has its origin in the object's
centre and z upwards when the object is placed; the x axis of a lying cylinder is its own axis.
"""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass, fields
from typing import Any, ClassVar, Self

import numpy as np
import pybullet
from pybullet_utils.bullet_client import BulletClient
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from affordlib.geometry import cross, rotated
from affordlib.types import (
    TABLE_X_M,
    TABLE_Y_M,
    check_array,
    check_choice,
    check_field,
    check_finite,
    check_on_table,
    check_within,
)

DENSITY_KG_M3 = 600.0
SIZE_RANGE_M = (0.04, 0.08)
LARGEST_M = 0.3
N_EDGES = (3, 8)
CHAMFER_M = (0.006, 0.004)
"""Width and height [m] of the chamfer around a prism's base, under which a blade can slide."""

_HULL_MARGIN_M = 0.001
"""Margin [m] by which PyBullet's collision shape of a convex hull exceeds its corners."""

_UPRIGHT = math.cos(math.radians(45))


@dataclass(frozen=True)
class TabletopObject(ABC):
    """An object on the table; all its fields are lengths [m].

    rollable: whether it can roll as it is placed; footprint_m: corners (n, 2) [m] of its outline
    seen from above, relative to its centre, at yaw 0.
    """

    category: ClassVar[str]
    rollable: ClassVar[bool] = False
    volume_m3: ClassVar[float]
    footprint_m: ClassVar[np.ndarray]

    def __post_init__(self) -> None:
        for field in fields(self):
            check_field(self, field.name, 0.005, LARGEST_M, "m")

    @classmethod
    def sample(
        cls,
        rng: np.random.Generator,
        size_range_m: tuple[float, float] = SIZE_RANGE_M,
        height_range_m: tuple[float, float] | None = None,
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
        return bool(upward[2] < _UPRIGHT)

    def rolls(self, upward: np.ndarray) -> bool:
        """Return whether it can roll in its current orientation."""
        return self.rollable


def _circle(diameter: float) -> np.ndarray:
    angle = np.linspace(0, 2 * math.pi, 36, endpoint=False)
    return diameter / 2 * np.stack([np.cos(angle), np.sin(angle)], axis=1)


def _rectangle(length: float, width: float) -> np.ndarray:
    return np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * np.array([length / 2, width / 2])


@dataclass(frozen=True)
class Cuboid(TabletopObject):
    """A box with edges `length`, `width` and `height` [m], standing on its base."""

    length: float
    width: float
    height: float

    category = "cuboid"
    volume_m3 = property(lambda self: self.length * self.width * self.height)
    footprint_m = property(lambda self: _rectangle(self.length, self.width))

    def shape(self) -> dict[str, Any]:
        half = [self.length / 2, self.width / 2, self.height / 2]
        return {"shapeType": pybullet.GEOM_BOX, "halfExtents": half}


class _Cylinder(TabletopObject):
    """A cylinder about the x axis (0) or the z axis (2) of its body."""

    axis: ClassVar[int]

    _length_m = property(lambda self: self.length if self.axis == 0 else self.height)
    volume_m3 = property(lambda self: math.pi * self.diameter**2 / 4 * self._length_m)

    def shape(self) -> dict[str, Any]:
        return {
            "shapeType": pybullet.GEOM_CYLINDER,
            "radius": self.diameter / 2,
            "height": self._length_m,
            "frame": pybullet.getQuaternionFromEuler((0, math.pi / 2 * (self.axis == 0), 0)),
        }

    def rolls(self, upward: np.ndarray) -> bool:
        return bool(abs(upward[self.axis]) < _UPRIGHT)


@dataclass(frozen=True)
class UprightCylinder(_Cylinder):
    """A cylinder of the given `diameter` and `height` [m], standing on its round base."""

    diameter: float
    height: float

    category = "upright_cylinder"
    axis = 2
    footprint_m = property(lambda self: _circle(self.diameter))


@dataclass(frozen=True)
class LyingCylinder(_Cylinder):
    """A cylinder of the given `length` and `diameter` [m], lying on its side."""

    length: float
    diameter: float

    category = "lying_cylinder"
    rollable = True
    axis = 0
    height_m = property(lambda self: self.diameter)
    footprint_m = property(lambda self: _rectangle(self.length, self.diameter))

    def fallen(self, upward: np.ndarray) -> bool:
        return not self.rolls(upward)


@dataclass(frozen=True)
class Sphere(TabletopObject):
    """A ball of the given `diameter` [m]."""

    diameter: float

    category = "sphere"
    rollable = True
    height_m = property(lambda self: self.diameter)
    volume_m3 = property(lambda self: math.pi * self.diameter**3 / 6)
    footprint_m = property(lambda self: _circle(self.diameter))

    def shape(self) -> dict[str, Any]:
        return {"shapeType": pybullet.GEOM_SPHERE, "radius": self.diameter / 2}

    def fallen(self, upward: np.ndarray) -> bool:
        return False


@dataclass(frozen=True)
class Prism(TabletopObject):
    """An extruded convex polygon: `corners` (x, y) [m] counter-clockwise, and a `height` [m].

    Corners are shifted so that their centroid is the origin; all edges of the base are chamfered.
    """

    corners: tuple[tuple[float, float], ...]
    height: float

    category = "prism"

    def __post_init__(self) -> None:
        check_field(self, "height", 0.005, LARGEST_M, "m")
        corners = check_array("prism corners", self.corners, 2)
        if corners.ndim != 2 or not N_EDGES[0] <= len(corners) <= N_EDGES[1]:
            raise ValueError(f"prism corners must be 3 to 8 points (x, y), got {corners.shape}")
        following = np.roll(corners, -1, axis=0)
        edges = following - corners
        turns = cross(edges, np.roll(edges, -1, axis=0))
        inner = np.sum(edges * np.roll(edges, -1, axis=0), axis=1)
        rounds = np.arctan2(turns, inner).sum() / (2 * math.pi)  # 1 for convex, 2 for a star
        if (turns <= 0).any() or rounds > 1.5 or np.abs(corners).max() > LARGEST_M:
            raise ValueError(
                "prism corners must go counter-clockwise around a convex polygon of at most "
                f"{LARGEST_M:g} m, got {self.corners!r}"
            )
        doubled = cross(corners, following)
        centroid = ((corners + following) * doubled[:, None]).sum(axis=0) / (3 * doubled.sum())
        centred = tuple((float(x), float(y)) for x, y in corners - centroid)
        object.__setattr__(self, "corners", centred)

    @classmethod
    def sample(
        cls,
        rng: np.random.Generator,
        size_range_m: tuple[float, float] = SIZE_RANGE_M,
        height_range_m: tuple[float, float] | None = None,
    ) -> Self:
        """Sample a polygon of 3 to 8 edges with corners on a circle of the sampled diameter."""
        n = int(rng.integers(N_EDGES[0], N_EDGES[1] + 1))
        angle = (np.arange(n) + rng.uniform(-0.3, 0.3, size=n)) * 2 * math.pi / n
        radius = rng.uniform(*size_range_m) / 2
        corners = radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        height = rng.uniform(*(height_range_m or size_range_m))
        return cls(tuple((float(x), float(y)) for x, y in corners), float(height))

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
        felt = self._vertices(_HULL_MARGIN_M).tolist()
        return {"shapeType": pybullet.GEOM_MESH, "vertices": felt, "seen": [self._vertices()]}


CATEGORIES: dict[str, type[TabletopObject]] = {
    kind.category: kind for kind in (Cuboid, UprightCylinder, LyingCylinder, Sphere, Prism)
}


def category_named(name: str) -> type[TabletopObject]:
    """Return the class of the object category `name`; raises ValueError with the known names."""
    return CATEGORIES[check_choice("object category", name, CATEGORIES)]


CAMERAS = ("ideal", "kinect")


@dataclass(frozen=True)
class WorldConfig:
    """Physical parameters and sensor model of the world; Bullet multiplies two bodies' frictions.

    com_offset_m: centre of mass in the object's frame; tip_offset_m: error of the gripper's height,
    positive upwards; bias_m: error added to the object's estimated position. camera: "ideal"
    returns the exact position, "kinect" measures it with noise generated from noise_seed.
    """

    table_friction: float = 0.5
    object_friction: float = 0.5
    finger_friction: float = 0.9
    density_kg_m3: float = DENSITY_KG_M3
    com_offset_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    tip_offset_m: float = 0.0
    camera: str = "ideal"
    bias_m: tuple[float, float] = (0.0, 0.0)
    noise_seed: int = 0

    def __post_init__(self) -> None:
        for name in ("table_friction", "object_friction", "finger_friction"):
            check_field(self, name, 0.01, 2.0)
        check_field(self, "density_kg_m3", 50.0, 10_000.0, "kg/m³")
        check_field(self, "tip_offset_m", -0.008, 0.1, "m")
        for name, size in (("com_offset_m", 3), ("bias_m", 2)):
            values = tuple(check_within(name, v, -0.1, 0.1, "m") for v in getattr(self, name))
            if len(values) != size:
                raise ValueError(f"{name} must be {size} numbers [m], got {values!r}")
            object.__setattr__(self, name, values)
        check_choice("camera", self.camera, CAMERAS)


ROLLING_M, BRAKED_ROLLING_M = 1e-4, 1e-3
"""Rolling friction [m] of all bodies, and of a rollable object while no action is executed.

Bullet multiplies each by the other body's lateral friction, which gives 0.1 and 0.55 mm in total.
"""

_TOPPLING = 1.5
"""Factor on the energy that tips an object onto its edge, since sliding dissipates some of it."""


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
    """An object placed on the table of a client, at (x, y) [m] and a yaw [rad]."""

    def __init__(
        self,
        client: BulletClient,
        obj: TabletopObject,
        config: WorldConfig,
        xy_m: tuple,
        yaw_rad: float,
    ) -> None:
        self.client, self.obj = client, obj
        self._centre_of_mass_m = np.array(config.com_offset_m)
        shape = obj.shape()
        frame, felt = shape.pop("frame", (0, 0, 0, 1)), shape.get("vertices")
        visual = _mesh(shape.pop("seen", [felt])) if felt or "seen" in shape else dict(shape)
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
        position = (xy_m[0] + c * x - s * y, xy_m[1] + s * x + c * y, obj.height_m / 2 + z)
        orientation = pybullet.getQuaternionFromEuler((0, 0, yaw_rad))
        client.resetBasePositionAndOrientation(self.body, position, orientation)

    def states_of_centre(self, states: np.ndarray) -> np.ndarray:
        """Convert states (n, 7) of the centre of mass to those of the object's centre."""
        if not self._centre_of_mass_m.any():
            return states
        shift = Rotation.from_quat(states[:, 3:]).apply(self._centre_of_mass_m)
        return np.column_stack([states[:, :3] - shift, states[:, 3:]])

    def state(self) -> tuple[float, ...]:
        """Return position (x, y, z) [m] of the centre and quaternion (x, y, z, w)."""
        position, quaternion = self.client.getBasePositionAndOrientation(self.body)
        return tuple(self.states_of_centre(np.array([[*position, *quaternion]]))[0])

    def pose(self) -> tuple[float, float, float]:
        """Return (x, y) [m] and yaw [rad] in the table's frame."""
        x, y, _, yaw, _ = poses(np.array([self.state()]))[0]
        return float(x), float(y), float(yaw)

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
        inside = TABLE_X_M[0] <= x <= TABLE_X_M[1] and TABLE_Y_M[0] <= y <= TABLE_Y_M[1]
        return not (z > 0 and inside)

    def brake(self, brakes: bool) -> None:
        """Set high rolling friction if the object can roll (Bullet accelerates it), or reset it."""
        rolling = BRAKED_ROLLING_M if brakes and self.rolls() else ROLLING_M
        self.client.changeDynamics(self.body, -1, rollingFriction=rolling)

    def displace(self, dx_m: float, dy_m: float, dyaw_rad: float) -> None:
        """Translate the object by (dx, dy) [m] and rotate it about the vertical by dyaw_rad.

        Raises ValueError, without moving it, if its centre would leave the table.
        """
        x, y, *_ = centre = np.array(self.state()[:3])
        dx, dy = check_finite("dx_m", dx_m), check_finite("dy_m", dy_m)
        turn = Rotation.from_euler("z", check_finite("dyaw_rad", dyaw_rad))
        check_on_table("dx_m, dy_m: the shoved object's centre", (x + dx, y + dy))
        position, quaternion = self.client.getBasePositionAndOrientation(self.body)
        self.client.resetBasePositionAndOrientation(
            self.body,
            turn.apply(position - centre) + np.add(centre, (dx, dy, 0.0)),
            (turn * Rotation.from_quat(quaternion)).as_quat(),
        )

    def knock(self, dx_m_s: float, dy_m_s: float, spin_rad_s: float = 0.0) -> None:
        """Add to the object's velocity [m/s] and to its spin [rad/s] about the vertical."""
        speeds = (("dx_m_s", dx_m_s), ("dy_m_s", dy_m_s))
        change = [*(check_within(name, v, -10.0, 10.0, "m/s") for name, v in speeds), 0.0]
        spin = [0.0, 0.0, check_within("spin_rad_s", spin_rad_s, -100.0, 100.0, "rad/s")]
        self._change_velocity(np.array(change), np.array(spin))

    def topple(self, direction_rad: float) -> None:
        """Give the object the spin that tips it over the edge of its base in a direction [rad].

        Raises ValueError if the object can roll and thus has no such edge.
        """
        c, s = math.cos(angle := check_finite("direction_rad", direction_rad)), math.sin(angle)
        if self.rolls():
            kind = self.obj.category
            raise ValueError(f"a {kind} that can roll has no edge to topple over; use another")
        low, high = self.client.getAABB(self.body)
        x, y, z = self.state()[:3]
        corners = self._corners_m() - (x, y)
        out, up = float((corners @ (c, s)).max()), z - low[2]
        width, height = 2 * out, high[2] - low[2]
        # For a box about its lower edge: inertia per mass, and the rise of its centre.
        inertia = (width**2 + height**2) / 3
        rise = math.hypot(out, up) - up
        rate = math.sqrt(2 * 9.81 * rise * _TOPPLING / inertia)
        spin = rate * np.array([-s, c, 0.0])
        self._change_velocity(np.cross(spin, [-out * c, -out * s, up]), spin)

    def _corners_m(self) -> np.ndarray:
        """Return the outline (n, 2) [m] on the table in the object's current pose."""
        if self.fell():
            outline, half = self.obj.footprint_m, self.obj.height_m / 2
            ends = np.concatenate([np.insert(outline, 2, z, axis=1) for z in (-half, half)])
            *centre, i, j, k, w = self.state()
            return Rotation.from_quat([i, j, k, w]).apply(ends)[:, :2] + centre[:2]
        x, y, yaw = self.pose()
        return np.add(rotated(self.obj.footprint_m, yaw), (x, y))

    def draw_outline(self, xy_m: tuple, rgb: tuple, yaw_rad: float, scale: float) -> int:
        """Create a coloured body that shows the footprint at (x, y) [m], 1 m below the table."""
        xy_m, yaw_rad = check_on_table("xy_m", xy_m), check_finite("yaw_rad", yaw_rad)
        outline = check_within("scale", scale, 0.1, 10.0) * self.obj.footprint_m
        rgb = [check_within("rgb", share, 0.0, 1.0) for share in check_array("rgb", rgb, 3)]
        # Larger sheets lie lower, so that a larger one appears as a frame around a smaller one.
        sheet = [np.vstack([np.insert(outline, 2, z, axis=1) for z in (-0.005, 0.001 / scale)])]
        return self.client.createMultiBody(
            baseVisualShapeIndex=self.client.createVisualShape(**_mesh(sheet), rgbaColor=(*rgb, 1)),
            basePosition=(*xy_m, -1.0),
            baseOrientation=pybullet.getQuaternionFromEuler((0, 0, yaw_rad)),
        )

    def _change_velocity(self, linear: np.ndarray, angular: np.ndarray) -> None:
        moving = self.client.getBaseVelocity(self.body)
        changed = np.add(moving, (linear, angular)).tolist()
        self.client.resetBaseVelocity(self.body, *changed)


def _mesh(parts: list) -> dict[str, Any]:
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
