"""Angles, and rotations in the plane of the table, of points and of values by channel."""

from __future__ import annotations

import math
from typing import Any

import numpy as np


def wrap_angle(angle_rad: float) -> float:
    """The same angle in [-π, π)."""
    return (angle_rad + math.pi) % (2 * math.pi) - math.pi


def unit_vector(angle_rad: float) -> np.ndarray:
    """The direction (2,) at an angle [rad]."""
    return np.array([math.cos(angle_rad), math.sin(angle_rad)])


def rotated(xy: np.ndarray, angle_rad: float) -> np.ndarray:
    """Points (..., 2) rotated about the origin, counter-clockwise."""
    c, s = math.cos(angle_rad), math.sin(angle_rad)
    return xy @ np.array([[c, s], [-s, c]])


def cross(a: Any, b: Any) -> Any:
    """The z component of the product of vectors (..., 2): arrays or tensors."""
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def xy_columns(channels: tuple[str, ...]) -> list[int]:
    """Where x and y are among the channels; empty if they are not both there."""
    return [channels.index(name) for name in "xy"] if {"x", "y"} <= {*channels} else []


def rotate_channels(
    values: torch.Tensor, channels: tuple[str, ...], heading: torch.Tensor, absolute_yaw: bool
) -> torch.Tensor:
    """Values (..., C) rotated by the angles whose (cos, sin) are `heading` (..., 2).

    A yaw that is an orientation rotates along; one that is a change, as an effect's, stays.
    """
    import torch  # here, for what simulates only need not wait for it

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
