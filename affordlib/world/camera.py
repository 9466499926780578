"""What the robot sees: a top-down depth image of the object, and pictures for people.

The depth camera hangs vertically above the object and is rectified: its rays are parallel, so the
crop does not depend on where on the table the object stands. Depth is the distance [m] from the
camera's plane; the mask is read from the depth (what stands above the table), not told.
"""

from __future__ import annotations

import numpy as np
import pybullet

from affordlib.types import CROP_WIDTH_M, IMAGE_PIXELS

CAMERA_HEIGHT_M = 1.0
_NEAR_M, _FAR_M = 0.5, 1.1
_MASK_HEIGHT_M = 0.004


def _orthographic(half_width_m: float) -> np.ndarray:
    """The 4x4 projection of parallel rays, shifted by half a pixel.

    TinyRenderer samples pixels at their corners; the shift makes it their centres.
    """
    depth_range = _FAR_M - _NEAR_M
    projection = np.diag([1 / half_width_m, 1 / half_width_m, -2 / depth_range, 1.0])
    projection[:2, 3] = -1 / IMAGE_PIXELS
    projection[2, 3] = -(_FAR_M + _NEAR_M) / depth_range
    return projection


def _distance_m(buffer: np.ndarray, projection: np.ndarray) -> np.ndarray:
    """Distance from the camera's plane [m], given the renderer's depth buffer.

    TinyRenderer warps every buffer as if the projection were a perspective one.
    """
    far = projection[2, 3] / (projection[2, 2] + 1)
    near = projection[2, 3] / (projection[2, 2] - 1)
    return far * near / (far - buffer * (far - near))


def depth_crop(client: int, xy_m: tuple[float, float]) -> np.ndarray:
    """Depth [m] and mask (2, 48, 48) of the 0.16 m square around (x, y), as float32.

    Rows run along -y and columns along +x of the table, as a map is read.
    """
    x, y = xy_m
    view = pybullet.computeViewMatrix((x, y, CAMERA_HEIGHT_M), (x, y, 0), (0, 1, 0))
    projection = _orthographic(CROP_WIDTH_M / 2)
    _, _, _, buffer, _ = pybullet.getCameraImage(
        IMAGE_PIXELS,
        IMAGE_PIXELS,
        view,
        projection.T.ravel().tolist(),
        renderer=pybullet.ER_TINY_RENDERER,
        flags=pybullet.ER_NO_SEGMENTATION_MASK,
        shadow=0,
        physicsClientId=client,
    )
    buffer = np.asarray(buffer, dtype=np.float64).reshape(IMAGE_PIXELS, IMAGE_PIXELS)
    depth = _distance_m(buffer, projection)
    mask = depth < CAMERA_HEIGHT_M - _MASK_HEIGHT_M
    return np.stack([depth, mask]).astype(np.float32)


def picture(client: int, width: int = 320, height: int = 240) -> np.ndarray:
    """A colour picture (height, width, 3), uint8, of the robot at work, for people."""
    view = pybullet.computeViewMatrixFromYawPitchRoll(
        (-0.05, 0.0, 0.06), distance=1.0, yaw=62, pitch=-33, roll=0, upAxisIndex=2
    )
    projection = pybullet.computeProjectionMatrixFOV(45, width / height, 0.1, 4.0)
    # Twice the size, halved: TinyRenderer has jagged edges.
    _, _, rgba, _, _ = pybullet.getCameraImage(
        2 * width,
        2 * height,
        view,
        projection,
        lightDirection=(0.6, -0.7, 1.6),
        lightDistance=3.0,
        shadow=1,
        renderer=pybullet.ER_TINY_RENDERER,
        flags=pybullet.ER_NO_SEGMENTATION_MASK,
        physicsClientId=client,
    )
    rgb = np.asarray(rgba, dtype=np.float32).reshape(height, 2, width, 2, 4)[..., :3]
    return rgb.mean(axis=(1, 3)).astype(np.uint8)
