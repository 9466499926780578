"""The simulator itself as the model: what a planner could do if it foresaw everything."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch

from affordlib.planning.effect_map import EffectMap, phases_of
from affordlib.primitives import Drag, Push
from affordlib.types import Observations, Prediction
from affordlib.world import Tabletop, Thing, WorldConfig

N_DIRECTIONS, PHASE_STEP = 36, 0.025
_STD_M = 1e-5
WARY_RAD = math.radians(1.0)
"""By how much a wary oracle takes the object to be turned otherwise than it is."""


@dataclass
class SimulatorModel:
    """An `EffectModel` that carries the action out in a world of its own.

    It knows the object, its pose and the physics; a model only sees an image.
    """

    world: Tabletop
    thing: Thing
    yaw_rad: float
    kind: type[Push] | type[Drag]
    config: WorldConfig

    action_channels = ("x", "y")
    effect_channels = ("x", "y", "yaw")

    def encode(self, image: torch.Tensor) -> torch.Tensor:
        """Nothing is read from the image."""
        return torch.zeros(len(image), 1)

    def predict(
        self, features: torch.Tensor, observations: Observations, t_target: torch.Tensor
    ) -> Prediction:
        """As of any model; the action must be observed at t = 0 and t = 1."""
        travel = observations.action[:, -1] - observations.action[:, 0]
        effects = []
        for (x, y), t in zip(travel.tolist(), t_target.numpy(), strict=True):
            self.world.place(self.thing, (0.0, 0.0), self.yaw_rad, config=self.config)
            action = self.kind.towards(math.atan2(y, x))
            if len(t) == 1:
                # A part of an action is re-timed to its own stop: it is carried out as such.
                effects.append(
                    self.world.execute_primitive(action, float(t[0])).rest_effect[None, [0, 1, 3]]
                )
                continue
            seen = self.world.execute_primitive(action)
            columns = [np.interp(t, seen.phase, seen.effect[:, c]) for c in (0, 1, 3)]
            effects.append(np.column_stack(columns))
        mean = torch.from_numpy(np.stack(effects)).float()
        action = observations.action[:, -1:].expand(-1, mean.shape[1], -1)
        std = torch.full_like(mean, _STD_M)
        return Prediction(action, torch.full_like(action, _STD_M), mean, std)


def oracle_effects(
    imagined: Tabletop,
    world: Tabletop,
    image: np.ndarray,
    kind: type[Push] | type[Drag],
    config: WorldConfig,
    wary: bool = False,
) -> EffectMap:
    """The effect map of the object that stands in a world, from actions in an imagined one.

    config: of the imagined one, in which the camera misses nothing. wary: its σ, else next to
    nothing, is how much the effect changes with `WARY_RAD`.
    """
    config = replace(config, camera="ideal", bias_m=(0.0, 0.0))
    model = SimulatorModel(imagined, world.thing, world.object_pose()[2], kind, config)
    a_map = SensitiveMap if wary else EffectMap
    return a_map(model, image, kind, N_DIRECTIONS, len(_phases(kind)))


def _phases(kind: type[Push] | type[Drag]) -> torch.Tensor:
    return phases_of(kind, round((1 - kind.acts_from) / PHASE_STEP) + 1)


class SensitiveMap(EffectMap):
    """A map whose σ is by how much the effects change with `WARY_RAD`."""

    @cached_property
    def grid(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Effects and σ (D, T, 3) at the grid's directions and phases."""
        mean, _ = super().grid
        slope = (mean.roll(-1, 0) - mean.roll(1, 0)) / (4 * math.pi / self.n_directions)
        return mean, WARY_RAD * slope.abs() + _STD_M
