"""What others than the robot may do to the object: shove it, knock it, topple it."""

from __future__ import annotations

import math

import numpy as np
import pybullet
from scipy.spatial.transform import Rotation

from affordlib.types import check_finite, check_on_table, check_within
from affordlib.world import motion
from affordlib.world.execution import resist_rolling

_TOPPLING = 1.5
"""Times the energy that brings an object onto its edge: some of it is lost in sliding."""


class Interventions:
    """The part of a `Tabletop` that disturbs its object; the arm is not told."""

    def shove(self, dx_m: float, dy_m: float, dyaw_rad: float = 0.0) -> None:
        """Displace the object by (dx, dy) [m] and turn it by a yaw [rad], as a stranger would.

        It keeps its resting height and posture and then settles; the arm is not told. Raises
        ValueError, and moves nothing, when its centre would leave the table.
        """
        x, y, *_ = centre = np.array(self.object_state()[:3])
        dx, dy = check_finite("dx_m", dx_m), check_finite("dy_m", dy_m)
        turn = Rotation.from_euler("z", check_finite("dyaw_rad", dyaw_rad))
        check_on_table("dx_m, dy_m: the shoved object's centre", (x + dx, y + dy))
        position, quaternion = pybullet.getBasePositionAndOrientation(self.body, self.client)
        pybullet.resetBasePositionAndOrientation(
            self.body,
            turn.apply(position - centre) + np.add(centre, (dx, dy, 0.0)),
            (turn * Rotation.from_quat(quaternion)).as_quat(),
            physicsClientId=self.client,
        )
        self.settle()

    def knock(self, dx_m_s: float, dy_m_s: float, spin_rad_s: float = 0.0) -> None:
        """Hit the object: its velocity [m/s] and its spin about the vertical change at once.

        An impulse through its centre of mass, so that friction, fingers and table decide where it
        goes. It may be called from `on_step`, in the middle of an action.
        """
        self._require_object()
        speeds = (("dx_m_s", dx_m_s), ("dy_m_s", dy_m_s))
        change = [*(check_within(name, v, -10.0, 10.0, "m/s") for name, v in speeds), 0.0]
        spin = [0.0, 0.0, check_within("spin_rad_s", spin_rad_s, -100.0, 100.0, "rad/s")]
        self._change_velocity(np.array(change), np.array(spin))

    def topple(self, direction_rad: float) -> None:
        """Tip the object over the edge of its base in a direction [rad], as a blow high up would.

        It gets the spin about that edge that carries it a little past its balance. It may be
        called from `on_step`; otherwise let it `settle`. Raises ValueError for what cannot fall.
        """
        self._require_object()
        c, s = math.cos(angle := check_finite("direction_rad", direction_rad)), math.sin(angle)
        if self.object_rolls():
            raise ValueError(f"a {self.obj.category} that can roll as it lies has no edge to fall")
        low, high = pybullet.getAABB(self.body, physicsClientId=self.client)
        x, y, z = self.object_state()[:3]
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
        """The object's outline (n, 2) [m] on the table as it stands or lies."""
        if self.object_fell():
            outline, half = self.obj.footprint_m, self.obj.height_m / 2
            ends = np.concatenate([np.insert(outline, 2, z, axis=1) for z in (-half, half)])
            *centre, i, j, k, w = self.object_state()
            return Rotation.from_quat([i, j, k, w]).apply(ends)[:, :2] + centre[:2]
        x, y, yaw = self.object_pose()
        c, s = math.cos(yaw), math.sin(yaw)
        return self.obj.footprint_m @ np.array([[c, s], [-s, c]]) + (x, y)

    def _change_velocity(self, linear: np.ndarray, angular: np.ndarray) -> None:
        moving = pybullet.getBaseVelocity(self.body, physicsClientId=self.client)
        pybullet.resetBaseVelocity(
            self.body,
            (np.array(moving[0]) + linear).tolist(),
            (np.array(moving[1]) + angular).tolist(),
            physicsClientId=self.client,
        )

    def settle(self, seconds: float = 0.5) -> None:
        """Let the world run while the arm stands still and keeps hold of what it holds.

        What can roll is braked by the table.
        """
        steps = round(check_within("seconds", seconds, 0.0, 60.0, "s") / motion.STEP_S)
        if self.obj is not None:
            resist_rolling(self, True)
            motion.tie_held(self)
        motion.Drive(self, 0.0, closes=False).wait(steps)
