"""Lever-ups as trajectories of poses in the lever's frame (Section 4.1 and Table 1).

The origin is the contact point and x the direction of the lever, as in the image.
A step is 150 ms, every 12th sample, which gives 26 poses. A pose is the object's change since the
start: x, y, z [m] and the tilt [rad] of its vertical axis. The stored yaw is omitted, because it is
the heading of a body axis that the image does not show, and has little meaning for a body tilted by
65°. The commanded action is x and z relative to the contact (the blade slides in, then lifts along
its arc); its other channels are constant.
"""

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import torch
import torch.nn.functional as F

from affordlib.geometry import rotate_channels
from affordlib.interactions.dataset import InteractionTensors, valid_interactions
from affordlib.types import check_choice

if TYPE_CHECKING:
    import xarray

LEVER_ACTION_CHANNELS = ("x", "z")
POSE_CHANNELS = ("x", "y", "z", "tilt")
EVERY = 12
"""Stride over the 301 samples: every 12th is a step of 150 ms, as in the paper."""

N_OBSERVED, N_PREDICTED = 15, 5
"""Numbers of observed and of predicted steps in a window (Table 1)."""


def lever_up_tensors(
    data: "xarray.Dataset", interactions: np.ndarray | None = None, view: str = "near"
) -> InteractionTensors:
    """Return lever-ups as 26 steps of poses and commanded actions, in the lever's frame.

    view: "near", the 42 cm of the image that contain the object, 48×48 (means of four pixels);
    "wide", all of its 56 cm, 48×48; "full", as recorded, 128×128. Faulty ones are excluded.
    """
    check_choice("view", view, ("near", "wide", "full"))
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
    elif view == "wide":
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
