"""Effects of a primitive on one object for all directions and phases, by spline interpolation.

Effects are relative to the object, so they are a surface over two variables: the direction of the
action relative to the object, and the phase at which it stops. The model is queried once, on a
grid, and cubic B-splines interpolate. Phases before the action can touch an object are not queried,
as their effect is zero. When the object rotates, the surface rotates with it, so one map serves
every step of a plan and every node of a search. Chains of actions are rolled out on it.
"""

import base64
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from scipy import ndimage
from scipy.interpolate import NdBSpline
from scipy.spatial import cKDTree
from torch import Tensor

from affordlib.geometry import rotate, xy_columns
from affordlib.models import EffectModel, EffectNetwork, condition_on_primitives
from affordlib.models.base import rotate_prediction
from affordlib.perception import outline_of, radius_m
from affordlib.primitives import Move, Push
from affordlib.types import CROP_WIDTH_M, IMAGE_PIXELS, Prediction, Step, check_array

N_DIRECTIONS, N_PHASES = 48, 17
"""Size of the grid on which the model is queried."""

FINE_DIRECTIONS, FINE_PHASES = 180, 31


def checked_image(image: np.ndarray) -> torch.Tensor:
    """Convert one depth image (2, 48, 48) to (1, 2, 48, 48); ValueError for any other shape."""
    image = check_array("image", image).astype(np.float32)
    if image.shape != (2, IMAGE_PIXELS, IMAGE_PIXELS):
        raise ValueError(
            f"image must have the shape (2, {IMAGE_PIXELS}, {IMAGE_PIXELS}) that "
            f"Tabletop.depth_image() gives, got {image.shape}"
        )
    return torch.from_numpy(image)[None]


