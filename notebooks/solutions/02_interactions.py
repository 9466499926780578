"""Solutions to the exercises of notebook 02."""

import math

import numpy as np

from affordlib.interactions import open_interactions
from exercises import check


def spread_of_drags_mm():
    """A drag ends where it is commanded to: an image adds nothing."""
    drags = open_interactions("drag")
    angle = drags["theta"].values
    x, y = 1000 * drags["effect"].values[:, -1, :2].T
    along, across = np.cos(angle) * x + np.sin(angle) * y, np.cos(angle) * y - np.sin(angle) * x
    return float(np.hypot(along - along.mean(), across).mean())


def end_m(diameter_m):
    """The cylinder lies against the inner edges of both fingers.

    The gripper stops 5 cm past the centre, the fingers reach 1 cm further, and their inner edges
    are 1.5 cm to either side: the centre is √(r² - 1.5²) cm ahead of them.
    """
    return 0.05 + 0.01 + math.sqrt((diameter_m / 2) ** 2 - 0.015**2)


VERDICTS = [check("02.1", spread_of_drags_mm()), check("02.2", end_m)]
print(*VERDICTS, sep="\n")
