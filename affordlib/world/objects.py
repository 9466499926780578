"""The things on the table: one class per family, so that a new one is a few lines.

A family is a frozen dataclass with its dimensions, `sample(rng)` to draw one, `height_m`,
`volume_m3` and `shape()`, the arguments PyBullet builds it from.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, replace
from typing import Any, ClassVar

import numpy as np
import pybullet

from affordlib.types import check_within

DENSITY_KG_M3 = 600.0
SIZE_RANGE_M = (0.04, 0.08)
LARGEST_M = 0.12


@dataclass(frozen=True)
class Cuboid:
    """A box with edges `length`, `width` and `height` [m], standing on its base."""

    length: float
    width: float
    height: float

    family: ClassVar[str] = "cuboid"

    def __post_init__(self) -> None:
        for name, value in asdict(self).items():
            check_within(f"cuboid {name}", value, 0.005, LARGEST_M, "m")

    @classmethod
    def sample(cls, rng: np.random.Generator) -> Cuboid:
        """A cuboid with edges drawn uniformly from `SIZE_RANGE_M`."""
        return cls(*(float(v) for v in rng.uniform(*SIZE_RANGE_M, size=3)))

    @property
    def height_m(self) -> float:
        return self.height

    @property
    def volume_m3(self) -> float:
        return self.length * self.width * self.height

    @property
    def footprint_m(self) -> np.ndarray:
        """Corners (4, 2) of the base around the centre, before turning by the yaw."""
        a, b = self.length / 2, self.width / 2
        return np.array([[a, b], [-a, b], [-a, -b], [a, -b]])

    def shape(self) -> dict[str, Any]:
        half = [self.length / 2, self.width / 2, self.height / 2]
        return {"shapeType": pybullet.GEOM_BOX, "halfExtents": half}


@dataclass(frozen=True)
class UprightCylinder:
    """A cylinder of the given `diameter` and `height` [m], standing on its round base."""

    diameter: float
    height: float

    family: ClassVar[str] = "upright_cylinder"

    def __post_init__(self) -> None:
        for name, value in asdict(self).items():
            check_within(f"cylinder {name}", value, 0.005, LARGEST_M, "m")

    @classmethod
    def sample(cls, rng: np.random.Generator) -> UprightCylinder:
        """A cylinder with diameter and height drawn uniformly from `SIZE_RANGE_M`."""
        return cls(*(float(v) for v in rng.uniform(*SIZE_RANGE_M, size=2)))

    @property
    def height_m(self) -> float:
        return self.height

    @property
    def volume_m3(self) -> float:
        return math.pi * self.diameter**2 / 4 * self.height

    @property
    def footprint_m(self) -> np.ndarray:
        """Points (36, 2) around the base."""
        angle = np.linspace(0, 2 * math.pi, 36, endpoint=False)
        return self.diameter / 2 * np.stack([np.cos(angle), np.sin(angle)], axis=1)

    def shape(self) -> dict[str, Any]:
        return {
            "shapeType": pybullet.GEOM_CYLINDER,
            "radius": self.diameter / 2,
            "height": self.height,
        }


FAMILIES: dict[str, type[Cuboid] | type[UprightCylinder]] = {
    family.family: family for family in (Cuboid, UprightCylinder)
}


def family_named(name: str) -> type[Cuboid] | type[UprightCylinder]:
    """The class of the object family called `name`; raises naming the known ones."""
    if name not in FAMILIES:
        raise ValueError(f"object family {name!r} is unknown; choose one of {sorted(FAMILIES)}")
    return FAMILIES[name]


def _visual_shape(client: int, thing: Cuboid | UprightCylinder, rgba: tuple) -> int:
    shape = thing.shape()
    if "height" in shape:
        shape["length"] = shape.pop("height")
    return pybullet.createVisualShape(**shape, rgbaColor=rgba, physicsClientId=client)


def create_body(client: int, thing: Cuboid | UprightCylinder, mass_kg: float, rgba: tuple) -> int:
    """Create the object in a PyBullet client, at the origin, and return its body id."""
    return pybullet.createMultiBody(
        baseMass=mass_kg,
        baseCollisionShapeIndex=pybullet.createCollisionShape(
            **thing.shape(), physicsClientId=client
        ),
        baseVisualShapeIndex=_visual_shape(client, thing, rgba),
        physicsClientId=client,
    )


def create_footprint(
    client: int,
    thing: Cuboid | UprightCylinder,
    xy_m: tuple,
    yaw_rad: float,
    rgba: tuple,
    scale: float = 1.0,
) -> int:
    """Create the object's base as a sheet on the table that is only seen; return its id."""
    # Larger sheets lie lower, so that one on another shows as a frame around it.
    flat = replace(thing, height=0.01)
    scaled = {name: scale * size for name, size in asdict(flat).items() if name != "height"}
    return pybullet.createMultiBody(
        baseVisualShapeIndex=_visual_shape(client, replace(flat, **scaled), rgba),
        basePosition=(*xy_m, 0.001 / scale - 0.004),
        baseOrientation=pybullet.getQuaternionFromEuler((0, 0, yaw_rad)),
        physicsClientId=client,
    )
