"""What actions of one primitive do to one object, over all directions and phases, smooth between.

Effects are relative to the object, so all that a primitive does to it is a surface over two
numbers: the direction of the action relative to the object, and the phase at which it stops. The
model is queried once, on a grid; cubic B-splines fill the rest. No phase is queried before the
action can touch an object: nothing has happened there. When the object turns, the surface turns
with it, so one map serves every step of a plan and every node of a search.
"""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
import torch.nn.functional as F
from scipy import ndimage
from scipy.interpolate import NdBSpline
from scipy.spatial import cKDTree
from torch import Tensor

from affordlib.geometry import xy_columns
from affordlib.models.protocol import EffectModel, condition_on_primitives
from affordlib.models.push_frame import rotate_prediction
from affordlib.models.quasi_static import rotate
from affordlib.perception import radius_m
from affordlib.primitives import Drag, Push
from affordlib.types import IMAGE_CHANNELS, IMAGE_PIXELS, Prediction, check_array, check_count

FINE_DIRECTIONS, FINE_PHASES = 180, 31


def checked_image(image: np.ndarray) -> torch.Tensor:
    """One depth image (2, 48, 48) as (1, 2, 48, 48); raises ValueError where it is none."""
    image = check_array("image", image).astype(np.float32)
    if image.shape != (len(IMAGE_CHANNELS), IMAGE_PIXELS, IMAGE_PIXELS):
        raise ValueError(
            f"image must have the shape (2, {IMAGE_PIXELS}, {IMAGE_PIXELS}) that "
            f"Tabletop.depth_image() gives, got {image.shape}"
        )
    return torch.from_numpy(image)[None]


