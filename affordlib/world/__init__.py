"""The simulated world in PyBullet: the tabletop, its objects, the arm and the camera."""

import affordlib.world._quiet_pybullet  # must be imported first
from affordlib.types import UnreachableError
from affordlib.world.objects import (
    CATEGORIES,
    ROLLABLE,
    STANDING,
    Cuboid,
    LyingCylinder,
    Prism,
    Sphere,
    TabletopObject,
    UprightCylinder,
    WorldConfig,
    category_named,
)
from affordlib.world.robot import BASE_X_M, REACH_M
from affordlib.world.tabletop import Tabletop
