"""What the actions of one kind do to one object, over all directions and phases, smooth between.

Effects are relative to the object, so an object's whole skills is a surface over two numbers:
the direction of the push relative to the object, and the phase at which it stops. The model is
asked once, on a grid; cubic B-splines fill the rest. No phase is asked about before the action can
touch an object: nothing has happened there. When the object turns, the surface turns with it, so
one map serves every step of a plan and every node of a search.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from scipy import ndimage
from scipy.spatial import cKDTree
from torch import Tensor

from affordlib.models.protocol import EffectModel, condition_on_primitives
from affordlib.perception import radius_m
from affordlib.primitives import Drag, Push
from affordlib.types import IMAGE_CHANNELS, IMAGE_PIXELS, check_array, check_count

N_DIRECTIONS = 48
N_PHASES = 17
FINE_DIRECTIONS = 180
FINE_PHASES = 31
_WRAP = 3
_SPLINES = (
    torch.tensor([[1, 4, 1, 0], [-3, 0, 3, 0], [3, -6, 3, 0], [-1, 3, -3, 1]], dtype=torch.float64)
    / 6
)


def checked_image(image: np.ndarray) -> torch.Tensor:
    """One depth image (2, 48, 48) as (1, 2, 48, 48); raises ValueError where it is none."""
    image = check_array("image", image).astype(np.float32)
    if image.shape != (len(IMAGE_CHANNELS), IMAGE_PIXELS, IMAGE_PIXELS):
        raise ValueError(
            f"image must have the shape (2, {IMAGE_PIXELS}, {IMAGE_PIXELS}) that "
            f"Tabletop.depth_image() gives, got {image.shape}"
        )
    return torch.from_numpy(image)[None]


def plane(model: EffectModel) -> list[int]:
    """Where x and y are among the model's effect channels; raises where it knows no plane."""
    for channels in (model.action_channels, model.effect_channels):
        if not {"x", "y"} <= {*channels}:
            raise ValueError(
                f"model: a planner of positions needs one of actions and effects in x and y; this "
                f"one has {model.action_channels} and {model.effect_channels}"
            )
    return [model.effect_channels.index(name) for name in ("x", "y")]


