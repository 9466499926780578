"""What a world is like: frictions, the inside of the object, the robot's senses."""

from __future__ import annotations

from dataclasses import dataclass

from affordlib.types import check_field, check_within
from affordlib.world.objects import DENSITY_KG_M3

CAMERAS = ("ideal", "kinect")


@dataclass(frozen=True)
class WorldConfig:
    """Friction coefficients (Bullet multiplies the two bodies'), the object's inside, the senses.

    com_offset_m: where the centre of mass lies in the object's frame; tip_offset_m: how much
    higher than commanded the gripper moves. camera: "ideal" tells the robot where the object is
    and shows it without noise, "kinect" leaves it to measure; bias_m is added to where it believes
    the object to be, and noise_seed draws the noise of the images.
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
