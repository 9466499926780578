"""What the robot can tell about an object from its depth image alone.

Images are (2, 48, 48): depth [m] from a plane 1 m above the table, and the mask of the object
(at its rim the share of a pixel that it covers). Rows run along -y and columns along +x of the
table, as a map is read.
"""

import math
from dataclasses import replace
from operator import itemgetter

import numpy as np
from contourpy import contour_generator
from matplotlib.path import Path
from scipy import ndimage
from scipy.spatial import ConvexHull

from affordlib.geometry import cross, wrap_angle
from affordlib.primitives import Drag, Grasp, Primitive
from affordlib.types import CROP_WIDTH_M, IMAGE_PIXELS, check_array, check_pair, check_within

CAMERA_HEIGHT_M = 1.0
_ROUND = 0.8
"""Curvature times radius above which a top counts as round: 1 for a sphere, 0 for a box."""
_FALL_M = 0.01

_N_ANGLES = 360
_UNROUND = 0.01
"""How much better the turned image of an object must fit than the mean over all angles, as a share
of its squared heights, for the turn to be seen. Of round objects it is at most 0.007 (one image of
the ideal camera, the mean of eight of the Kinect), of nearly all prisms 0.012 and more."""
_ALIKE = 0.1
"""Angles fit alike that are worse than the best by less than this share of the mean. Half a round
of a cuboid is at most 0.05 worse, a wrong corner of a prism mostly 0.2 and more."""
_NEIGHBOURS = 2.3
"""Errors are so many times those of independent pixels: noise reaches over several. The three were
chosen on 120 objects that no table has, each seen at two places by both cameras."""


def heights_m(image: np.ndarray) -> np.ndarray:
    """Height [m] above the table, zero outside the mask; (48, 48)."""
    return np.where(image[1] > 0.5, CAMERA_HEIGHT_M - image[0], 0.0)


def object_height_m(image: np.ndarray) -> float:
    """Height of the object [m]: of all but the highest 2 % of its pixels."""
    inside = heights_m(image)[image[1] > 0.5]
    return float(np.quantile(inside, 0.98)) if inside.size else 0.0


