"""Solutions to the exercises of notebook 09."""

import numpy as np

from exercises import check


def to_object(pose, point):
    """First where the object is, then how it is turned: backwards."""
    x, y, yaw = pose
    c, s = np.cos(yaw), np.sin(yaw)
    dx, dy = point[0] - x, point[1] - y
    return c * dx + s * dy, c * dy - s * dx


def mirrored(contact, direction, displacement, turn):
    """What points along y changes its sign, and so does what turns."""
    (cx, cy), (dx, dy), (x, y) = contact, direction, displacement
    return cx, -cy, dx, -dy, x, -y, -turn


VERDICTS = [check("09.1", to_object), check("09.2", mirrored)]

if __name__ == "__main__":
    print(*VERDICTS, sep="\n")
