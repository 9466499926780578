"""Cameras: top-down depth images of the object for the robot, and colour pictures for people.

The mask of a depth image is thresholded depth: all points above the table.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pybullet
from pybullet_utils.bullet_client import BulletClient
from scipy import ndimage

from affordlib.perception import CAMERA_HEIGHT_M, height_map, largest_blob
from affordlib.types import (
    CROP_WIDTH_M,
    IMAGE_PIXELS,
    LEVER_CROP_WIDTH_M,
    LEVER_IMAGE_PIXELS,
    TABLE_X_M,
    TABLE_Y_M,
    Checked,
    NothingSeenError,
    Observation,
    number,
    point,
)
from affordlib.world.robot import BASE_X_M

_NEAR_M, _FAR_M = 0.5, 1.1
_MASK_HEIGHT_M, _KINECT_MASK_HEIGHT_M = 0.004, 0.012

RAYS_PER_SIDE = 3
"""Rays per side of a pixel of the ideal camera. FiLM trained on 500 pushes has an error of 1.09 mm
with one ray per pixel, 0.87 mm with 4, 0.83 mm with 16."""

_TABLE_XY_M = np.array([sum(TABLE_X_M), sum(TABLE_Y_M)]) / 2
KINECT_HEIGHT_M, KINECT_FOCAL_PX, KINECT_BASELINE_M = 1.3, 575.0, 0.075
KINECT_STD_M = 0.0008
"""σ of an object's position [m]: measured for spheres, 0.4 mm of bias and 0.4 mm of noise along
each axis; for cuboids 0.6 mm."""

_RENDERER = {"renderer": pybullet.ER_TINY_RENDERER, "flags": pybullet.ER_NO_SEGMENTATION_MASK}


def _distance_m(
    client: BulletClient, view: tuple, projection: np.ndarray, shape: tuple
) -> np.ndarray:
    """Render the distance [m] from the camera's plane, (rows, columns).

    TinyRenderer encodes every depth buffer as if the projection were a perspective one.
    """
    rows, columns = shape
    matrix = projection.T.ravel().tolist()
    image = client.getCameraImage(columns, rows, view, matrix, shadow=0, **_RENDERER)
    buffer = np.asarray(image[3], dtype=np.float64).reshape(rows, columns)
    far = projection[2, 3] / (projection[2, 2] + 1)
    near = projection[2, 3] / (projection[2, 2] - 1)
    return far * near / (far - buffer * (far - near))


def depth_crop(client: BulletClient, x: float, y: float, lever_rad: float | None) -> np.ndarray:
    """Render depth [m] and mask (2, n, n) of the square around (x, y) [m], as float32.

    Columns run along the table's x axis, or in a lever-up's larger image along the lever, rows at
    π/2 clockwise from it. A pixel is the mean of samples x samples rays (of a lever-up one ray), so
    at the object's edge the mask is the covered share.
    """
    pixels, width_m, samples, turn_rad = IMAGE_PIXELS, CROP_WIDTH_M, RAYS_PER_SIDE, 0.0
    if lever_rad is not None:
        pixels, width_m, samples = LEVER_IMAGE_PIXELS, LEVER_CROP_WIDTH_M, 1
        turn_rad = lever_rad
    up = (-math.sin(turn_rad), math.cos(turn_rad), 0)
    view = pybullet.computeViewMatrix((x, y, CAMERA_HEIGHT_M), (x, y, 0), up)
    fine, depth_range = pixels * samples, _FAR_M - _NEAR_M
    projection = np.diag([2 / width_m, 2 / width_m, -2 / depth_range, 1.0])
    # TinyRenderer samples pixels at their corners; half a pixel moves the samples to their centres.
    projection[:2, 3] = -1 / fine
    projection[2, 3] = -(_FAR_M + _NEAR_M) / depth_range
    depth = _distance_m(client, view, projection, (fine, fine))
    rays = np.stack([depth, depth < CAMERA_HEIGHT_M - _MASK_HEIGHT_M])
    blocks = rays.reshape(2, pixels, samples, pixels, samples)
    return blocks.mean(axis=(2, 4)).astype(np.float32)


def ideal(
    client: BulletClient, xy_m: np.ndarray, bias_m: tuple, rng: np.random.Generator
) -> Observation:
    """Observe the object at (x, y) [m] from straight above, with parallel rays and no noise."""
    x, y = (xy_m + bias_m).tolist()
    return Observation((x, y), depth_crop(client, x, y, None))


def kinect(
    client: BulletClient, xy_m: np.ndarray, bias_m: tuple, rng: np.random.Generator
) -> Observation:
    """Find the object with a noisy Kinect above the table's centre, whatever its xy_m.

    The points of the Kinect's image are projected vertically, and the image is centred on the
    object as seen. Raises NothingSeenError if there is nothing on the table.
    """
    table = TABLE_X_M[1] - TABLE_X_M[0], TABLE_Y_M[1] - TABLE_Y_M[0]
    coarse = _kinect_points(client, _TABLE_XY_M, table, 4, rng)
    high = coarse[coarse[:, 2] > _KINECT_MASK_HEIGHT_M]
    if not len(high):
        raise NothingSeenError("the camera sees no object on the table; call place(...) first")
    xy = np.median(high[:, :2], axis=0)
    for _ in range(2):
        points = _kinect_points(client, xy, (1.5 * CROP_WIDTH_M, 1.5 * CROP_WIDTH_M), 1, rng)
        height = height_map(points, xy)
        mask = largest_blob(height > _KINECT_MASK_HEIGHT_M)
        if mask.any():
            # Only walls that face the camera are visible, which biases the centroid towards it;
            # for points above 45 % of the height (measured) the bias is negligible.
            top = mask & (height > 0.45 * np.quantile(height[mask], 0.9))
            row, column = np.subtract(ndimage.center_of_mass(top), (IMAGE_PIXELS - 1) / 2)
            xy = xy + np.array([column, -row]) * (CROP_WIDTH_M / IMAGE_PIXELS)
    height = height_map(points, xy)
    mask = largest_blob(height > _KINECT_MASK_HEIGHT_M)
    image = np.stack([CAMERA_HEIGHT_M - height, mask]).astype(np.float32)
    x, y = (xy + bias_m).tolist()
    return Observation((x, y), image, std_m=KINECT_STD_M)


CAMERAS: dict[str, Callable[..., Observation]] = {"ideal": ideal, "kinect": kinect}
"""The robot's cameras by name. Each observes the object that lies at xy_m: (2,), in a client, with
noise from a generator; bias_m: error (2,) that is added to the position."""


def _kinect_points(
    client: BulletClient, centre_m: np.ndarray, width_m: tuple, step: int, rng: np.random.Generator
) -> np.ndarray:
    """Simulate the points (n, 3) [m] that a Kinect measures in a window, every `step`-th pixel.

    Depth is noisy and quantised in disparity; pixels are displaced by about one pixel at random.
    """
    pitch = step / KINECT_FOCAL_PX
    columns, rows = (math.ceil(w / KINECT_HEIGHT_M / pitch) for w in width_m)
    tangent = (centre_m - _TABLE_XY_M) / KINECT_HEIGHT_M
    half = np.array([columns, rows]) * pitch / 2
    near, far = 0.8, 1.4
    projection = np.zeros((4, 4))
    projection[0, 0], projection[1, 1] = 1 / half
    # The shift by half a pixel, as above, expressed as a shift of the tangent.
    projection[:2, 2] = tangent / half + 1 / np.array([columns, rows])
    projection[2, 2:] = -(far + near) / (far - near), -2 * far * near / (far - near)
    projection[3, 2] = -1
    stand = _TABLE_XY_M.tolist()
    view = pybullet.computeViewMatrix((*stand, KINECT_HEIGHT_M), (*stand, 0), (0, 1, 0))
    distance = _distance_m(client, view, projection, (rows, columns))

    jitter = rng.normal(0, 0.8 / step, size=(2, rows, columns)) + np.indices((rows, columns))
    row, column = np.rint(jitter).astype(int)
    distance = distance[row.clip(0, rows - 1), column.clip(0, columns - 1)]
    deviation = 0.0012 + 0.0019 * (distance - 0.4) ** 2
    distance = distance + rng.normal(size=distance.shape) * deviation
    focal = KINECT_FOCAL_PX * KINECT_BASELINE_M
    distance = focal / (np.rint(8 * focal / distance) / 8)
    x = stand[0] + (tangent[0] - half[0] + pitch * (np.arange(columns) + 0.5))[None] * distance
    y = stand[1] + (tangent[1] + half[1] - pitch * (np.arange(rows) + 0.5))[:, None] * distance
    return np.stack([x, y, KINECT_HEIGHT_M - distance], axis=-1).reshape(-1, 3)


_FLOOR_M = -0.74
HIDDEN_M = 1.0
"""Depth [m] below their place at which bodies wait that pictures show, but no robot's camera."""

