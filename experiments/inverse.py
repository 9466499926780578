"""The inverse question, carried out: which push brings this effect about, and does it?

The wanted effects are those that pushes really had, on objects the model has not seen. The model
observes the effect at t = 1 alone (w₁ = 0); of the action that it decodes, the first point says
from where to push. That push is carried out on the same object, and where it ends is compared with
where it should.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
import xarray as xr

from affordlib.geometry import wrap_angle
from affordlib.interactions.dataset import InteractionTensors, valid_interactions
from affordlib.interactions.recipes import Recipe, sample_scene, sample_world
from affordlib.models.protocol import EffectModel, observe_final_effect
from affordlib.primitives import Push
from affordlib.world import Tabletop


@torch.no_grad()
def decoded_theta_rad(model: EffectModel, image: torch.Tensor, wanted: torch.Tensor) -> np.ndarray:
    """Angles θ (N,) of the pushes that should have the effects (N, C) on the objects of images."""
    asked = observe_final_effect(model, wanted)
    told = model.predict(model.encode(image), asked, torch.zeros(len(wanted), 1))
    x, y = (told.action_mean[:, 0, model.action_channels.index(name)] for name in "xy")
    return torch.atan2(y, x).numpy()


def execute(data: xr.Dataset, interactions: np.ndarray, theta_rad: np.ndarray) -> np.ndarray:
    """Final effects (N, 5) of other pushes θ (N,) on the objects of a recipe's interactions."""
    recipe = Recipe.from_json(data.attrs["recipe"])
    effects = []
    with Tabletop(recipe.world) as world:
        for index, theta in zip(data["interaction"].values[interactions], theta_rad, strict=True):
            obj, yaw, _ = sample_scene(recipe, int(index))
            config = sample_world(recipe, int(index), obj)
            world.place(obj, (0.0, 0.0), yaw, config=config)
            effects.append(
                world.execute_primitive(Push(float(theta)), record_unreachable=True).effect[-1]
            )
    return np.array(effects)


def inverse_record(
    model: EffectModel, data: xr.Dataset, interactions: np.ndarray
) -> dict[str, list[Any]]:
    """Errors of pushes decoded from the true effects of interactions, one entry an interaction."""
    kept = valid_interactions(data, interactions)
    arrays = InteractionTensors.from_dataset(
        data, kept, model.action_channels, model.effect_channels
    )
    theta = decoded_theta_rad(model, arrays.image, arrays.effect[:, -1])
    return executed_record(data, kept, theta)


def executed_record(
    data: xr.Dataset, kept: np.ndarray, theta_rad: np.ndarray
) -> dict[str, list[Any]]:
    """Errors of pushes θ (N,) that should have the effects of interactions, carried out."""
    wanted, done = data["effect"].values[kept, -1], execute(data, kept, theta_rad)
    true_theta = data["theta"].values[kept]
    names = data["family"].attrs["flag_meanings"].split()
    return {
        "interaction": data["interaction"].values[kept].tolist(),
        "family": [names[k] for k in data["family"].values[kept]],
        "final_error": np.hypot(*(done - wanted)[:, :2].T).tolist(),
        "yaw_error": [abs(wrap_angle(d)) for d in (done - wanted)[:, 3]],
        "theta_error": [
            abs(wrap_angle(float(a - b))) for a, b in zip(theta_rad, true_theta, strict=True)
        ],
    }


def along_effect(data: xr.Dataset, kept: np.ndarray) -> np.ndarray:
    """The guess to beat: push in the direction of the wanted effect, θ (N,)."""
    x, y = data["effect"].values[kept, -1, :2].T
    return np.arctan2(y, x) + math.pi