@dataclass(frozen=True, eq=False)
class EffectMap:
    """Effects and σ of `kind` on an image's object: ahead [m], to the left [m], rotation [rad].

    image: (2, 48, 48). The model is queried on first use, once for all plans. If it predicts no
    yaw, the rotation is 0 with σ = 0.
    """

    model: EffectModel
    image: np.ndarray
    kind: type[Move] = Push

    def __post_init__(self) -> None:
        checked_image(self.image)
        if domain := getattr(self.model, "domain", None):
            domain.check_width("image", CROP_WIDTH_M)
        object.__setattr__(self, "image", self.image.copy())  # the caller may change the original
        for channels in (self.model.action_channels, self.model.effect_channels):
            if not xy_columns(channels):
                raise ValueError(
                    "model must have x and y in its action and effect channels to plan positions, "
                    f"got {self.model.action_channels} and {self.model.effect_channels}"
                )

    @cached_property
    @torch.no_grad()
    def features(self) -> Tensor:
        """Image features (1, F) of the model."""
        return self.model.encode(checked_image(self.image))

    @cached_property
    def radius_m(self) -> float:
        """Largest distance [m] of the object's outline from the image's centre."""
        return radius_m(self.image)

    @cached_property
    def outline_m(self) -> np.ndarray:
        """Corners (k, 2) [m] of the object's convex outline, from the image's centre."""
        return outline_of(self.image)

    @cached_property
    def grid(self) -> tuple[Tensor, Tensor]:
        """Effects and σ (D, T, 3) at the grid's directions and phases."""
        angles = np.arange(N_DIRECTIONS) * (2 * math.pi / N_DIRECTIONS)
        phases = torch.linspace(self.kind.acts_from, 1, N_PHASES, dtype=torch.float64)
        t_target = phases.float().expand(N_DIRECTIONS, -1)
        effect, std = self.query(angles, t_target)
        # Before contact the true effect is zero: the model's prediction there is an offset.
        return effect - effect[:, :1], std

    @cached_property
    def reach_m(self) -> float:
        """Largest distance [m] by which one action moves the object."""
        return float(self.grid[0][..., :2].norm(dim=-1).max())

    @cached_property
    def spline(self) -> NdBSpline:
        """Spline of effects and σ (6,) over the direction relative to the object in the image and
        the phase from `kind.acts_from` on, both in units of grid cells.
        """
        smooth = torch.cat(self.grid, dim=-1).numpy()
        smooth = ndimage.spline_filter1d(smooth, axis=0, mode="grid-wrap")
        smooth = ndimage.spline_filter1d(smooth, axis=1, mode="mirror")
        smooth = np.pad(smooth, ((1, 2), (0, 0), (0, 0)), mode="wrap")
        smooth = np.pad(smooth, ((0, 0), (1, 2), (0, 0)), mode="reflect")
        # Coefficient k belongs to grid point k - 1, where its B-spline is centred.
        return NdBSpline(tuple(np.arange(n + 4) - 3.0 for n in smooth.shape[:2]), smooth, 3)

    def numbers(self) -> dict[str, Any]:
        """What evaluates the spline elsewhere, in JSON's types: its coefficients are in 16 bits."""
        inner = self.spline.c[1:-2, 1:-2]  # without the padding
        scale = np.abs(inner).max(axis=(0, 1)).clip(1e-9) / 32767
        whole = np.round(inner / scale).astype("<i2")
        return {
            "primitive": self.kind.name,
            "from": self.kind.acts_from,
            "shape": list(inner.shape[:2]),
            "scale": scale.tolist(),
            "coefficients": base64.b64encode(whole.tobytes()).decode(),
        }

    def __call__(self, direction_rad: Tensor, phase: Tensor) -> tuple[Tensor, Tensor]:
        """Effects and σ (..., 3) in the action's frame, for directions relative to the object."""
        first = self.kind.acts_from
        row = torch.remainder(direction_rad, 2 * math.pi) * (N_DIRECTIONS / (2 * math.pi))
        column = (phase.clamp(first, 1) - first) * ((N_PHASES - 1) / (1 - first))
        values = torch.from_numpy(self.spline(torch.stack([row, column], dim=-1).numpy()))
        return values[..., :3], values[..., 3:].clamp_min(1e-6)

    @cached_property
    def fine_grid(self) -> dict[bool, tuple[Tensor, Tensor, cKDTree]]:
        """A fine grid's directions and phases, and a k-d tree of the positions that result.

        By whether actions may stop early; if not, the phases are 1.
        """
        step = 2 * math.pi / FINE_DIRECTIONS
        angles = torch.arange(FINE_DIRECTIONS, dtype=torch.float64) * step
        phases = torch.linspace(self.kind.acts_from, 1, FINE_PHASES, dtype=torch.float64)
        direction, phase = torch.cartesian_prod(angles, phases).T
        ends = rotate(self(direction, phase)[0][:, :2], direction)
        grid, full = (direction, phase, ends), slice(FINE_PHASES - 1, None, FINE_PHASES)
        every = {True: grid, False: [values[full] for values in grid]}
        return {key: (*actions, cKDTree(ends)) for key, (*actions, ends) in every.items()}

    def nearest(self, wanted_xy_m: Tensor, n: int, partial: bool) -> tuple[Tensor, Tensor]:
        """Directions and phases (B, n) of the n (partial) actions ending nearest points (B, 2)."""
        direction, phase, tree = self.fine_grid[partial]
        rows = torch.from_numpy(tree.query(wanted_xy_m.numpy(), n)[1]).reshape(-1, n)
        return direction[rows], phase[rows]

    def query_model(self, direction_rad: Tensor, phase: Tensor) -> Tensor:
        """Effects (n, 3) for (n,) directions and phases, from the model instead of the spline."""
        first = torch.full_like(phase, self.kind.acts_from)
        t_target = torch.stack([first, phase.clamp_min(self.kind.acts_from)], dim=1).float()
        effect, _ = self.query(direction_rad.numpy(), t_target)
        return effect[:, 1] - effect[:, 0]

    @torch.no_grad()
    def query(self, direction_rad: np.ndarray, t_target: Tensor) -> tuple[Tensor, Tensor]:
        """Effects and σ (n, T, 3): ahead, left, turn, for n directions at phases (n, T)."""
        pushes = [self.kind.towards(float(angle)) for angle in direction_rad]
        observed = condition_on_primitives(self.model, pushes)
        channels = self.model.action_channels, self.model.effect_channels
        if isinstance(self.model, EffectNetwork):
            found = self.model.predict(self.features, observed, t_target, frame="push")
        else:
            found = self.model.predict(self.features, observed, t_target)
            found = Prediction(*(value.double() for value in vars(found).values()))
            angle = torch.as_tensor(direction_rad)
            back = torch.stack([angle.cos(), -angle.sin()], dim=-1)
            found = rotate_prediction(found, back, *channels)
        columns = [channels[1].index(name) for name in ("x", "y", "yaw") if name in channels[1]]
        both = found.effect_mean[..., columns], found.effect_std[..., columns]
        return tuple(F.pad(value.double(), (0, 3 - len(columns))) for value in both)


PATH_SAMPLES = 25
"""Number of points of a step's predicted path, as in Section 4.3."""


