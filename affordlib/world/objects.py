"""Objects on the table, one class per category, and what the world around them is like.

A category is a frozen dataclass with its dimensions. The frame of a body has its origin in the
centre and z upwards as the object is placed; the x axis of a lying cylinder is its own axis.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass, fields
from typing import Any, ClassVar

import numpy as np
import pybullet
from scipy.spatial import ConvexHull

from affordlib.types import check_array, check_field, check_within

DENSITY_KG_M3 = 600.0
SIZE_RANGE_M = (0.04, 0.08)
LARGEST_M = 0.3
N_EDGES = (3, 8)
CHAMFER_M = (0.006, 0.004)
"""Width and height of the chamfer around a prism's base, where a blade can get hold."""

_HULL_MARGIN_M = 0.001
"""PyBullet feels a convex hull this far outside its corners."""

_UPRIGHT = math.cos(math.radians(45))


@dataclass(frozen=True)
class TabletopObject(ABC):
    """An object on the table; all its fields are lengths [m].

    rollable: whether it can roll as it is placed; footprint_m: corners (n, 2) of its outline seen
    from above, around its centre, before turning.
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
    ) -> TabletopObject:
        """An object with dimensions drawn uniformly from a range, heights from another if given."""
        sizes = rng.uniform(*size_range_m, size=len(fields(cls)))
        if height_range_m is not None:
            low, high = size_range_m
            share = (sizes[-1] - low) / max(high - low, 1e-9)
            sizes[-1] = height_range_m[0] + share * (height_range_m[1] - height_range_m[0])
        return cls(*(float(size) for size in sizes))

    height_m = property(lambda self: self.height)

    @abstractmethod
    def shape(self) -> dict[str, Any]:
        """PyBullet's arguments for it; `frame` turns it, `seen` are corners only for drawing."""

    def fallen(self, upward: np.ndarray) -> bool:
        """Whether it lies otherwise than placed; upward: (3,) how far x, y and z axes point up."""
        return bool(upward[2] < _UPRIGHT)

    def rolls(self, upward: np.ndarray) -> bool:
        """Whether it can roll as it lies now."""
        return self.rollable


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]


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

    Its centroid becomes the origin; the base is chamfered all around.
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
        turns = _cross(edges, np.roll(edges, -1, axis=0))
        inner = np.sum(edges * np.roll(edges, -1, axis=0), axis=1)
        rounds = np.arctan2(turns, inner).sum() / (2 * math.pi)  # a star goes around twice
        if (turns <= 0).any() or rounds > 1.5 or np.abs(corners).max() > LARGEST_M:
            raise ValueError(
                "prism corners must go counter-clockwise around a convex polygon of at most "
                f"{LARGEST_M:g} m, got {self.corners!r}"
            )
        doubled = _cross(corners, following)
        centroid = ((corners + following) * doubled[:, None]).sum(axis=0) / (3 * doubled.sum())
        centred = tuple((float(x), float(y)) for x, y in corners - centroid)
        object.__setattr__(self, "corners", centred)

    @classmethod
    def sample(
        cls,
        rng: np.random.Generator,
        size_range_m: tuple[float, float] = SIZE_RANGE_M,
        height_range_m: tuple[float, float] | None = None,
    ) -> Prism:
        """A polygon of 3 to 8 edges whose corners lie on a circle as wide as the drawn size."""
        n = int(rng.integers(N_EDGES[0], N_EDGES[1] + 1))
        angle = (np.arange(n) + rng.uniform(-0.3, 0.3, size=n)) * 2 * math.pi / n
        radius = rng.uniform(*size_range_m) / 2
        corners = radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        height = rng.uniform(*(height_range_m or size_range_m))
        return cls(tuple((float(x), float(y)) for x, y in corners), float(height))

    volume_m3 = property(lambda self: float(ConvexHull(self._vertices()).volume))
    footprint_m = property(lambda self: np.array(self.corners))

    def _vertices(self, inset_m: float = 0.0) -> np.ndarray:
        """Corners (3n, 3) of the solid: of its top, of the chamfer's upper rim, of its base.

        inset_m: how far its faces lie inside, nearly.
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
        return {"shapeType": pybullet.GEOM_MESH, "vertices": felt, "seen": self._vertices()}


CATEGORIES: dict[str, type[TabletopObject]] = {
    kind.category: kind for kind in (Cuboid, UprightCylinder, LyingCylinder, Sphere, Prism)
}


def category_named(name: str) -> type[TabletopObject]:
    """The class of the object category called `name`; raises naming the known ones."""
    if name not in CATEGORIES:
        raise ValueError(f"object category {name!r} is unknown; choose one of {sorted(CATEGORIES)}")
    return CATEGORIES[name]


CAMERAS = ("ideal", "kinect")


@dataclass(frozen=True)
class WorldConfig:
    """Friction coefficients (Bullet multiplies the two bodies'), the object's inside, the senses.

    com_offset_m: the centre of mass in the object's frame; tip_offset_m: how much higher than
    commanded the gripper moves; bias_m: added to where the robot believes the object to be.
    camera: "ideal" tells where it is, "kinect" measures it, with noise drawn from noise_seed.
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
        if self.camera not in CAMERAS:
            raise ValueError(f"camera must be one of {CAMERAS}, got {self.camera!r}")
