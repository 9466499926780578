"""Solutions to the exercises of notebook 01."""

from affordlib.primitives import DURATION_S
from exercises import check


def speed_m_s(t):
    """The derivative of 25 cm × (10t³ - 15t⁴ + 6t⁵), over the time that the phase takes."""
    return 0.25 * (30 * t**2 - 60 * t**3 + 30 * t**4) / DURATION_S


def volume_cm3(image):
    """The sum of the heights, times the area of a pixel; the table is the farthest point.

    Below the widest part of a sphere the camera sees no air, so the sum is too large.
    """
    depth, mask = image
    heights_cm = 100 * (depth.max() - depth[mask > 0.5])
    return heights_cm.sum() * (16 / 48) ** 2


VERDICTS = [check("01.1", speed_m_s), check("01.2", volume_cm3)]
print(*VERDICTS, sep="\n")
