"""Angles and rotations in the plane of the table, for points and for arrays of channels."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    import torch


def wrap_angle(angle_rad: float) -> float:
    """Return the same angle [rad] in [-π, π)."""
    return (angle_rad + math.pi) % (2 * math.pi) - math.pi


def unit_vector(angle_rad: float) -> np.ndarray:
    """Return the unit vector (2,) at an angle [rad]."""
    return np.array([math.cos(angle_rad), math.sin(angle_rad)])


def rotated(xy: np.ndarray, angle_rad: float) -> np.ndarray:
    """Rotate points (..., 2) about the origin, counter-clockwise, by an angle [rad]."""
    c, s = math.cos(angle_rad), math.sin(angle_rad)
    return xy @ np.array([[c, s], [-s, c]])


def rotated_each(xy: np.ndarray, angle_rad: np.ndarray) -> np.ndarray:
    """Rotate points (..., 2) about the origin, each by its angle (...) [rad]."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    x, y = xy[..., 0], xy[..., 1]
    return np.stack([c * x - s * y, s * x + c * y], axis=-1)


def cross(a: Any, b: Any) -> Any:
    """Return the z component (...) of the cross product of vectors (..., 2), arrays or tensors."""
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def rectangle(size: Sequence[float]) -> np.ndarray:
    """Return the corners (4, 2) of a rectangle around the origin; size: along x and y."""
    return np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * (np.array(size) / 2)


def circle(radius: float, n: int) -> np.ndarray:
    """Return n points (n, 2) on a circle around the origin."""
    angle = np.linspace(0, 2 * math.pi, n, endpoint=False)
    return radius * np.column_stack([np.cos(angle), np.sin(angle)])


def extruded(outline: np.ndarray, low: float, high: float) -> np.ndarray:
    """Return the corners (2n, 3) of what stands between two heights over an outline (n, 2)."""
    return np.vstack([np.insert(outline, 2, z, axis=1) for z in (low, high)])


def is_convex(corners: np.ndarray) -> bool:
    """Return whether corners (k, 2) go counter-clockwise around a convex polygon."""
    edges = np.roll(corners, -1, axis=0) - corners
    following = np.roll(edges, -1, axis=0)
    turns, inner = cross(edges, following), (edges * following).sum(axis=1)
    rounds = np.arctan2(turns, inner).sum() / (2 * math.pi)  # 1 for convex, 2 for a star
    return len(corners) > 2 and bool((turns > 0).all()) and rounds < 1.5


def edge_normals(corners: np.ndarray) -> np.ndarray:
    """Return the outward unit normals (..., k, 2) of the edges of polygons (..., k, 2)."""
    edges = np.roll(corners, -1, axis=-2) - corners
    outward = np.stack([edges[..., 1], -edges[..., 0]], axis=-1)
    return outward / np.linalg.norm(outward, axis=-1, keepdims=True)


def centroid(corners: np.ndarray) -> np.ndarray:
    """Return the centroid (2,) of a polygon with the given corners (k, 2)."""
    following = np.roll(corners, -1, axis=0)
    doubled = cross(corners, following)
    return ((corners + following) * doubled[:, None]).sum(axis=0) / (3 * doubled.sum())


def quarter_turn(a: Any) -> Any:
    """Rotate vectors (..., 2), a tensor, by +90°."""
    import torch  # imported here because code that only simulates does not need it

    return torch.stack([-a[..., 1], a[..., 0]], -1)


def rotate(a: Any, angle_rad: Any) -> Any:
    """Rotate vectors (..., 2) by angles (...), both tensors, counter-clockwise."""
    return angle_rad.cos()[..., None] * a + angle_rad.sin()[..., None] * quarter_turn(a)


def xy_columns(channels: tuple[str, ...]) -> list[int]:
    """Return the indices of the channels x and y, or an empty list unless both exist."""
    return [channels.index(name) for name in "xy"] if {"x", "y"} <= {*channels} else []


def rotate_channels(
    values: torch.Tensor, channels: tuple[str, ...], heading: torch.Tensor, absolute_yaw: bool
) -> torch.Tensor:
    """Rotate values (..., C) by the angles whose (cos, sin) are `heading` (..., 2).

    An absolute yaw (of an action) is rotated too; a relative one (of an effect) is unchanged.
    """
    import torch

    cos, sin = heading.unbind(-1)
    columns = list(values.unbind(-1))
    if plane := xy_columns(channels):
        x, y = (columns[k] for k in plane)
        columns[plane[0]], columns[plane[1]] = cos * x - sin * y, sin * x + cos * y
    if absolute_yaw and "yaw" in channels:
        k = channels.index("yaw")
        yaw = columns[k] + torch.atan2(sin, cos)
        columns[k] = torch.remainder(yaw + math.pi, 2 * math.pi) - math.pi
    return torch.stack(columns, dim=-1)