SCENERY = (
    ((1.7, 1.7, 0.05), (0.0, 0.0, _FLOOR_M - 0.05), (0.86, 0.87, 0.88)),
    ((0.1, 0.1, -_FLOOR_M / 2), (BASE_X_M, 0.0, _FLOOR_M / 2), (0.35, 0.37, 0.40)),
    *(
        ((0.03, 0.03, -_FLOOR_M / 2 - 0.05), (x, y, _FLOOR_M / 2 - 0.05), (0.45, 0.42, 0.40))
        for x in (-0.45, 0.65)
        for y in (-0.65, 0.65)
    ),
)
"""Half extents, centre [m] and colour of boxes: a floor, the arm's pedestal, the table's legs."""


def add_scenery(client: BulletClient) -> list[int]:
    """Add hidden bodies on which arm and table stand in pictures; return their ids."""
    bodies = []
    for half, (x, y, z), rgb in SCENERY:
        box = {"shapeType": pybullet.GEOM_BOX, "halfExtents": half, "rgbaColor": (*rgb, 1)}
        shape, at = client.createVisualShape(**box), (x, y, z - HIDDEN_M)
        bodies.append(client.createMultiBody(baseVisualShapeIndex=shape, basePosition=at))
    return bodies


@dataclass(frozen=True)
class View(Checked):
    """The view of a picture: the camera looks at a point (x, y, z) from a distance."""

    at_m: tuple[float, float, float] = point(3, 2.0, (-0.2, 0.0, 0.33))
    distance_m: float = number(0.2, 3.0, "m", 1.7)
    yaw_deg: float = number(-360.0, 360.0, "°", 28.0)  # 0: along y
    pitch_deg: float = number(-90.0, 0.0, "°", -24.0)  # -90: straight down
    field_deg: float = number(1.0, 120.0, "°", 45.0)  # vertical field of view

    def picture(
        self, client: BulletClient, hidden: list[int], width: int, height: int
    ) -> np.ndarray:
        """Render a colour picture (height, width, 3), uint8, with the hidden bodies."""
        view = pybullet.computeViewMatrixFromYawPitchRoll(
            self.at_m, self.distance_m, self.yaw_deg, self.pitch_deg, roll=0, upAxisIndex=2
        )
        projection = pybullet.computeProjectionMatrixFOV(self.field_deg, width / height, 0.1, 4.0)
        light = {"lightDirection": (0.6, -0.7, 1.6), "lightDistance": 3.0, "shadow": 1}
        _raise(client, hidden, HIDDEN_M)
        # Rendered at twice the size and averaged, since TinyRenderer does no anti-aliasing.
        _, _, rgba, _, _ = client.getCameraImage(
            *(2 * width, 2 * height, view, projection), **light, **_RENDERER
        )
        _raise(client, hidden, -HIDDEN_M)
        rgb = np.asarray(rgba, dtype=np.uint16).reshape(height, 2, width, 2, 4)[..., :3]
        return (rgb.sum(axis=(1, 3)) // 4).astype(np.uint8)


def _raise(client: BulletClient, bodies: list[int], up_m: float) -> None:
    for body in bodies:
        (x, y, z), turn = client.getBasePositionAndOrientation(body)
        client.resetBasePositionAndOrientation(body, (x, y, z + up_m), turn)
