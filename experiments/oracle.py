"""The simulator as the model: the performance of a planner with perfect predictions."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import torch

from affordlib.planning.effect_map import EffectMap, phases_of
from affordlib.primitives import Move, move_for
from affordlib.types import Observations, Prediction
from affordlib.world import Tabletop, TabletopObject, WorldConfig

N_DIRECTIONS, PHASE_STEP = 36, 0.025
STD_M = 1e-5


@dataclass
class SimulatorModel:
    """An `EffectModel` that executes the action in a separate simulated world.

    It knows the object, its pose and the physics, whereas a learned model only sees an image.
    """

    world: Tabletop
    obj: TabletopObject
    yaw_rad: float
    kind: type[Move]
    config: WorldConfig

    action_channels = ("x", "y")
    effect_channels = ("x", "y", "yaw")

    def encode(self, image: torch.Tensor) -> torch.Tensor:
        """Return empty features, because the image is not used."""
        return torch.zeros(len(image), 1)

    def predict(
        self, features: torch.Tensor, observations: Observations, t_target: torch.Tensor
    ) -> Prediction:
        """Predict as any model does; the action must be observed at t = 0 and t = 1."""
        travel = observations.action[:, -1] - observations.action[:, 0]
        effects = []
        for (x, y), t in zip(travel.tolist(), t_target.numpy(), strict=True):
            self.world.place(self.obj, (0.0, 0.0), self.yaw_rad, config=self.config)
            action = self.kind.towards(math.atan2(y, x))
            if len(t) == 1:
                # A partial action is re-timed to its stop, so it has to be executed itself.
                rest = self.world.execute_primitive(action, float(t[0])).rest_effect
                effects.append(rest[None, [0, 1, 3]])
            else:
                done = self.world.execute_primitive(action)
                columns = [np.interp(t, done.phase, done.effect[:, c]) for c in (0, 1, 3)]
                effects.append(np.column_stack(columns))
        mean = torch.from_numpy(np.stack(effects)).float()
        action = observations.action[:, -1:].expand(-1, mean.shape[1], -1)
        std = torch.full_like(mean, STD_M)
        return Prediction(action, torch.full_like(action, STD_M), mean, std)


def oracle_effects(imagined: Tabletop, world: Tabletop, image: np.ndarray) -> EffectMap:
    """Return the effect map of the object in a world, from actions executed in an imagined world.

    The imagined world has this world's physics; its camera has no error.
    """
    kind = move_for(world.placed.rolls())
    config = replace(world.config, camera="ideal", bias_m=(0.0, 0.0))
    model = SimulatorModel(imagined, world.obj, world.object_pose()[2], kind, config)
    phases = phases_of(kind, round((1 - kind.acts_from) / PHASE_STEP) + 1)
    return EffectMap(model, image, kind, N_DIRECTIONS, len(phases))