@dataclass(frozen=True, eq=False)
class EffectMap:
    """Effects of `kind` on the object in an image: ahead, to the left [m] and turn [rad], with σ.

    image: (2, 48, 48). The model is queried when the map is first used, once for all plans, on a
    grid of n_directions × n_phases. One that predicts no yaw is taken to predict none, with σ = 0.
    """

    model: EffectModel
    image: np.ndarray
    kind: type[Push] | type[Drag] = Push
    n_directions: int = 48
    n_phases: int = 17

    def __post_init__(self) -> None:
        check_count("n_directions", self.n_directions, 8, 720)
        check_count("n_phases", self.n_phases, 5, 500)
        checked_image(self.image)
        object.__setattr__(self, "image", self.image.copy())  # the caller may write into his
        for channels in (self.model.action_channels, self.model.effect_channels):
            if not xy_columns(channels):
                raise ValueError(
                    "model: a planner of positions needs one of actions and effects in x and y; "
                    f"this one has {self.model.action_channels} and {self.model.effect_channels}"
                )

    @cached_property
    @torch.no_grad()
    def features(self) -> Tensor:
        """What the model computes from the image, (1, F)."""
        return self.model.encode(checked_image(self.image))

    @cached_property
    def warning(self) -> str:
        """A sentence where the object is unlike all that the model was trained on."""
        novelty = getattr(self.model, "novelty", None)
        if novelty is None or novelty(checked_image(self.image)) <= 1:
            return ""
        return "The model was trained on no such object: errors may be far larger than predicted."

    @cached_property
    def radius_m(self) -> float:
        """How far the object reaches from its middle."""
        return radius_m(self.image)

    @cached_property
    def grid(self) -> tuple[Tensor, Tensor]:
        """Effects and σ (D, T, 3) at the grid's directions and phases."""
        angles = np.arange(self.n_directions) * (2 * math.pi / self.n_directions)
        t_target = phases_of(self.kind, self.n_phases).float().expand(self.n_directions, -1)
        effect, std = self.query(angles, t_target)
        # What a model predicts at the time before contact is no displacement.
        return effect - effect[:, :1], std

    @cached_property
    def reach_m(self) -> float:
        """How far an action takes the object at most."""
        return float(self.grid[0][..., :2].norm(dim=-1).max())

    @cached_property
    def spline(self) -> NdBSpline:
        """Effects and σ (6,) over the direction relative to the object as its image shows it, and
        over the phase from `kind.acts_from` on, both counted in cells of the grid.
        """
        smooth = torch.cat(self.grid, dim=-1).numpy()
        smooth = ndimage.spline_filter1d(smooth, axis=0, mode="grid-wrap")
        smooth = ndimage.spline_filter1d(smooth, axis=1, mode="mirror")
        smooth = np.pad(smooth, ((1, 2), (0, 0), (0, 0)), mode="wrap")
        smooth = np.pad(smooth, ((0, 0), (1, 2), (0, 0)), mode="reflect")
        # Coefficient number k belongs to the grid's point k - 1, where its B-spline is centred.
        return NdBSpline(tuple(np.arange(n + 4) - 3.0 for n in smooth.shape[:2]), smooth, 3)

    def __call__(self, direction_rad: Tensor, phase: Tensor) -> tuple[Tensor, Tensor]:
        """Effects and σ (..., 3) in the frame of the action, directions relative to the object."""
        first = self.kind.acts_from
        row = torch.remainder(direction_rad, 2 * math.pi) * (self.n_directions / (2 * math.pi))
        column = (phase.clamp(first, 1) - first) * ((self.n_phases - 1) / (1 - first))
        values = torch.from_numpy(self.spline(torch.stack([row, column], dim=-1).numpy()))
        return values[..., :3], values[..., 3:].clamp_min(1e-6)

    @cached_property
    def fine_grid(self) -> tuple[Tensor, Tensor, dict[bool, cKDTree]]:
        """A fine grid of directions and phases, and trees of where its actions bring the object."""
        angles = torch.arange(FINE_DIRECTIONS, dtype=torch.float64) * (
            2 * math.pi / FINE_DIRECTIONS
        )
        direction, phase = torch.cartesian_prod(angles, phases_of(self.kind, FINE_PHASES)).T
        ends = rotate(self(direction, phase)[0][:, :2], direction)
        return (
            direction,
            phase,
            {True: cKDTree(ends), False: cKDTree(ends[FINE_PHASES - 1 :: FINE_PHASES])},
        )

    def nearest(self, wanted_xy_m: Tensor, n: int, partial: bool) -> tuple[Tensor, Tensor]:
        """Directions and phases (B, n) of the actions that bring it nearest to wanted (B, 2) [m].

        partial: whether they may stop before the end.
        """
        direction, phase, trees = self.fine_grid
        rows = torch.from_numpy(trees[partial].query(wanted_xy_m.numpy(), n)[1]).reshape(-1, n)
        if not partial:
            rows = rows * FINE_PHASES + FINE_PHASES - 1
        return direction[rows], phase[rows]

    def query_model(self, direction_rad: Tensor, phase: Tensor) -> Tensor:
        """As the map, for (n,) directions and phases, from the model itself: (n, 3)."""
        first = torch.full_like(phase, self.kind.acts_from)
        t_target = torch.stack([first, phase.clamp_min(self.kind.acts_from)], dim=1).float()
        effect, _ = self.query(direction_rad.numpy(), t_target)
        return effect[:, 1] - effect[:, 0]

    @torch.no_grad()
    def query(self, direction_rad: np.ndarray, t_target: Tensor) -> tuple[Tensor, Tensor]:
        """Effects and σ (n, T, 3), ahead, left and turn, of actions in n directions, by the model.

        t_target: (n, T).
        """
        pushes = [self.kind.towards(float(angle)) for angle in direction_rad]
        observed = condition_on_primitives(self.model, pushes)
        prediction = self.model.predict(self.features, observed, t_target)
        prediction = Prediction(*(value.double() for value in vars(prediction).values()))
        angle = torch.as_tensor(direction_rad)
        back = torch.stack([angle.cos(), -angle.sin()], dim=-1)
        actions, effects = self.model.action_channels, self.model.effect_channels
        ahead = rotate_prediction(prediction, back, actions, effects)
        columns = [effects.index(name) for name in ("x", "y", "yaw") if name in effects]
        effect, std = ahead.effect_mean[..., columns], ahead.effect_std[..., columns]
        return tuple(F.pad(value, (0, 3 - len(columns))) for value in (effect, std))


def phases_of(kind: type[Push] | type[Drag], n_phases: int) -> Tensor:
    """The phases (T,) of a map's grid."""
    return torch.linspace(kind.acts_from, 1, n_phases, dtype=torch.float64)
