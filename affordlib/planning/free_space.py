"""The free-space check: what the object and the hand sweep in actions, and how near obstacles are.

1. Every shape is a convex polygon: an obstacle (a disc as the regular polygon around it), the
   object's outline from its image, and the rectangle of the hand with its fingers.
2. An action is a sequence of `N_POSES` predicted poses. Between two of them a shape sweeps the
   convex hull of both.
3. The gap between two convex polygons is their largest separation along the normal of an edge of
   either: negative where they overlap, and never more than their distance. For a hull, these are
   the normals of the shape at both poses, and those of the motion.
4. The hand is lowered, moves, moves back and rises: all of it lies in the hull of its first and its
   last rectangle. In a push it ends where the push stops; in a drag it is open all the way, and
   moves as the object does.
5. An action is free where every gap is at least the margin: `START_M` at the start of the plan,
   growing with the object's distance from it to `MARGIN_M` at `FULL_AT_M`. A hull has the margin of
   its first pose, the hand that of the object's pose before the action; the last pose counts alone.
"""

import math
from collections.abc import Sequence

import numpy as np

from affordlib.geometry import circle, edge_normals, rectangle, rotated_each
from affordlib.perception import adapt_to_object, outline_of, radius_m
from affordlib.primitives import Primitive, Push, Rotate, min_jerk
from affordlib.types import Obstacle, Step, check_finite

DISC_SIDES, N_POSES = 16, 7
START_M, MARGIN_M, FULL_AT_M = 0.002, 0.004, 0.02
"""By `experiments.obstacles`: of what is predicted to pass by up to 2 cm more, 1 % may touch."""

FINGER_M = (0.02, 0.012)
"""Length and width [m] of a finger, along the hand's yaw and across it."""

HIGHEST_M = 0.13
"""Height [m] of obstacles that the fingers can touch, but not the palm or the arm."""

DEEPEST_M = 0.003
"""Overlap [m] of object and obstacle that may be an error of the image."""

FAR_M = 0.005
"""Gaps [m] above this, and so above every margin, are not distinguished by the check."""


def ring(radius_m: float) -> np.ndarray:
    """Return the corners (16, 2) [m] of the regular polygon around a circle."""
    return circle(radius_m / math.cos(math.pi / DISC_SIDES), DISC_SIDES)


def corners_of(obstacle: Obstacle) -> np.ndarray:
    """Return the corners (m, 2) [m] of an obstacle, counter-clockwise."""
    corners = np.array(obstacle.corners_m)
    return corners + ring(obstacle.radius_m) if obstacle.radius_m else corners


def placed(corners: np.ndarray, poses: np.ndarray) -> np.ndarray:
    """Return the corners (..., k, 2) of a shape (k, 2) at poses (..., 3)."""
    return rotated_each(corners, poses[..., 2, None]) + poses[..., None, :2]


def gaps_m(obstacles: Sequence[np.ndarray], shapes: np.ndarray, far_m: float = 0.01) -> np.ndarray:
    """Gaps [m] (n, s - 1), at most far_m, between polygons and what n shapes (n, s, k, 2) sweep."""
    (n, s, _, _), sides = shapes.shape, edge_normals(shapes)
    if not n:
        return np.empty((0, s - 1))
    way = (shapes[:, 1:] - shapes[:, :-1]).mean(axis=2, keepdims=True)
    across, long = np.stack([way[..., 1], -way[..., 0]], axis=-1), np.linalg.norm(way, axis=-1)
    moves = long[..., None] > 1e-9
    across = np.where(moves, across / np.maximum(long[..., None], 1e-9), sides[:, :-1, :1])
    # The hulls are the last axis of all arrays: corners (2, 2k, h), axes (2, a, h), middles (2, h).
    both = shapes[:, :-1], shapes[:, 1:]
    every = sides[:, :-1], sides[:, 1:], across, -across
    joined = (np.concatenate(parts, axis=2) for parts in (both, every))
    corners, axes = (parts.reshape(n * (s - 1), -1, 2).T for parts in joined)
    middles = corners.mean(axis=1)
    radius = np.hypot(*(corners - middles[:, None])).max(axis=0)
    gaps = np.full(len(radius), check_finite("far_m", far_m))
    for polygon in obstacles:
        centre, outward = polygon.mean(axis=0), edge_normals(polygon)
        size = np.linalg.norm(polygon - centre, axis=-1).max()
        near = np.flatnonzero(np.hypot(*(middles.T - centre).T) < radius + size + far_m)
        before = _products(outward.T[..., None], corners[..., near]).min(axis=1)
        before = (before - (polygon * outward).sum(axis=-1)[:, None]).max(axis=0)
        near, before = near[before < gaps[near]], before[before < gaps[near]]
        beyond = _products(axes[..., near], polygon.T[..., None]).min(axis=1)
        beyond = (beyond - _products(axes[..., near], corners[..., near]).max(axis=1)).max(axis=0)
        gaps[near] = np.minimum(gaps[near], np.maximum(before, beyond))
    return gaps.reshape(n, s - 1)


