"""Trajectory planning: a primitive is converted to joint waypoints before the arm moves.

Inverse kinematics is solved at 20 Hz and interpolated with a spline (its error is a few µm).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from affordlib.primitives import DURATION_S, HOVER_M, TIP_HEIGHT_M, YAW, Primitive, Z, min_jerk
from affordlib.world import robot

STEP_S = 1 / 240
STEPS_PER_WAYPOINT = 12
RECORD_EVERY = 3  # simulation steps between two recorded states of the object
N_SAMPLES = 301  # over the phase, one every 3 simulation steps of a full primitive
RETREAT_M = 0.02  # back along the path, except after actions that cage the object
_WAYPOINT_S = STEPS_PER_WAYPOINT * STEP_S
UP = np.eye(6)[Z]
"""Unit vector upwards in poses (6,)."""


@dataclass(frozen=True)
class TrajectorySegment:
    """Waypoints at intervals of 50 ms."""

    poses: np.ndarray  # (n, 6) as in `Segment`
    phase: np.ndarray  # (n,)
    guarded: bool = False


@dataclass(frozen=True)
class Command:
    """An action for the arm to execute, relative to the object's measured position."""

    primitive: Primitive
    phase: np.ndarray  # (n,), as recorded
    action: np.ndarray  # (n, 5), as recorded
    segments: list[TrajectorySegment]  # the trajectory

    @classmethod
    def of(cls, primitive: Primitive, stop_phase: float) -> Self:
        """Return the command for a primitive up to a phase."""
        phase = np.linspace(0.0, 1.0, N_SAMPLES) * stop_phase
        return cls(primitive, phase, primitive.path(phase), segments_until(primitive, stop_phase))

    @classmethod
    def along(cls, path_xy_m: np.ndarray, primitive: Primitive, stop_phase: float) -> Self:
        """Return the command along points (n, 2) [m] at a primitive's heights, facing their end."""
        if path_xy_m.ndim != 2 or len(path_xy_m) < 2:
            raise ValueError(f"path_xy_m must be points (n, 2), n ≥ 2, got {path_xy_m.shape}")
        phase = np.linspace(0.0, 1.0, len(path_xy_m)) * stop_phase
        action = primitive.path(phase)
        action[:, :2] = path_xy_m
        heading = path_xy_m[-1] - path_xy_m[0]
        if np.hypot(*heading) > 1e-6:
            action[:, YAW] = math.atan2(heading[1], heading[0])
        # Re-timed to a smooth stop: parametrised by arc length, a minimum-jerk path does not
        # depend on its speed.
        n = max(2, math.ceil(DURATION_S * float(min_jerk(phase[-1])) / _WAYPOINT_S - 1e-9))
        length = np.concatenate([[0], np.cumsum(np.hypot(*np.diff(action[:, :2], axis=0).T))])
        poses, at_phase = np.repeat([[*action[0], 0.0]], n + 1, axis=0), np.zeros(n + 1)
        if length[-1] > 1e-9:
            wanted = min_jerk(np.linspace(0, 1, n + 1)) * length[-1]
            at_phase = np.interp(wanted, length, phase)
            poses[:, :5] = interpolated(wanted, length, action)
        return cls(primitive, phase, action, [TrajectorySegment(poses, at_phase)])


