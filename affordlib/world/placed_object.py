"""An object in a PyBullet client: its body, how it lies, and what may disturb it."""

import math
from typing import Any

import numpy as np
import pybullet
from pybullet_utils.bullet_client import BulletClient
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from affordlib.geometry import rotated
from affordlib.types import (
    TABLE_X_M,
    TABLE_Y_M,
    check_array,
    check_finite,
    check_on_table,
    check_within,
)
from affordlib.world.objects import TabletopObject, WorldConfig

ROLLING_M, BRAKED_ROLLING_M = 1e-4, 1e-3
"""Rolling friction [m] of all bodies, and of a round object that is left alone.

Bullet multiplies each by the lateral friction of the other body: 0.1 and 0.55 mm in all.
"""

_TOPPLING = 1.5
"""Times the energy that brings an object onto its edge: some of it is lost in sliding."""


def poses(states: np.ndarray) -> np.ndarray:
    """(n, 5) channels `EFFECT_CHANNELS` (absolute) of states (n, 7), position and quaternion.

    Yaw is the heading of the body's x axis (of its y axis where x points up), unwrapped.
    """
    x, y, z, w = states[:, 3:].T
    ax = np.stack([1 - 2 * (y * y + z * z), 2 * (x * y + z * w)], axis=1)
    ay = np.stack([2 * (x * y - z * w), 1 - 2 * (x * x + z * z)], axis=1)
    yaw = np.arctan2(ax[:, 1], ax[:, 0])
    lying = np.hypot(*ax.T) < 0.5
    yaw = np.where(lying, np.arctan2(-ay[:, 0], ay[:, 1]), yaw)
    tilt = np.arccos(np.clip(1 - 2 * (x * x + y * y), -1.0, 1.0))
    return np.column_stack([states[:, :3], np.unwrap(yaw), tilt])


def set_friction(client: BulletClient, body: int, link: int, lateral: float, **more: float) -> None:
    """Give a link of a body a lateral friction, and what all bodies have in common."""
    common = {"spinningFriction": 1e-3, "rollingFriction": ROLLING_M, "restitution": 0.0}
    client.changeDynamics(body, link, lateralFriction=lateral, **common, **more)


