"""Solutions to the exercises of notebook 09."""

import numpy as np

from exercises import check


def effect(before, after, centroid, heading):
    """Where the centroid is before and after; seen along the push; the turn between -π and π."""

    def middle(pose):
        x, y, yaw = pose
        c, s = np.cos(yaw), np.sin(yaw)
        return x + c * centroid[0] - s * centroid[1], y + s * centroid[0] + c * centroid[1]

    dx, dy = np.subtract(middle(after), middle(before))
    c, s = np.cos(heading), np.sin(heading)
    turn = (after[2] - before[2] + np.pi) % (2 * np.pi) - np.pi
    return c * dx + s * dy, c * dy - s * dx, turn


def mirrored(contact, direction, displacement, turn):
    """What points along y changes its sign, and so does what turns."""
    (cx, cy), (dx, dy), (x, y) = contact, direction, displacement
    return cx, -cy, dx, -dy, x, -y, -turn


VERDICTS = [check("09.1", effect), check("09.2", mirrored)]
print(*VERDICTS, sep="\n")
