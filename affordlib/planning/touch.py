"""Touch calibrates the eye: where a push ends tells how far off the eye is.

An eye that is off by a bias shows an object always as far beside its place. The fingers start from
where the object is believed, and take it along to where they stop, wherever it really stood on
their way. So a push ends, along its direction, truly where it was foreseen, and is then seen
beside that by the bias. What several pushes tell is weighed as by a Kalman filter. (Ours: the
paper's robot trusts its eye.)
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from affordlib.types import Step

BIAS_M = 0.0012
"""How far off the eye usually is, along x and along y (standard deviation)."""

FELT_M = 0.0007
"""What model and camera leave of doubt about the bias along one push, with eight looks."""


class Touch:
    """What has been felt of the eye's bias so far: its mean (2,) [m] and covariance (2, 2) [m²]."""

    def __init__(self, bias_m: float = BIAS_M, felt_m: float = FELT_M) -> None:
        self.felt_m = felt_m
        self.mean_m = np.zeros(2)
        self.covariance_m2 = bias_m**2 * np.eye(2)

    def feel(
        self, step: Step, believed_xy_m: tuple[float, float], seen_xy_m: tuple[float, float]
    ) -> None:
        """Learn from a push: from where the object was believed, and where it is seen after it.

        Both as corrected by the mean so far.
        """
        angle = step.primitive.direction_rad
        along = np.array([np.cos(angle), np.sin(angle)])
        foreseen = step.predicted_path_xy_m[-1] - step.predicted_path_xy_m[0]
        surprise = along @ (np.subtract(seen_xy_m, believed_xy_m) - foreseen)
        spread = self.covariance_m2 @ along
        gain = spread / (along @ spread + self.felt_m**2)
        self.mean_m = self.mean_m + gain * surprise
        self.covariance_m2 = self.covariance_m2 - np.outer(gain, spread)
