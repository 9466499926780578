"""Lever-ups: tensors, the prediction protocols of Section 4.1 and Table 1.

Trajectories are in the lever's frame: the origin is the contact point and x the direction of the
lever, as in the image. A step is 150 ms, which gives 26 poses. A pose is the object's change since
the start: x, y, z [m] and the tilt [rad] of its vertical axis. The stored yaw is omitted, because
it is the heading of a body axis that the image does not show, and has little meaning for a body
tilted by 65°. The commanded action is x and z relative to the contact (the blade slides in, then
lifts along its arc); its other channels are constant.

    window      15 poses observed, anywhere in the trajectory; the next 1 to 5 steps predicted
    first_step  the first pose observed; all later steps predicted
    image_only  no pose observed

All models observe the image and the commanded action at t = 0 and t = 1. The first pose is always
zero, so first_step contains no more information than image_only, and one trained network serves
both; a recurrent one is trained for each protocol (`experiments/lever_up.py`).
"""

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from affordlib.geometry import rotate_channels
from affordlib.interactions import InteractionTensors, condition_on_poses
from affordlib.interactions.dataset import valid_interactions
from affordlib.models.base import EffectNetwork
from affordlib.models.evaluation import EVERY
from affordlib.types import Prediction, check_choice

if TYPE_CHECKING:
    import xarray

LEVER_ACTION_CHANNELS = ("x", "z")
POSE_CHANNELS = ("x", "y", "z", "tilt")
N_OBSERVED, N_PREDICTED = 15, 5
"""Numbers of observed and of predicted steps in a window (Table 1)."""

PROTOCOLS = ("window", "first_step", "image_only")


def lever_up_tensors(
    data: "xarray.Dataset", interactions: np.ndarray | None = None, view: str = "near"
) -> InteractionTensors:
    """Return lever-ups as 26 steps of poses and commanded actions, in the lever's frame.

    view: "near", the 42 cm of the image that contain the object, 48×48 (means of four pixels);
    "wide", all of its 56 cm, 48×48. Faulty ones are excluded.
    """
    check_choice("view", view, ("near", "wide"))
    xyz = ("x", "y", "z")
    on_table = InteractionTensors.from_dataset(data, interactions, xyz, POSE_CHANNELS)
    chosen = np.arange(data.sizes["interaction"]) if interactions is None else interactions
    levers = data.isel(interaction=valid_interactions(data, chosen))
    theta = torch.from_numpy(levers["theta"].values)
    back = torch.stack([theta.cos(), -theta.sin()], dim=-1).float()[:, None]
    contact = np.stack([levers["contact_x"], levers["contact_y"], 0 * theta], axis=-1)
    action = on_table.action[:, ::EVERY] - torch.from_numpy(contact).float()[:, None]
    image, width_m = on_table.image, on_table.image_width_m
    if view == "near":
        image, width_m = F.avg_pool2d(image[..., 16:112, 32:], 2), 96 / 128 * width_m
    else:
        image = F.interpolate(image, (48, 48), mode="bilinear", antialias=True)
    return replace(
        on_table,
        image=image,
        image_width_m=width_m,
        phase=on_table.phase[::EVERY],
        action=rotate_channels(action, xyz, back, absolute_yaw=True)[..., [0, 2]],
        effect=rotate_channels(on_table.effect[:, ::EVERY], POSE_CHANNELS, back, False),
        action_channels=LEVER_ACTION_CHANNELS,
    )


@torch.no_grad()
def predict_steps(
    model: EffectNetwork, tensors: InteractionTensors, protocol: str, start: int = 0
) -> tuple[Prediction, Float[Tensor, "n t c"]]:
    """Prediction and ground truth at the steps that a protocol queries; start: of the window."""
    check_choice("protocol", protocol, PROTOCOLS)
    n, last = len(tensors), len(tensors.phase)
    n_poses = {"window": N_OBSERVED, "first_step": 1, "image_only": 0}[protocol]
    first = start + N_OBSERVED if protocol == "window" else 1
    steps = torch.arange(first, first + N_PREDICTED if protocol == "window" else last)
    observed = condition_on_poses(tensors, torch.full((n,), start), n_poses)
    predicted = model.predict(model.encode(tensors.image), observed, tensors.phases(steps))
    return predicted, tensors.effect[:, steps]


def n_windows(tensors: InteractionTensors) -> int:
    """Return the number of windows of 15 + 5 steps in a trajectory."""
    return len(tensors.phase) - N_OBSERVED - N_PREDICTED + 1


def errors_m(prediction: Prediction, truth: Tensor) -> Float[Tensor, "n t"]:
    """Distances [m] between predicted and true positions."""
    return (prediction.effect_mean - truth)[..., :3].norm(dim=-1)


@torch.no_grad()
def window_errors_m(model: EffectNetwork, tensors: InteractionTensors) -> Float[Tensor, "n w t"]:
    """Errors [m] of all windows of all trajectories, 1 to 5 steps ahead."""
    found = (predict_steps(model, tensors, "window", k) for k in range(n_windows(tensors)))
    return torch.stack([errors_m(*one) for one in found], dim=1)