def _curvature(image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Principal curvatures (2,) [1/m] of the top, weakest first, and their directions (2, 2).

    Of a paraboloid fitted to the heights away from the rim, which noise hardly moves.
    """
    mask = image[1] > 0.5
    for rim in (3, 2, 1):
        inside = ndimage.binary_erosion(mask, iterations=rim)
        if inside.sum() >= 20:
            break
    else:
        return np.zeros(2), np.eye(2)
    rows, columns = np.nonzero(inside)
    pixel = CROP_WIDTH_M / len(inside)
    x, y = pixel * (columns - columns.mean()), pixel * (rows.mean() - rows)
    terms = np.column_stack([np.ones_like(x), x, y, x * x / 2, x * y, y * y / 2])
    _, _, _, xx, xy, yy = np.linalg.lstsq(terms, heights_m(image)[inside], rcond=None)[0]
    values, vectors = np.linalg.eigh([[xx, xy], [xy, yy]])
    order = np.argsort(np.abs(values))
    return values[order], vectors[:, order].T


def looks_rollable(image: np.ndarray) -> bool:
    """Whether the top is curved like that of something round which lies on the table."""
    radius = min(object_height_m(image), CROP_WIDTH_M * math.sqrt((image[1] > 0.5).mean())) / 2
    return bool(-_curvature(image)[0][1] * radius > _ROUND)


def long_axis_rad(image: np.ndarray) -> float:
    """Direction [rad], in [-π/2, π/2), along which the top bends least: a lying cylinder's axis."""
    x, y = _curvature(image)[1][0]
    return (math.atan2(y, x) + math.pi / 2) % math.pi - math.pi / 2


def looks_fallen(before: np.ndarray, after: np.ndarray) -> bool:
    """Whether an object lies differently than before: other height or other kind of top."""
    change = abs(object_height_m(after) - object_height_m(before))
    return bool(change > _FALL_M or looks_rollable(before) != looks_rollable(after))


def _heights_around(image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Heights [m] around the centre of an object's top, and the areas [pixels] they stand for.

    Both are (radii, angles); the latter (radii, 1).
    """
    near = ndimage.binary_dilation(image[1] > 0.5)
    height = np.where(near, CAMERA_HEIGHT_M - image[0].astype(float), 0.0)
    top = height * (height > 0.45 * object_height_m(image))
    row, column = ndimage.center_of_mass(top)
    radius = np.arange(0.5, len(height) / 2)[:, None]
    angle = 2 * math.pi / _N_ANGLES * np.arange(_N_ANGLES)
    at = row - radius * np.sin(angle), column + radius * np.cos(angle)
    return ndimage.map_coordinates(height, at, order=1), radius * angle[1]


def turn_between(
    before: np.ndarray, after: np.ndarray, expected_rad: float | None = None
) -> tuple[float, float] | None:
    """How far an object has turned between two images (2, n, n), in [-π, π), and its σ [rad].

    The heights around its centre are laid over each other at every angle, and the best is refined
    by a parabola. Of angles that fit alike, as of a cuboid half a round apart, it is the nearest to
    expected_rad. None where all look alike: of spheres and upright cylinders.
    """
    (then, area), (now, _) = _heights_around(before), _heights_around(after)
    overlap = np.fft.rfft(now, axis=1) * np.fft.rfft(then, axis=1).conj()
    power = (area * (then**2 + now**2)).sum()
    left = power * (1 + 1e-9) - 2 * np.fft.irfft((area * overlap).sum(axis=0), _N_ANGLES)
    best, contrast = left.min(), left.mean() - left.min()
    if contrast < _UNROUND * (area * now**2).sum():
        return None
    step, following, preceding = 2 * math.pi / _N_ANGLES, np.roll(left, -1), np.roll(left, 1)
    fits = (left <= preceding) & (left < following) & (left <= best + _ALIKE * contrast)
    at = np.flatnonzero(fits)
    bend = (following - 2 * left + preceding)[at]
    turns = step * (at + (preceding - following)[at] / (2 * bend))
    off = left[at] if expected_rad is None else -np.cos(turns - expected_rad)
    k = int(off.argmin())
    n_pixels = (after[1] > 0.5).sum() / _NEIGHBOURS**2
    return wrap_angle(float(turns[k])), step * math.sqrt(2 * left[at[k]] / (n_pixels * bend[k]))


def radius_m(image: np.ndarray) -> float:
    """How far the object reaches from the middle of the image [m], seen from above."""
    rows, columns = np.nonzero(image[1] > 0.5)
    if not len(rows):
        return 0.0
    middle = (len(image[1]) - 1) / 2
    pixels = float(np.hypot(rows - middle, columns - middle).max())
    return (pixels + 0.5) * CROP_WIDTH_M / len(image[1])


def largest_blob(mask: np.ndarray) -> np.ndarray:
    """The largest connected part of a mask, its holes filled."""
    labels, n = ndimage.label(mask)
    if n == 0:
        return np.zeros_like(mask, dtype=bool)
    sizes = ndimage.sum_labels(mask, labels, np.arange(1, n + 1))
    return ndimage.binary_fill_holes(labels == 1 + int(np.argmax(sizes)))


def centre_m(mask: np.ndarray) -> tuple[float, float]:
    """Centroid (x, y) [m] of a mask (n, n), `CROP_WIDTH_M` wide, relative to the image's middle."""
    rows, columns = np.nonzero(mask)
    middle, pixel = (len(mask) - 1) / 2, CROP_WIDTH_M / len(mask)
    return float((columns.mean() - middle) * pixel), float((middle - rows.mean()) * pixel)


def adapt_to_object(primitive: Primitive, image: np.ndarray) -> Primitive:
    """The primitive as it suits the object in the image; what was given is kept.

    A drag closes its fingers across the axis, a grasp goes by the height.
    """
    if isinstance(primitive, Drag) and primitive.grip_yaw is None:
        return replace(primitive, grip_yaw=long_axis_rad(image))
    if isinstance(primitive, Grasp) and primitive.seen_height is None:
        return replace(primitive, seen_height=object_height_m(image))
    return primitive


def height_map(
    points: np.ndarray, centre_m: tuple[float, float], width_m: float = CROP_WIDTH_M
) -> np.ndarray:
    """Mean height [m] of points (n, 3) in each pixel of a crop, seen from above; gaps are table."""
    pixel = width_m / IMAGE_PIXELS
    at = np.floor((points[:, :2] - np.array(centre_m)) / pixel + IMAGE_PIXELS / 2)
    inside = ((at >= 0) & (at < IMAGE_PIXELS)).all(axis=1)
    column, row = at[inside].astype(int).T
    cell = (IMAGE_PIXELS - 1 - row) * IMAGE_PIXELS + column
    count = np.bincount(cell, minlength=IMAGE_PIXELS**2)
    total = np.bincount(cell, weights=points[inside, 2], minlength=IMAGE_PIXELS**2)
    return (total / np.maximum(count, 1)).reshape(IMAGE_PIXELS, IMAGE_PIXELS)


def crop_from_depth(
    depth: np.ndarray,
    intrinsics: tuple[float, float, float, float],
    camera_pose: np.ndarray,
    centre: tuple[float, float],
    width_m: float = CROP_WIDTH_M,
    noise_m: float = 0.004,
) -> np.ndarray:
    """Depth [m] and mask (2, 48, 48) of an object, seen by a camera of one's own.

    depth: (rows, columns) [m] along the optical axis, zero where not known; intrinsics: focal
    lengths and principal point fx, fy, cx, cy [px]; camera_pose: (4, 4), to the world, whose z is
    up and 0 on the table, from the camera, whose z looks ahead and y down; centre: (x, y) [m] of
    the crop; noise_m: what is higher than this is the object.
    """
    depth, pose = check_array("depth", depth), check_array("camera_pose", camera_pose, 4, 4)
    focal_and_middle = check_array("intrinsics", intrinsics, 4)
    if depth.ndim != 2 or pose.ndim != 2 or focal_and_middle.ndim != 1:
        raise ValueError(f"depth must be an image (rows, columns), got {depth.shape}")
    fx, fy, cx, cy = focal_and_middle
    width_m = check_within("width_m", width_m, 0.01, 10.0, "m")
    row, column = np.nonzero(depth > 0)
    z = depth[row, column]
    ray = np.stack([(column - cx) / fx, (row - cy) / fy, np.ones_like(z), 1 / z], axis=1)
    points = (z[:, None] * ray) @ pose[:3].T
    height = height_map(points, check_pair("centre", centre), width_m)
    mask = largest_blob(height > check_within("noise_m", noise_m, 0.0, 0.1, "m"))
    return np.stack([CAMERA_HEIGHT_M - height, mask]).astype(np.float32)


def outline_image(
    outline_m: np.ndarray, width_m: float = CROP_WIDTH_M, height_m: float = 0.05
) -> np.ndarray:
    """Depth [m] and mask (2, 48, 48) of a prism with corners (k, 2) [m] around the image's middle.

    A pixel is the mean of 3 x 3 rays, as of the ideal camera.
    """
    rays = 3
    n = rays * IMAGE_PIXELS
    at = width_m * ((np.arange(n) + 0.5) / n - 0.5)
    x, y = np.meshgrid(at, -at)
    inside = Path(outline_m).contains_points(np.column_stack([x.ravel(), y.ravel()]))
    mask = inside.reshape(IMAGE_PIXELS, rays, IMAGE_PIXELS, rays).mean(axis=(1, 3))
    return np.stack([CAMERA_HEIGHT_M - height_m * mask, mask]).astype(np.float32)


def outline_of(image: np.ndarray, width_m: float = CROP_WIDTH_M) -> np.ndarray:
    """Corners (k, 2) [m] of the convex outline of an image's object, around the image's middle.

    The rim is where half of the object's height is seen. Its hull loses edges that are short, or
    hardly cut a corner off; to the rim along each edge left a line is fitted.
    """
    near, n = ndimage.binary_dilation(image[1] > 0.5), len(image[1])
    cover = np.where(near, CAMERA_HEIGHT_M - image[0], 0.0) / object_height_m(image)
    rims = contour_generator(z=np.pad(np.clip(cover, 0, 1), 1)).lines(0.5)
    rim = (max(rims, key=len)[:-1] - (n + 1) / 2) * [1, -1]  # in pixels
    hull = rim[ConvexHull(rim).vertices]
    while len(hull) > 3:
        off, fewer = min((_without_edge(hull, k) for k in range(len(hull))), key=itemgetter(0))
        if off > 1.0 and len(hull) <= 12:
            break
        hull = fewer
    lines = []
    for start, edge in zip(hull, np.roll(hull, -1, axis=0) - hull, strict=True):
        along, across = (rim - start) @ edge / (edge @ edge), cross(edge, rim - start)
        near = (np.abs(along - 0.5) < 0.4) & (np.abs(across) < 1.5 * np.linalg.norm(edge))
        on = rim[near] if near.sum() > 3 else np.array([start, start + edge])
        normal = np.linalg.svd(on - on.mean(axis=0))[2][1]
        lines.append([*normal, normal @ on.mean(axis=0)])
    pairs = np.stack([np.roll(lines, 1, axis=0), lines], axis=1)
    met = np.linalg.solve(pairs[..., :2], pairs[..., 2:])[..., 0]
    is_near = np.linalg.norm(met - hull, axis=1, keepdims=True) < 1.5
    return np.where(is_near, met, hull) * width_m / n


def _without_edge(hull: np.ndarray, k: int) -> tuple[float, np.ndarray]:
    """A polygon whose edges beside edge k go on to meet, and how far off, or half k's length."""
    a, b, c, d = (hull[(k + j) % len(hull)] for j in (-1, 0, 1, 2))
    turn, length = cross(b - a, d - c), np.linalg.norm(c - b)
    if turn < 1e-6:
        return math.inf, hull
    longer = (b - a) * cross(c - b, d - c) / turn
    fewer = hull.copy()
    fewer[k] = b + longer
    off = abs(float(cross(c - b, longer))) / length
    return min(off, length / 2), np.delete(fewer, (k + 1) % len(hull), axis=0)
