"""The inverse problem: which push has this effect? Decoded, then executed.

The wanted effects are those that recorded pushes had, on objects the model has not seen. The model
observes the effect at t = 1 alone (w₁ = 0); the first point of the action that it decodes says from
where to push. That push is executed on the same object, and its effect compared with the wanted.
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
from affordlib.models.protocol import EffectModel, condition_on_final_effect
from affordlib.primitives import Push
from affordlib.world import Tabletop


@torch.no_grad()
def decoded_theta_rad(model: EffectModel, image: torch.Tensor, wanted: torch.Tensor) -> np.ndarray:
    """Angles θ (N,) of the pushes that should have the effects (N, C) on the objects of images."""
    observations = condition_on_final_effect(model, wanted)
    decoded = model.predict(model.encode(image), observations, torch.zeros(len(wanted), 1))
    x, y = (decoded.action_mean[:, 0, model.action_channels.index(name)] for name in "xy")
    return torch.atan2(y, x).numpy()


def theta_along_effect(data: xr.Dataset, rows: np.ndarray) -> np.ndarray:
    """The baseline: push in the direction of the wanted effect, θ (N,)."""
    x, y = data["effect"].values[rows, -1, :2].T
    return np.arctan2(y, x) + math.pi


def executed_effects(data: xr.Dataset, rows: np.ndarray, theta_rad: np.ndarray) -> np.ndarray:
    """Final effects (N, 5) of other pushes θ (N,) on the objects of a recipe's interactions."""
    recipe = Recipe.from_json(data.attrs["recipe"])
    effects = []
    with Tabletop(recipe.world) as world:
        for index, theta in zip(data["interaction"].values[rows], theta_rad, strict=True):
            obj, yaw, _ = sample_scene(recipe, int(index))
            world.place(obj, (0.0, 0.0), yaw, config=sample_world(recipe, int(index), obj))
            done = world.execute_primitive(Push(float(theta)), record_unreachable=True)
            effects.append(done.effect[-1])
    return np.array(effects)


def inverse_columns(
    model: EffectModel, data: xr.Dataset, interactions: np.ndarray
) -> dict[str, list[Any]]:
    """Errors of the pushes that a model decodes from the effects of interactions, by column."""
    rows = valid_interactions(data, interactions)
    arrays = InteractionTensors.from_dataset(
        data, rows, model.action_channels, model.effect_channels
    )
    theta = decoded_theta_rad(model, arrays.image, arrays.effect[:, -1])
    return executed_columns(data, rows, theta)


def executed_columns(
    data: xr.Dataset, rows: np.ndarray, theta_rad: np.ndarray
) -> dict[str, list[Any]]:
    """Errors of executing pushes θ (N,) that should have the effects of interactions, by column."""
    off = executed_effects(data, rows, theta_rad) - data["effect"].values[rows, -1]
    theta_off = theta_rad - data["theta"].values[rows]
    names = data["family"].attrs["flag_meanings"].split()
    return {
        "interaction": data["interaction"].values[rows].tolist(),
        "category": [names[k] for k in data["family"].values[rows]],
        "final_error": np.hypot(*off[:, :2].T).tolist(),
        "yaw_error": [abs(wrap_angle(d)) for d in off[:, 3].tolist()],
        "theta_error": [abs(wrap_angle(d)) for d in theta_off.tolist()],
    }
