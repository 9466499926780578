"""Where the object was while the robot worked, to be played again in a live view."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np

from affordlib.world import Tabletop
from affordlib.world.motion import Film

EVERY = 12
"""Simulation steps (1/240 s) between two poses."""

_RESTING = 1e-4


def pose_recorder(poses: list[tuple[float, ...]], before: Film | None) -> Film:
    """A film for a world that appends the object's poses to a list, beside the world's own film."""
    steps = itertools.count()

    def record(world: Tabletop) -> None:
        if before is not None:
            before(world)
        if next(steps) % EVERY == 0:
            poses.append(world.object_pose())

    return record


def moving_part(poses: Sequence[tuple[float, ...]]) -> np.ndarray:
    """The poses (n, 3) from the first move to the last; none where nothing moved."""
    told = np.array(poses).reshape(-1, 3)
    moving = np.abs(np.diff(told, axis=0)).max(axis=1, initial=0.0) > _RESTING
    if not moving.any():
        return told[:0]
    first, last = np.flatnonzero(moving)[[0, -1]]
    return told[first : last + 2]