def _products(axes: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Inner products (a, k, h) of axes (2, a, h) and points (2, k, h)."""
    return axes[0][:, None] * points[0] + axes[1][:, None] * points[1]


def _gap_at(xy_m: Sequence[float], outline: np.ndarray, polygons: Sequence[np.ndarray]) -> float:
    """Gap [m] of an outline (k, 2) at (x, y) [m]."""
    return float(gaps_m(polygons, placed(outline, np.array([[[*xy_m, 0.0]] * 2]))).min())


class FreeSpace:
    """What is free of obstacles, for the object in an image (2, 48, 48) at a start (x, y) [m].

    outline_m: its corners (k, 2), by default from the image. An object that is nearer to an
    obstacle than `START_M` may leave it, but not come nearer.
    """

    def __init__(
        self,
        obstacles: Sequence[Obstacle],
        image: np.ndarray,
        start_xy_m: Sequence[float],
        outline_m: np.ndarray | None = None,
    ) -> None:
        self.obstacles, self.image = tuple(obstacles), image
        self.polygons = [corners_of(one) for one in obstacles]
        self.outline_m = outline_of(image) if outline_m is None else outline_m
        self.start_xy_m = np.array(start_xy_m)
        self.least_m = min(START_M, _gap_at(start_xy_m, self.outline_m, self.polygons))

    def check(self, goal_xy_m: Sequence[float]) -> None:
        """Raise ValueError for an obstacle that is too high, on the object or on the goal.

        An object covers its goal at least with the circle in its outline, however it has turned.
        """
        inner = ring((edge_normals(self.outline_m) * self.outline_m).sum(axis=1).min())
        for k, (one, polygon) in enumerate(zip(self.obstacles, self.polygons, strict=True)):
            name = f"obstacles[{k}]"
            if one.height_m > HIGHEST_M:
                raise ValueError(
                    f"{name} is {100 * one.height_m:.0f} cm high, and the palm would touch what is "
                    f"higher than {100 * HIGHEST_M:.0f} cm; plan with lower ones"
                )
            places = ("object", self.start_xy_m, self.outline_m), ("goal", goal_xy_m, inner)
            for what, (x, y), outline in places:
                if _gap_at((x, y), outline, [polygon]) < -DEEPEST_M:
                    raise ValueError(f"{name} lies on the {what} at ({x:.3f}, {y:.3f}) m; move it")

    def margin_m(self, xy_m: np.ndarray) -> np.ndarray:
        """Return the gap [m] (...) that an object at positions (..., 2) must keep."""
        from_start_m = np.linalg.norm(xy_m - self.start_xy_m, axis=-1)
        grown = np.minimum(from_start_m / FULL_AT_M, 1)
        return self.least_m + (MARGIN_M - self.least_m) * grown

    def spare_m(
        self, action: Primitive, direction_rad: np.ndarray, phase: np.ndarray, poses: np.ndarray
    ) -> np.ndarray:
        """Return gap minus margin [m] (n,) of pushes or drags; negative where they are not free.

        Where the hand is not free, the object's gap is not computed. action: any of them; phase:
        (n,), where they stop; poses: (n, s, 3), the object's x, y and rotation since its image was
        taken.
        """
        hand = np.empty((len(poses), 2, 3))
        if isinstance(action, Push):
            travel = min_jerk(phase)[:, None] * [action.radius + action.length]
            ahead = np.stack([np.cos(direction_rad), np.sin(direction_rad)], axis=-1)
            behind = poses[:, 0, :2] - action.radius * ahead
            hand[:, 0, :2], hand[:, 1, :2] = behind, behind + travel * ahead
            hand[..., 2] = direction_rad[:, None]
        else:
            hand[..., :2] = poses[:, [0, -1], :2]
            hand[..., 2] = adapt_to_object(action, self.image).grip_yaw + poses[:, 0, 2, None]
        spare = gaps_m(self.polygons, placed(hand_m(action), hand), FAR_M)[:, 0]
        spare = spare - self.margin_m(poses[:, 0, :2]).clip(0.0)
        poses = np.concatenate([poses, poses[:, -1:]], axis=1)[spare >= 0]  # the last alone
        gaps = gaps_m(self.polygons, placed(self.outline_m, poses), FAR_M)
        gaps = (gaps - self.margin_m(poses[:, :-1, :2])).min(axis=1)
        spare[spare >= 0] = np.minimum(spare[spare >= 0], gaps)
        return spare

    def is_free(self, step: Step) -> bool:
        """Return whether the hand can close around the object, at the end of a step, and turn."""
        turn_rad = Rotate.sweep_rad if isinstance(step.primitive, Rotate) else 0.0
        at = np.array(step.predicted_end_xy_m)
        yaws = step.primitive.grip_yaw + np.linspace(0, turn_rad, N_POSES)
        hand = np.column_stack([np.broadcast_to(at, (N_POSES, 2)), yaws])[None]
        shapes = hand_m(step.primitive), ring(radius_m(self.image))
        gap_m = min(gaps_m(self.polygons, placed(shape, hand)).min() for shape in shapes)
        return bool(gap_m >= max(self.margin_m(at), 0.0))


def hand_m(action: Primitive) -> np.ndarray:
    """Return the corners (4, 2) [m] of the rectangle of an action's open hand, at yaw 0."""
    length, width = FINGER_M
    return rectangle((length, action.opening_m + 2 * width))