@dataclass(frozen=True, eq=False)
class EffectMap:
    """Effects of `kind` on the object in an image: ahead, to the left [m] and turn [rad], with σ.

    image: (2, 48, 48). The model is asked when the map is first used, once for all plans, on a grid
    of n_directions × n_phases. One that predicts no yaw is taken to predict none, and to be sure.
    """

    model: EffectModel
    image: np.ndarray
    kind: type[Push] | type[Drag] = Push
    n_directions: int = N_DIRECTIONS
    n_phases: int = N_PHASES

    def __post_init__(self) -> None:
        check_count("n_directions", self.n_directions, 8, 720)
        check_count("n_phases", self.n_phases, 5, 500)
        checked_image(self.image)
        plane(self.model)

    @cached_property
    @torch.no_grad()
    def features(self) -> Tensor:
        """What the model reads from the image, (1, F)."""
        return self.model.encode(checked_image(self.image))

    @cached_property
    def radius_m(self) -> float:
        """How far the object reaches from its middle."""
        return radius_m(self.image)

    @cached_property
    @torch.no_grad()
    def grid(self) -> tuple[Tensor, Tensor]:
        """Effects and σ (D, T, 3) at the grid's directions and phases."""
        angles = np.arange(self.n_directions) * (2 * math.pi / self.n_directions)
        t_target = phases_of(self.kind, self.n_phases).float().expand(self.n_directions, -1)
        effect, std = _asked(self.model, self.features, self.kind, angles, t_target)
        # What a model says of the time before contact is no displacement.
        return effect - effect[:, :1], std

    @cached_property
    def reach_m(self) -> float:
        """How far an action takes the object at most."""
        return float(self.grid[0][..., :2].norm(dim=-1).max())

    @cached_property
    def coefficients(self) -> Tensor:
        """Of cubic B-splines (D + 3, T + 3, 6) over the direction relative to the object as its
        image shows it, and over the phases from `kind.acts_from` on.
        """
        smooth = torch.cat(self.grid, dim=-1).numpy()
        smooth = ndimage.spline_filter1d(smooth, axis=0, mode="grid-wrap")
        smooth = ndimage.spline_filter1d(smooth, axis=1, mode="mirror")
        smooth = np.pad(smooth, ((1, 2), (0, 0), (0, 0)), mode="wrap")
        smooth = np.pad(smooth, ((0, 0), (1, 2), (0, 0)), mode="reflect")
        return torch.from_numpy(smooth)

    def __call__(self, direction_rad: Tensor, phase: Tensor) -> tuple[Tensor, Tensor]:
        """Effects and σ (..., 3) in the frame of the action, directions relative to the object."""
        shape, (height, width, channels) = direction_rad.shape, self.coefficients.shape
        rows, columns = height - _WRAP, width - _WRAP
        u = torch.remainder(direction_rad.reshape(-1), 2 * math.pi) * (rows / (2 * math.pi))
        first = self.kind.acts_from
        v = (phase.reshape(-1).clamp(first, 1) - first) * ((columns - 1) / (1 - first))
        i, j = u.detach().floor().clamp(0, rows - 1), v.detach().floor().clamp(0, columns - 2)
        across, along = _basis(torch.stack([u - i, v - j]))
        weights = (across[:, :, None] * along[:, None, :]).reshape(-1, 1, 16)
        # Flat indices and a product of matrices: half the time of indexing in two dimensions.
        four = torch.arange(4)
        patch = (width * four[:, None] + four).reshape(-1)
        at = ((width * i + j).long()[:, None] + patch).reshape(-1)
        near = self.coefficients.reshape(-1, channels).index_select(0, at)
        values = (weights @ near.reshape(-1, 16, channels)).reshape(*shape, channels)
        return values[..., :3], values[..., 3:].clamp_min(1e-6)

    @cached_property
    def fine_grid(self) -> tuple[Tensor, Tensor, dict[bool, cKDTree]]:
        """A fine grid of directions and phases, and trees of where its actions bring the object."""
        angles = torch.arange(FINE_DIRECTIONS, dtype=torch.float64) * (
            2 * math.pi / FINE_DIRECTIONS
        )
        phases = phases_of(self.kind, FINE_PHASES)
        direction, phase = (v.reshape(-1) for v in torch.meshgrid(angles, phases, indexing="ij"))
        with torch.no_grad():
            told, _ = self(direction, phase)
        c, s = direction.cos(), direction.sin()
        ends = torch.stack([c * told[:, 0] - s * told[:, 1], s * told[:, 0] + c * told[:, 1]], -1)
        full = torch.arange(FINE_PHASES - 1, len(ends), FINE_PHASES)
        return direction, phase, {True: cKDTree(ends), False: cKDTree(ends[full])}

    def nearest(self, wanted_xy_m: Tensor, n: int, partial: bool) -> tuple[Tensor, Tensor]:
        """Directions and phases (B, n) of the actions that bring it nearest to wanted (B, 2) [m].

        partial: whether they may stop before the end.
        """
        direction, phase, trees = self.fine_grid
        rows = torch.from_numpy(trees[partial].query(wanted_xy_m.numpy(), n)[1]).reshape(-1, n)
        if not partial:
            rows = rows * FINE_PHASES + FINE_PHASES - 1
        return direction[rows], phase[rows]

    @torch.no_grad()
    def query_model(self, direction_rad: Tensor, phase: Tensor) -> Tensor:
        """As the map, for (n,) directions and phases, from the model itself: (n, 3)."""
        first = torch.full_like(phase, self.kind.acts_from)
        t_target = torch.stack([first, phase.clamp_min(self.kind.acts_from)], dim=1).float()
        effect, _ = _asked(self.model, self.features, self.kind, direction_rad.numpy(), t_target)
        return effect[:, 1] - effect[:, 0]


def _basis(x: Tensor) -> Tensor:
    """The four cubic B-splines (..., 4) that do not vanish at x in [0, 1]."""
    powers = torch.stack([torch.ones_like(x), x, x * x, x**3], dim=-1)
    return powers @ _SPLINES


def _asked(
    model: EffectModel,
    features: Tensor,
    kind: type[Push] | type[Drag],
    direction_rad: np.ndarray,
    t_target: Tensor,
) -> tuple[Tensor, Tensor]:
    """Effects and σ (n, T, 3), ahead, left and turn, of actions in n directions."""
    actions = [kind.towards(float(angle)) for angle in direction_rad]
    told = model.predict(features, condition_on_primitives(model, actions), t_target)
    columns = plane(model)
    angle = torch.as_tensor(direction_rad, dtype=torch.float64)[:, None]
    c, s = angle.cos(), angle.sin()
    x, y = told.effect_mean[..., columns].double().unbind(-1)
    u, v = told.effect_std[..., columns].double().square().unbind(-1)
    effect = [c * x + s * y, c * y - s * x]
    std = [(c**2 * u + s**2 * v).sqrt(), (s**2 * u + c**2 * v).sqrt()]
    if "yaw" in model.effect_channels:
        k = model.effect_channels.index("yaw")
        effect.append(told.effect_mean[..., k].double())
        std.append(told.effect_std[..., k].double())
    else:
        effect.append(torch.zeros_like(x))
        std.append(torch.zeros_like(x))
    return torch.stack(effect, dim=-1), torch.stack(std, dim=-1)


def phases_of(kind: type[Push] | type[Drag], n_phases: int = N_PHASES) -> Tensor:
    """The phases (T,) of a map's grid."""
    return torch.linspace(kind.acts_from, 1, n_phases, dtype=torch.float64)
