"""A levered polygon seen from the side: truth and predictions, one over the other."""

from __future__ import annotations

import math

import numpy as np
from matplotlib.axes import Axes
from torch import Tensor

from affordlib.types import check_array, check_finite, check_pair
from affordlib.world import Thing

_ALONG, _UP = 0.45, 0.3


def outline_in_lever_frame(
    thing: Thing, yaw_rad: float, contact_xy_m: np.ndarray, theta_rad: float
) -> np.ndarray:
    """The base (n, 2) [m] of an object at its start, from the contact point, lever to the right."""
    yaw, theta = check_finite("yaw_rad", yaw_rad), check_finite("theta_rad", theta_rad)
    c, s = math.cos(yaw), math.sin(yaw)
    outline = thing.footprint_m @ np.array([[c, s], [-s, c]]) - check_pair(
        "contact_xy_m", contact_xy_m
    )
    c, s = math.cos(theta), math.sin(theta)
    return outline @ np.array([[c, -s], [s, c]])


def plot_levered(
    ax: Axes,
    outline_m: np.ndarray,
    height_m: float,
    pose: np.ndarray | Tensor,
    color: str,
    label: str | None = None,
) -> Axes:
    """A prism after a change of pose (x, y, z [m], tilt [rad]) from its start.

    outline_m: (n, 2), as of `outline_in_lever_frame`. It is tilted about an axis across the lever,
    which for the real one is only roughly so. Across is drawn obliquely; units are centimetres.
    """
    pose, height_m = check_array("pose", pose, 4), check_finite("height_m", height_m)
    outline_m = check_array("outline_m", outline_m, 2)
    centre, tilt = outline_m.mean(axis=0), pose[3]
    c, s = math.cos(tilt), math.sin(tilt)
    faces = []
    for z in (-height_m / 2, height_m / 2):
        x, y = (outline_m - centre).T
        x, z = c * x + s * z, c * z - s * x
        x, y, z = x + centre[0] + pose[0], y + centre[1] + pose[1], z + height_m / 2 + pose[2]
        faces.append(100 * np.column_stack([x + _ALONG * y, z + _UP * y]))
    for face in faces:
        ax.fill(*face.T, facecolor=color, alpha=0.15, lw=0)
        ax.plot(*np.vstack([face, face[:1]]).T, color=color, lw=1.2, label=label)
        label = None
    for low, high in zip(*faces, strict=True):
        ax.plot(*np.array([low, high]).T, color=color, lw=0.8)
    ax.set_aspect("equal")
    ax.set(xlabel="along the lever [cm]", ylabel="height [cm]")
    return ax
