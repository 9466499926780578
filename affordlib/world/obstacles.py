"""Obstacles: fixed bodies that object and arm can touch, and that are in pictures only.

The robot knows where they are; its depth cameras do not see them.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pybullet
from pybullet_utils.bullet_client import BulletClient

from affordlib.geometry import edge_normals, extruded
from affordlib.types import Obstacle
from affordlib.world.camera import HIDDEN_M
from affordlib.world.objects import HULL_MARGIN_M, mesh, set_friction


class PlacedObstacles:
    """The obstacles in a client, with the lateral friction of the table.

    shown: ids of the bodies in pictures; touched: numbers of the obstacles that were touched so
    far, each with "object" or "arm".
    """

    def __init__(
        self, client: BulletClient, obstacles: Sequence[Obstacle], friction: float
    ) -> None:
        self.client, self.all = client, tuple(obstacles)
        self.shown: list[int] = []
        self.touched: set[tuple[int, str]] = set()
        self._felt: list[int] = []
        for one in self.all:
            felt, seen, at = _shapes(one)
            # Without a shape of its own to be seen, a body would be seen as what is felt.
            never = client.createVisualShape(**seen, visualFramePosition=(0, 0, -2 * HIDDEN_M))
            shape = client.createCollisionShape(**felt), never
            self._felt.append(client.createMultiBody(0, *shape, basePosition=at))
            set_friction(client, self._felt[-1], -1, friction)
            shown = client.createVisualShape(**seen, rgbaColor=(0.55, 0.45, 0.38, 1.0))
            at = {"basePosition": np.subtract(at, (0, 0, HIDDEN_M)).tolist()}
            self.shown.append(client.createMultiBody(baseVisualShapeIndex=shown, **at))

    def remove(self) -> None:
        """Remove the bodies from the client."""
        for body in (*self._felt, *self.shown):
            self.client.removeBody(body)

    def overlapping(self, body: int) -> list[int]:
        """Return the numbers of the obstacles that overlap a body."""
        close = self.client.getClosestPoints
        pairs = ((k, close(body, felt, 0.0)) for k, felt in enumerate(self._felt))
        return [k for k, points in pairs if any(point[8] < -1e-3 for point in points)]

    def feel(self, body: int, arm: int) -> None:
        """Note which obstacles the object's body and the arm touch at present."""
        for k, felt in enumerate(self._felt):
            for name, other in (("object", body), ("arm", arm)):
                contacts = self.client.getContactPoints(other, felt)
                if sum(contact[9] for contact in contacts) > 0.0:
                    self.touched.add((k, name))


def _shapes(one: Obstacle) -> tuple[dict[str, Any], dict[str, Any], tuple[float, ...]]:
    """Return arguments for PyBullet: the shape that is felt, the one seen, and their position."""
    if one.radius_m:
        disc = {"shapeType": pybullet.GEOM_CYLINDER, "radius": one.radius_m}
        at = (*one.corners_m[0], one.height_m / 2)
        return disc | {"height": one.height_m}, disc | {"length": one.height_m}, at
    corners = np.array(one.corners_m)
    outward = edge_normals(corners)
    before = np.roll(outward, 1, axis=0)
    inset = HULL_MARGIN_M / (1 + (outward * before).sum(axis=1, keepdims=True))
    inner = corners - inset * (outward + before)
    felt = extruded(inner, HULL_MARGIN_M, one.height_m - HULL_MARGIN_M).tolist()
    seen = mesh([extruded(corners, 0.0, one.height_m)])
    return {"shapeType": pybullet.GEOM_MESH, "vertices": felt}, seen, (0.0, 0.0, 0.0)