def interpolated(at: np.ndarray, known_at: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return columns (n, c) of values (m, c), interpolated linearly."""
    return np.column_stack([np.interp(at, known_at, column) for column in values.T])


def segments_until(primitive: Primitive, stop_phase: float) -> list[TrajectorySegment]:
    """Return a primitive's trajectory up to a phase, re-timed to a minimum-jerk stop."""
    segments = []
    phases = primitive.segment_phases
    for segment, begin, end in zip(primitive.segments, phases[:-1], phases[1:], strict=True):
        if segments and begin >= stop_phase - 1e-9:
            break
        local = min(1.0, (stop_phase - begin) / (end - begin))
        covered = float(min_jerk(local))
        n = max(2, math.ceil(segment.seconds * covered / _WAYPOINT_S - 1e-9))
        share = covered * min_jerk(np.linspace(0, 1, n + 1))
        at_phase = np.linspace(0, 1, n + 1)
        if covered < 1.0:
            fine = np.linspace(0, local, 301)
            at_phase = np.interp(share, min_jerk(fine), fine)
        phase = begin + at_phase * (end - begin)
        segments.append(TrajectorySegment(segment.at(share), phase, segment.guarded))
    return segments


def recorded_phases(segments: list[TrajectorySegment]) -> tuple[np.ndarray, np.ndarray]:
    """Return the phases at which object states and tool poses are recorded, in this order."""
    per = STEPS_PER_WAYPOINT // RECORD_EVERY
    at_sample, at_waypoint = [], []
    for segment in segments:
        waypoints = np.arange(len(segment.phase))
        at = np.arange(waypoints[-1] * per + 1) / per
        *samples, end = np.interp(at, waypoints, segment.phase)
        at_sample += samples
        at_waypoint += samples[::per]
    return np.array([*at_sample, end]), np.array([*at_waypoint, end])


def joint_move(start: np.ndarray, end: np.ndarray, seconds: float) -> np.ndarray:
    """Return joint waypoints (n, 6) of a minimum-jerk motion between two configurations."""
    n = max(2, math.ceil(seconds / _WAYPOINT_S))
    return start + min_jerk(np.linspace(0, 1, n + 1))[:, None] * (end - start)


def line(start_W: np.ndarray, end_W: np.ndarray, near: np.ndarray, seconds: float, tool: str):
    """Return joint waypoints (n, 6) of a straight line between poses (6,)."""
    return robot.joint_path(joint_move(start_W, end_W, seconds), near, tool)


def plan_motion(
    primitive: Primitive,
    segments: list[TrajectorySegment],
    origin_m: Sequence[float],
    approach: bool,
) -> tuple[list[TrajectorySegment], np.ndarray, np.ndarray, list[np.ndarray], np.ndarray]:
    """Plan the arm's motion along segments about an origin (x, y, z); raises UnreachableError.

    Returns the segments in the table's frame; joint angles (6,) above the start; and joint
    waypoints (n, 6) from there to the start, of each segment, and back and up again.
    """
    home, tool = robot.HOME, primitive.tool
    rise = max(HOVER_M + TIP_HEIGHT_M - segments[0].poses[0, Z], 0.0) * UP
    options = []
    # A gripper is symmetric: of its two equivalent yaws, use the one with less wrist rotation.
    for turn in (0.0, math.pi) if tool == "gripper" else (0.0,):
        shift = np.array([*origin_m, turn, 0.0, 0.0])
        moved = [replace(segment, poses=segment.poses + shift) for segment in segments]
        options.append((robot.joint_path(moved[0].poses[:1] + rise, home, tool)[0], moved))
    above, segments = min(options, key=lambda option: abs(option[0][5] - home[5]))
    paths, near = [], above
    for segment in segments:
        paths.append(robot.joint_path(segment.poses, near, tool))
        near = paths[-1][-1]

    # Retreat: back along the path, then up; only up if the fingers cage the object.
    start, end = segments[0].poses[0], segments[-1].poses[-1]
    caged = primitive.path(0.0)[0, Z] > TIP_HEIGHT_M
    retreat, back = near[None], np.zeros(6)
    if not (caged or primitive.holds):
        back[: Z + 1] = start[: Z + 1] - end[: Z + 1]
        back *= RETREAT_M / max(np.linalg.norm(back), RETREAT_M)
        retreat = line(end, end + back, near, 0.25, tool)
    lift = retreat[-1:]
    if (caged or approach) and not primitive.holds:
        lifted = end + back + (max(HOVER_M - end[Z], 0.0) if caged else HOVER_M) * UP
        lift = line(end + back, lifted, retreat[-1], 0.5, tool)

    down = above[None]
    if approach:
        down = line(start + rise, start, above, 1.0, tool)
    return segments, above, down, paths, np.concatenate([retreat, lift[1:]])