class PlacedObject:
    """An object that stands on the table of a client, at (x, y) [m], turned by a yaw."""

    def __init__(
        self,
        client: BulletClient,
        obj: TabletopObject,
        config: WorldConfig,
        xy_m: tuple,
        yaw_rad: float,
    ) -> None:
        self.client, self.obj = client, obj
        self._centre_of_mass_m = np.array(config.com_offset_m)
        shape = obj.shape()
        frame, seen = shape.pop("frame", (0, 0, 0, 1)), shape.pop("seen", None)
        visual = dict(shape) if seen is None else _mesh(seen)
        if "height" in visual:
            visual["length"] = visual.pop("height")
        self.body = client.createMultiBody(
            baseMass=config.density_kg_m3 * obj.volume_m3,
            baseCollisionShapeIndex=client.createCollisionShape(
                **shape, collisionFrameOrientation=frame
            ),
            baseVisualShapeIndex=client.createVisualShape(
                **visual, visualFrameOrientation=frame, rgbaColor=(0.0, 0.62, 0.45, 1)
            ),
            baseInertialFramePosition=config.com_offset_m,
        )
        undamped = {"linearDamping": 0.0, "angularDamping": 0.0}
        set_friction(client, self.body, -1, config.object_friction, **undamped)
        c, s, (x, y, z) = math.cos(yaw_rad), math.sin(yaw_rad), config.com_offset_m
        position = (xy_m[0] + c * x - s * y, xy_m[1] + s * x + c * y, obj.height_m / 2 + z)
        orientation = pybullet.getQuaternionFromEuler((0, 0, yaw_rad))
        client.resetBasePositionAndOrientation(self.body, position, orientation)

    def states_of_centre(self, states: np.ndarray) -> np.ndarray:
        """States (n, 7) of the object's centre, given those of its centre of mass."""
        if not self._centre_of_mass_m.any():
            return states
        shift = Rotation.from_quat(states[:, 3:]).apply(self._centre_of_mass_m)
        return np.column_stack([states[:, :3] - shift, states[:, 3:]])

    def state(self) -> tuple[float, ...]:
        """Position (x, y, z) [m] of the centre and quaternion (x, y, z, w)."""
        position, quaternion = self.client.getBasePositionAndOrientation(self.body)
        return tuple(self.states_of_centre(np.array([[*position, *quaternion]]))[0])

    def pose(self) -> tuple[float, float, float]:
        """(x, y) [m] and yaw [rad] in the frame of the table."""
        x, y, _, yaw, _ = poses(np.array([self.state()]))[0]
        return float(x), float(y), float(yaw)

    def lowest_m(self) -> float:
        """Height of the lowest point of its bounding box [m]."""
        return self.client.getAABB(self.body)[0][2]

    def _upward(self) -> np.ndarray:
        return Rotation.from_quat(self.state()[3:]).as_matrix()[2]

    def fell(self) -> bool:
        """Whether it lies differently than it was placed."""
        return self.obj.fallen(self._upward())

    def rolls(self) -> bool:
        """Whether it can roll as it lies now."""
        return self.obj.rolls(self._upward())

    def left_table(self) -> bool:
        """Whether its centre is no longer above the table."""
        x, y, z = self.state()[:3]
        inside = TABLE_X_M[0] <= x <= TABLE_X_M[1] and TABLE_Y_M[0] <= y <= TABLE_Y_M[1]
        return not (z > 0 and inside)

    def brake(self, brakes: bool) -> None:
        """Let the table brake what can roll as it lies (Bullet's gain speed), or no longer."""
        rolling = BRAKED_ROLLING_M if brakes and self.rolls() else ROLLING_M
        self.client.changeDynamics(self.body, -1, rollingFriction=rolling)

    def displace(self, dx_m: float, dy_m: float, dyaw_rad: float) -> None:
        """Move it by (dx, dy) [m] and turn it by a yaw [rad], at its height and as it lies.

        Raises ValueError, and moves nothing, when its centre would leave the table.
        """
        x, y, *_ = centre = np.array(self.state()[:3])
        dx, dy = check_finite("dx_m", dx_m), check_finite("dy_m", dy_m)
        turn = Rotation.from_euler("z", check_finite("dyaw_rad", dyaw_rad))
        check_on_table("dx_m, dy_m: the shoved object's centre", (x + dx, y + dy))
        position, quaternion = self.client.getBasePositionAndOrientation(self.body)
        self.client.resetBasePositionAndOrientation(
            self.body,
            turn.apply(position - centre) + np.add(centre, (dx, dy, 0.0)),
            (turn * Rotation.from_quat(quaternion)).as_quat(),
        )

    def knock(self, dx_m_s: float, dy_m_s: float, spin_rad_s: float) -> None:
        """Change its velocity [m/s] and its spin about the vertical at once."""
        speeds = (("dx_m_s", dx_m_s), ("dy_m_s", dy_m_s))
        change = [*(check_within(name, v, -10.0, 10.0, "m/s") for name, v in speeds), 0.0]
        spin = [0.0, 0.0, check_within("spin_rad_s", spin_rad_s, -100.0, 100.0, "rad/s")]
        self._change_velocity(np.array(change), np.array(spin))

    def topple(self, direction_rad: float) -> None:
        """Give it the spin that tips it over the edge of its base in a direction [rad].

        Raises ValueError for what cannot fall.
        """
        c, s = math.cos(angle := check_finite("direction_rad", direction_rad)), math.sin(angle)
        if self.rolls():
            kind = self.obj.category
            raise ValueError(f"a {kind} that can roll as it lies has no edge to fall over")
        low, high = self.client.getAABB(self.body)
        x, y, z = self.state()[:3]
        corners = self._corners_m() - (x, y)
        out, up = float((corners @ (c, s)).max()), z - low[2]
        width, height = 2 * out, high[2] - low[2]
        # Of a box about its lower edge: inertia per mass, and how high its centre must rise.
        inertia = (width**2 + height**2) / 3
        rise = math.hypot(out, up) - up
        rate = math.sqrt(2 * 9.81 * rise * _TOPPLING / inertia)
        spin = rate * np.array([-s, c, 0.0])
        self._change_velocity(np.cross(spin, [-out * c, -out * s, up]), spin)

    def _corners_m(self) -> np.ndarray:
        """The outline (n, 2) [m] on the table as it stands or lies."""
        if self.fell():
            outline, half = self.obj.footprint_m, self.obj.height_m / 2
            ends = np.concatenate([np.insert(outline, 2, z, axis=1) for z in (-half, half)])
            *centre, i, j, k, w = self.state()
            return Rotation.from_quat([i, j, k, w]).apply(ends)[:, :2] + centre[:2]
        x, y, yaw = self.pose()
        return np.add(rotated(self.obj.footprint_m, yaw), (x, y))

    def draw_outline(self, xy_m: tuple, rgb: tuple, yaw_rad: float, scale: float) -> None:
        """Show its footprint at (x, y) [m] on the table, in a colour, `scale` times as large."""
        xy_m, yaw_rad = check_on_table("xy_m", xy_m), check_finite("yaw_rad", yaw_rad)
        outline = check_within("scale", scale, 0.1, 10.0) * self.obj.footprint_m
        rgb = [check_within("rgb", share, 0.0, 1.0) for share in check_array("rgb", rgb, 3)]
        # Larger sheets lie lower, so that one on another shows as a frame around it.
        sheet = np.vstack([np.insert(outline, 2, z, axis=1) for z in (-0.005, 0.001 / scale)])
        self.client.createMultiBody(
            baseVisualShapeIndex=self.client.createVisualShape(**_mesh(sheet), rgbaColor=(*rgb, 1)),
            basePosition=(*xy_m, 0.0),
            baseOrientation=pybullet.getQuaternionFromEuler((0, 0, yaw_rad)),
        )

    def _change_velocity(self, linear: np.ndarray, angular: np.ndarray) -> None:
        moving = self.client.getBaseVelocity(self.body)
        changed = np.add(moving, (linear, angular)).tolist()
        self.client.resetBaseVelocity(self.body, *changed)


def _mesh(vertices: np.ndarray) -> dict[str, Any]:
    """The convex hull of vertices (n, 3) as triangles with flat faces, for the renderer."""
    hull = ConvexHull(vertices)
    triangles = vertices[hull.simplices]
    normals = hull.equations[:, :3]
    facing = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    inward = (facing * normals).sum(axis=1) < 0
    triangles[inward] = triangles[inward, ::-1]
    return {
        "shapeType": pybullet.GEOM_MESH,
        "vertices": triangles.reshape(-1, 3).tolist(),
        "indices": list(range(3 * len(triangles))),
        "normals": np.repeat(normals, 3, axis=0).tolist(),
    }
