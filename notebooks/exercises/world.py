"""Exercises of notebooks 01, 02 and A5: the world, what there is to learn in it, and its files."""

from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from affordlib.interactions import open_interactions
from affordlib.interactions.store import write_interactions
from affordlib.primitives import DURATION_S, Push
from affordlib.world import CATEGORIES, Cuboid, Prism, Tabletop, UprightCylinder
from exercises.checking import answer_of, exercise, given


@exercise("01.1", 0.0, 0.1, "mm/s, largest error")
def speed_error(speed_m_s: Callable) -> float:
    """Write speed_m_s(t), the speed of the gripper at phase t of a push.

    Differentiate the timing with respect to t.
    t runs from 0 to 1 while 3.75 s pass: divide by that time, too.
    """
    t, dt = np.linspace(0.05, 0.95, 19), 1e-4
    ahead, behind = (Push.towards(0.0).path(t + side * dt)[:, 0] for side in (1, -1))
    true = (ahead - behind) / (2 * dt * DURATION_S)
    return 1000 * np.abs([answer_of(speed_m_s, float(k)) for k in t] - true).max()


@exercise("01.2", 0.0, 5.0, "%, mean error")
def volume_error(volume_cm3: Callable) -> float:
    """Write volume_cm3(image), the volume of an object from its image.

    Add up columns: the area of a pixel times the height above it.
    The height is the distance of the table, the farthest pixel, minus that of the pixel.
    """
    rng, off = np.random.default_rng(0), []
    with Tabletop() as world:
        for category in 4 * (Cuboid, UprightCylinder, Prism):
            obj = category.sample(rng)
            world.place(obj, yaw_rad=rng.uniform(0, np.pi))
            off.append(answer_of(volume_cm3, world.depth_image()) / (1e6 * obj.volume_m3) - 1)
    return 100 * np.abs(off).mean()


@exercise("02.1", 0.076, 0.005, "mm")
def spread_of_drags(mm: float) -> float:
    """Compute the mean distance [mm] of the drags' ends from where the mean drag ends.

    Rotate each final effect by minus the direction of its own drag.
    Measure from the mean of the rotated ends, not from the start.
    """
    return mm


@exercise("02.2", 0.0, 0.6, "mm, mean error")
def cylinder_error(end_m: Callable) -> float:
    """Write end_m(diameter_m): how far a push moves a cylinder, from geometry alone.

    Draw the two finger tips and the circle: it touches the inner corner or edge of both.
    The centre is ahead of the tips by the other side of a right triangle, or by the radius.
    """
    pushes = open_interactions("push")
    standing = pushes["category"].values == list(CATEGORIES).index("upright_cylinder")
    angle = pushes["theta"].values[standing] + np.pi
    x, y = pushes["effect"].values[standing, -1, :2].T
    answers = [answer_of(end_m, float(d)) for d in pushes["size"].values[standing, 0]]
    return 1000 * np.abs(answers - (np.cos(angle) * x + np.sin(angle) * y)).mean()


@exercise("A5.1", 0.58, 0.002, "of the full action")
def phase_at_1_mm(phase: float) -> float:
    """Compute the median phase at which a push has moved its object by 1 mm.

    The distance from the start is the length of the effect's x and y.
    For each push take the first phase at which it is at least 1 mm; then the median.
    """
    return phase


@exercise("A5.2", 0.0, 0.0, "pairs judged wrongly")
def wrong_pairs(same: Callable) -> float:
    """Write same(path, other): whether two files contain the same data.

    A set is stored with a hash of its contents.
    Compare the hashes: the bytes of the files differ with their compression.
    """
    data = open_interactions("grasp").isel(interaction=slice(3))
    with TemporaryDirectory() as folder:
        file, light, other = (Path(folder) / f"{name}.zarr.zip" for name in ("a", "b", "c"))
        write_interactions(data, file)
        write_interactions(data, light, level=1)
        write_interactions(data.assign(mass=2 * data["mass"]), other)
        judged = [bool(given(same(file, path))) for path in (file, light, other)]
    return sum(a != b for a, b in zip(judged, (True, True, False), strict=True))
