"""Exercises of notebooks 01 and 02: the world, and what there is to learn in it."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import numpy as np

from affordlib.interactions import open_interactions
from affordlib.primitives import DURATION_S, Push
from affordlib.world import CATEGORIES, Cuboid, Prism, Tabletop, UprightCylinder
from exercises.checking import Exercise, answer_of

# 01 The tabletop


def _worst_speed_error(speed_m_s: Callable[[float], float]) -> float:
    """Largest difference [mm/s] from the speed of a push, by finite differences of its path."""
    t, dt = np.linspace(0.05, 0.95, 19), 1e-4
    ahead, behind = (Push.towards(0.0).path(t + side * dt)[:, 0] for side in (1, -1))
    true = (ahead - behind) / (2 * dt * DURATION_S)
    return 1000 * max(abs(answer_of(speed_m_s, float(k)) - v) for k, v in zip(t, true, strict=True))


def rest_cm(phase: float, yaw_rad: float) -> float:
    """How far [cm] a box has moved, pushed towards 0.6 rad up to a phase."""
    with Tabletop() as world:
        world.place(Cuboid(length=0.07, width=0.05, height=0.05), yaw_rad=yaw_rad)
        return 100 * float(
            np.hypot(*world.execute_primitive(Push.towards(0.6), phase).rest_effect[:2])
        )


@cache
def _standing() -> tuple[list[np.ndarray], list[float]]:
    """Images of twelve boxes, upright cylinders and prisms, and their volumes [cm³]."""
    rng = np.random.default_rng(0)
    images, volumes_cm3 = [], []
    with Tabletop() as world:
        for category in 4 * (Cuboid, UprightCylinder, Prism):
            obj = category.sample(rng)
            world.place(obj, yaw_rad=rng.uniform(0, np.pi))
            images.append(world.depth_image())
            volumes_cm3.append(1e6 * obj.volume_m3)
    return images, volumes_cm3


def _volume_error_percent(volume_cm3: Callable[[np.ndarray], float]) -> float:
    images, true = _standing()
    return 100 * float(
        np.mean([abs(answer_of(volume_cm3, i) / v - 1) for i, v in zip(images, true, strict=True)])
    )


# 02 Interactions


@cache
def _cylinders() -> tuple[np.ndarray, np.ndarray]:
    """Diameters [m] of the upright cylinders in `push`, and how far along they went [m]."""
    pushes = open_interactions("push")
    standing = pushes["category"].values == list(CATEGORIES).index("upright_cylinder")
    angle = pushes["theta"].values[standing] + np.pi
    x, y = pushes["effect"].values[standing, -1, :2].T
    return pushes["size"].values[standing, 0], np.cos(angle) * x + np.sin(angle) * y


def _cylinder_error_mm(end_m: Callable[[float], float]) -> float:
    diameters, true = _cylinders()
    given = np.array([answer_of(end_m, float(d)) for d in diameters])
    return 1000 * float(np.abs(given - true).mean())


WORLD: dict[str, Exercise] = {
    "01.1": Exercise(
        "Write speed_m_s(t), the speed of the gripper at phase t of a push.",
        _worst_speed_error,
        expected=0.0,
        within=0.1,
        unit="mm/s, largest error",
    ),
    "01.2": Exercise(
        "Write volume_cm3(image), the volume of an object from its image.",
        _volume_error_percent,
        expected=0.0,
        within=5.0,
        unit="%, mean error",
    ),
    "02.1": Exercise(
        "Compute the mean distance [mm] of the drags' ends from where the mean drag ends.",
        lambda mine: mine,
        expected=0.076,
        within=0.005,
        unit="mm",
    ),
    "02.2": Exercise(
        "Write end_m(diameter_m): how far a push moves a cylinder, from geometry alone.",
        _cylinder_error_mm,
        expected=0.0,
        within=0.6,
        unit="mm, mean error",
    ),
}
