"""Solutions to the exercises of notebook 01."""

import numpy as np

from affordlib.primitives import DURATION_S, Push
from affordlib.world import Cuboid, Tabletop
from exercises import check


def speed_m_s(t):
    """The derivative of 25 cm × (10t³ - 15t⁴ + 6t⁵), over the time that the phase takes."""
    return 0.25 * (30 * t**2 - 60 * t**3 + 30 * t**4) / DURATION_S


def phase_for_5_cm():
    """A smooth stop leaves the object where the full push had it: read it off one recording."""
    with Tabletop() as world:
        world.place(Cuboid(length=0.07, width=0.05, height=0.05), yaw_rad=0.4)
        full = world.execute_primitive(Push.towards(0.6))
    return float(np.interp(0.05, np.hypot(*full.effect[:, :2].T), full.phase))


VERDICTS = [check("01.1", speed_m_s), check("01.2", phase_for_5_cm())]

if __name__ == "__main__":
    print(*VERDICTS, sep="\n")
