"""Estimates of an object's properties from its depth image alone.

Images are (2, 48, 48): depth [m] from a plane 1 m above the table, and the mask of the object
(at its edge, the covered share of the pixel). Rows run along -y and columns along +x of the table,
as on a map.
"""

import math
from dataclasses import replace
from operator import itemgetter

import numpy as np
from contourpy import contour_generator
from scipy import ndimage
from scipy.spatial import ConvexHull

from affordlib.geometry import cross, wrap_angle
from affordlib.primitives import Drag, Grasp, Primitive
from affordlib.types import CROP_WIDTH_M, IMAGE_PIXELS, NothingSeenError

CAMERA_HEIGHT_M = 1.0
_ROUND = 0.8  # curvature times radius of a round top, at least: 1 for a sphere, 0 for a box
_FALL_M = 0.01

_N_ANGLES = 360
_UNROUND = 0.01
"""A rotation is detected if the best angle fits better than the mean over all angles by more than
this share of the squared heights. Round objects reach at most 0.007 (one image of the ideal camera,
or the mean of eight of the Kinect); nearly all prisms reach 0.012 or more."""
_ALIKE = 0.1
"""Angles whose fit is worse than the best by less than this share of the contrast are ambiguous. A
cuboid turned by π is at most 0.05 worse, a wrong corner of a prism mostly 0.2 or more."""
_NEIGHBOURS = 2.3
"""Factor on the σ of independent pixels, as noise is correlated over several of them. These three
constants were chosen on 120 objects that occur in no table, seen at two places by both cameras."""


def heights_m(image: np.ndarray) -> np.ndarray:
    """Return the heights (48, 48) [m] above the table, zero outside the mask."""
    return np.where(image[1] > 0.5, CAMERA_HEIGHT_M - image[0], 0.0)


def object_height_m(image: np.ndarray) -> float:
    """Return the object's height [m]: the 98 % quantile over its pixels."""
    inside = heights_m(image)[image[1] > 0.5]
    return float(np.quantile(inside, 0.98)) if inside.size else 0.0


def _curvature(image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the principal curvatures (2,) [1/m] of the top, weakest first, and directions (2, 2).

    They are those of a paraboloid fitted to the heights away from the edge, where noise is small.
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
    """Return whether the top is curved like that of a sphere or a lying cylinder."""
    radius = min(object_height_m(image), CROP_WIDTH_M * math.sqrt((image[1] > 0.5).mean())) / 2
    return bool(-_curvature(image)[0][1] * radius > _ROUND)


def long_axis_rad(image: np.ndarray) -> float:
    """Return the direction of least curvature [rad] in [-π/2, π/2): a lying cylinder's axis."""
    x, y = _curvature(image)[1][0]
    return (math.atan2(y, x) + math.pi / 2) % math.pi - math.pi / 2


def looks_fallen(before: np.ndarray, after: np.ndarray) -> bool:
    """Return whether an object fell over: its height or its top (round or not) changed."""
    change = abs(object_height_m(after) - object_height_m(before))
    return bool(change > _FALL_M or looks_rollable(before) != looks_rollable(after))


def _heights_around(image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return heights [m] in polar coordinates around the centre of an object's top, and areas.

    Heights are (radii, angles); the areas [pixels] that each of them represents are (radii, 1).
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
    """Estimate an object's rotation between two images (2, n, n), in [-π, π), and its σ [rad].

    The heights around its centre are compared at every relative angle, and the best match is
    refined with a parabola. If several angles match (a cuboid turned by π), the one nearest to
    expected_rad is returned; None if all angles match (spheres and upright cylinders).
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
    """Return the largest distance [m] of the object's pixels from the middle of the image."""
    rows, columns = np.nonzero(image[1] > 0.5)
    if not len(rows):
        return 0.0
    middle = (len(image[1]) - 1) / 2
    pixels = float(np.hypot(rows - middle, columns - middle).max())
    return (pixels + 0.5) * CROP_WIDTH_M / len(image[1])


def largest_blob(mask: np.ndarray) -> np.ndarray:
    """Return the largest connected component of a mask, with its holes filled."""
    labels, _ = ndimage.label(mask)
    sizes = np.bincount(labels[mask], minlength=1)
    return ndimage.binary_fill_holes(mask & (labels == sizes.argmax()))


def adapt_to_object(primitive: Primitive, image: np.ndarray) -> Primitive:
    """Set those parameters of a primitive that are None from the image of the object.

    A drag closes its fingers across the object's axis; a grasp is lowered to the object's height.
    """
    if isinstance(primitive, Drag) and primitive.grip_yaw is None:
        return replace(primitive, grip_yaw=long_axis_rad(image))
    if isinstance(primitive, Grasp) and primitive.seen_height is None:
        return replace(primitive, seen_height=object_height_m(image))
    return primitive


def height_map(points: np.ndarray, centre_m: np.ndarray) -> np.ndarray:
    """Return the mean height [m] of points (n, 3) in each pixel of a crop, 0 where empty."""
    pixel = CROP_WIDTH_M / IMAGE_PIXELS
    at = np.floor((points[:, :2] - centre_m) / pixel + IMAGE_PIXELS / 2)
    inside = ((at >= 0) & (at < IMAGE_PIXELS)).all(axis=1)
    column, row = at[inside].astype(int).T
    cell = (IMAGE_PIXELS - 1 - row) * IMAGE_PIXELS + column
    count = np.bincount(cell, minlength=IMAGE_PIXELS**2)
    total = np.bincount(cell, weights=points[inside, 2], minlength=IMAGE_PIXELS**2)
    return (total / np.maximum(count, 1)).reshape(IMAGE_PIXELS, IMAGE_PIXELS)


def outline_of(image: np.ndarray, width_m: float = CROP_WIDTH_M) -> np.ndarray:
    """Return the corners (k, 2) [m] of the object's convex outline, from the image's middle.

    The rim is the contour at half of the object's height. Edges of its convex hull that are short
    or hardly change the shape are removed, and a line is fitted to the rim along each other edge.
    """
    near, n = ndimage.binary_dilation(image[1] > 0.5), len(image[1])
    if not near.any():
        raise NothingSeenError("image shows no object; take it of one on the table")
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
    """Remove edge k of a polygon by extending its neighbours; also return the change [pixels]."""
    a, b, c, d = (hull[(k + j) % len(hull)] for j in (-1, 0, 1, 2))
    turn, length = cross(b - a, d - c), np.linalg.norm(c - b)
    if turn < 1e-6:
        return math.inf, hull
    longer = (b - a) * cross(c - b, d - c) / turn
    fewer = hull.copy()
    fewer[k] = b + longer
    off = abs(float(cross(c - b, longer))) / length
    return min(off, length / 2), np.delete(fewer, (k + 1) % len(hull), axis=0)
