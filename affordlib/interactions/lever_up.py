"""Lever-ups as trajectories of poses in the frame of the lever (Section 4.1 and Table 1).

The origin is the contact point, x the direction of the lever, as in the image, which was taken so.
A step is 150 ms, every twelfth sample: 26 poses, the first of them zero, since a pose is the
object's change since the start: x, y, z [m] and the tilt [rad] of its upright axis. The stored yaw
is left out: it is the heading of an axis of the object that no image shows, and says little of a
body that is tilted by 65°. Of the commanded action x and z change, relative to the contact (the
blade slides in, then lifts along its arc).
"""

from dataclasses import replace

import numpy as np
import torch
import torch.nn.functional as F

from affordlib.geometry import rotate_channels
from affordlib.interactions.dataset import InteractionTensors, Symmetry, valid_interactions
from affordlib.types import check_choice

LEVER_ACTION_CHANNELS = ("x", "z")
POSE_CHANNELS = ("x", "y", "z", "tilt")
EVERY = 12
"""Every twelfth of the 301 samples: 150 ms, the paper's step."""

N_OBSERVED, N_PREDICTED = 15, 5
"""Steps of a window that are observed, and those to predict (Table 1)."""

MIRRORED: tuple[Symmetry, ...] = ((0, False), (0, True))
"""A lever-up, and the same seen in a mirror along the lever: see `augment_by_symmetry`."""

_NEAR = slice(16, 112), slice(32, 128)


def lever_up_tensors(
    data: "xarray.Dataset", interactions: np.ndarray | None = None, view: str = "near"
) -> InteractionTensors:
    """Lever-ups as 26 steps of poses and commanded actions, in the frame of the lever.

    view: "near", the 42 cm of the image that objects reach into, 48×48 (means of four pixels);
    "wide", all of its 56 cm, 48×48; "full", as taken, 128×128. Faults are left out.
    """
    xyz = ("x", "y", "z")
    on_table = InteractionTensors.from_dataset(data, interactions, xyz, POSE_CHANNELS)
    chosen = np.arange(data.sizes["interaction"]) if interactions is None else interactions
    levers = data.isel(interaction=valid_interactions(data, chosen))
    theta = torch.from_numpy(levers["theta"].values)
    back = torch.stack([theta.cos(), -theta.sin()], dim=-1).float()[:, None]
    contact = np.stack([levers["contact_x"], levers["contact_y"], 0 * theta], axis=-1)
    action = on_table.action[:, ::EVERY] - torch.from_numpy(contact).float()[:, None]
    return replace(
        on_table,
        image=select_view(on_table.image, view),
        phase=on_table.phase[::EVERY],
        action=rotate_channels(action, xyz, back, absolute_yaw=True)[..., [0, 2]],
        effect=rotate_channels(on_table.effect[:, ::EVERY], POSE_CHANNELS, back, False),
        action_channels=LEVER_ACTION_CHANNELS,
    )


def select_view(image: torch.Tensor, view: str) -> torch.Tensor:
    """Images (N, C, 128, 128) as `lever_up_tensors` shows them to a model."""
    if check_choice("view", view, ("near", "wide", "full")) == "full":
        return image
    if view == "near":
        return F.avg_pool2d(image[..., _NEAR[0], _NEAR[1]], 2)
    return F.interpolate(image, (48, 48), mode="bilinear", antialias=True, align_corners=False)


def n_windows(tensors: InteractionTensors) -> int:
    """How many windows of 15 + 5 steps a trajectory has."""
    return len(tensors.phase) - N_OBSERVED - N_PREDICTED + 1