def roll_out(
    effects: EffectMap, direction_rad: Tensor, phase: Tensor, with_variances: bool = True
) -> tuple[Tensor, Tensor, Tensor]:
    """Positions (B, K, 2) [m], turns (B, K) [rad] and variances (B, K) [m²] after each action.

    direction_rad, phase: (B, K), of chains that start at the origin. The variance is the trace of
    the position's covariance, to which the rotation's variance adds in later actions. Without it,
    which takes half of the time, it is zero.
    """
    n, k_max = direction_rad.shape
    position, turned = direction_rad.new_zeros(n, 2), direction_rad.new_zeros(n)
    # The trace of the position's covariance, the turn's variance, and the covariance of the two.
    trace, turn_variance = torch.zeros_like(turned), torch.zeros_like(turned)
    covariance = torch.zeros_like(position)
    after = []
    nearby = torch.tensor([0.0, -0.02, 0.02], dtype=direction_rad.dtype)
    for k in range(k_max):
        angle = direction_rad[:, k]
        relative = angle[:, None] - turned[:, None] + (nearby if with_variances else nearby[:1])
        effects_near, std = effects(relative, phase[:, k, None].expand(relative.shape))
        effect = effects_near[:, 0]
        if with_variances:
            slope = (effects_near[:, 1] - effects_near[:, 2]) / 0.04  # d effect / d turned
            swing, added = rotate(slope[:, :2], angle), std[:, 0].square()
            trace = trace + (2 * covariance * swing).sum(dim=-1)
            trace = trace + turn_variance * swing.square().sum(dim=-1) + added[:, :2].sum(dim=-1)
            kept = 1 + slope[:, 2]
            covariance = kept[:, None] * (covariance + turn_variance[:, None] * swing)
            turn_variance = kept.square() * turn_variance + added[:, 2]
        position = position + rotate(effect[:, :2], angle)
        turned = turned + effect[:, 2]
        after.append((position, turned, trace))
    positions, turns, variances = (torch.stack(each, dim=1) for each in zip(*after, strict=True))
    return positions, turns, variances


def poses_along(
    effects: EffectMap, begins: np.ndarray, direction_rad: Tensor, phase: Tensor, n_poses: int
) -> np.ndarray:
    """Poses (n, n_poses, 3) of the object in n actions, from poses (n, 3): x, y [m], turn [rad]."""
    first = effects.kind.acts_from
    phases = first + (phase - first).clamp_min(0)[:, None] * torch.linspace(0, 1, n_poses)
    return _poses_at(effects, begins, direction_rad, phases)


def _poses_at(
    effects: EffectMap, begins: np.ndarray, direction_rad: Tensor, phases: Tensor
) -> np.ndarray:
    """Poses (n, p, 3) at phases (n, p) of n actions, from poses (n, 3)."""
    begins = torch.tensor(begins)
    effect = effects((direction_rad - begins[:, 2])[:, None].expand(phases.shape), phases)[0]
    moved = rotate(effect[..., :2], direction_rad[:, None])
    return (begins[:, None] + torch.cat([moved, effect[..., 2:]], dim=-1)).numpy()


def make_steps(
    effects: EffectMap,
    start_xy_m: Sequence[float],
    chain: Tensor,
    predicted: tuple[Tensor, Tensor] | None = None,
) -> tuple[Step, ...]:
    """Make steps of a chain (K, 2) of directions [rad] and phases, from a start (x, y) [m].

    predicted: positions (K, 2) and rotations (K,) after each action, relative to the start, if more
    accurate ones than the map's are known.
    """
    if not len(chain):
        return ()
    direction, phase = chain.T
    positions, turns, variances = roll_out(effects, direction[None], phase[None])
    xy_m, turned = predicted or (positions[0], turns[0])
    ends = np.column_stack([np.asarray(start_xy_m) + xy_m.numpy(), turned])
    begins = np.vstack([(*start_xy_m, 0.0), ends[:-1]])
    shares = torch.linspace(0, 1, PATH_SAMPLES, dtype=phase.dtype)
    paths = _poses_at(effects, begins, direction, phase[:, None] * shares)[..., :2]
    every = zip(chain.tolist(), ends.tolist(), paths, variances[0].tolist(), strict=True)
    return tuple(
        Step(effects.kind.towards(angle), stop, (x, y), path, None, math.sqrt(variance), turn_rad)
        for (angle, stop), (x, y, turn_rad), path, variance in every
    )
