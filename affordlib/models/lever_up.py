"""Lever-ups: tensors, the prediction protocols of Section 4.1 and Table 1, and our network.

Trajectories are in the lever's frame: the origin is the contact point and x the direction of the
lever, as in the image. A step is 150 ms, which gives 26 poses. A pose is the object's change since
the start: x, y, z [m] and the tilt [rad] of its vertical axis. The stored yaw is omitted, because
it is the heading of a body axis that the image does not show, and has little meaning for a body
tilted by 65°. The commanded action is x and z relative to the contact (the blade slides in, then
lifts along its arc); its other channels are constant.

    window      15 poses observed, anywhere in the trajectory; the next 1 to 5 steps predicted
    first_step  the first pose observed; all later steps predicted
    image_only  no pose observed

All models observe the image and the commanded action at t = 0 and t = 1. A pose is the change since
the start, so the first pose is always zero. Therefore first_step contains no more information than
image_only, and one trained network serves both. A conditional network is trained once for all
protocols, a recurrent one separately for each (`experiments/lever_training.py`).

`LastPoseCNP`, for lever-ups, works in the frame of the last observed pose:

    d(t)  = e(t) - m(t)                              m: mean of the training trajectories
    r     = w₁ mean h_a(a_i, t_i) + w₂ mean h_e(d_i - d_l, t_i - t_l, t_i),  l the last observed
    μ(t)  = m(t) + d_l + ḋ_l s(t) + n(t) g(r, ḋ_l, d_l, f(γ_o), t - t_l, t),    σ(t) from g

A mean of codes, as in equations (2) and (3) of the paper, loses the exact pose of the last
observation. Here that pose is an input, with the velocity ḋ_l between the last two observations,
whose influence s(t) = (t - t_l) exp(-|t - t_l| / 0.2) decays. The network predicts the remaining
change; n rises from 0 at t_l towards 1. Any t is predicted directly, without a rollout. With no
observation d_l is the one at t = 0, where a displacement is zero.
"""

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from affordlib import checked
from affordlib.geometry import rotate_channels
from affordlib.interactions.dataset import InteractionTensors, valid_interactions
from affordlib.interactions.sampling import condition_on_poses, condition_on_recorded_action
from affordlib.models.base import EffectNetwork, network, with_time
from affordlib.models.evaluation import EVERY
from affordlib.models.film import FiLMConfig, FiLMNetwork, dense, waves
from affordlib.models.push_frame import inverse, push_direction
from affordlib.types import Observations, Prediction, check_choice

if TYPE_CHECKING:
    import xarray

LEVER_ACTION_CHANNELS = ("x", "z")
POSE_CHANNELS = ("x", "y", "z", "tilt")
N_OBSERVED, N_PREDICTED = 15, 5
"""Numbers of observed and of predicted steps in a window (Table 1)."""

PROTOCOLS = ("window", "first_step", "image_only")

_NEAR_PHASE = 0.1
_VELOCITY_PHASE = 0.2


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


@checked
@dataclass(frozen=True)
class LastPoseConfig(FiLMConfig):
    """Sizes as in `FiLMConfig`."""

    frame: str = "table"
    steps: int = 25  # linear segments of m(t)


def between(values: Float[Tensor, "b n c"], at: Float[Tensor, "b t"]) -> Float[Tensor, "b t c"]:
    """Interpolate values (B, n, C) linearly at fractional indices (B, T)."""
    below = at.detach().floor().long().clamp(0, values.shape[1] - 2)
    share = (at - below)[..., None]

    def pick(index):
        return values.gather(1, index[..., None].expand(-1, -1, values.shape[-1]))

    return (1 - share) * pick(below) + share * pick(below + 1)


class MeanTrajectory(nn.Module):
    """Mean effect m(t) over the phase, linear between steps, in standardised units."""

    def __init__(self, steps: int, channels: int) -> None:
        super().__init__()
        self.register_buffer("values", torch.zeros(steps + 1, channels))

    def fit(self, training: InteractionTensors, frame: str, scale: Float[Tensor, " c"]) -> None:
        """Set m to the mean effect of training trajectories and their mirror images, in a frame."""
        both = training.joined(training.rotated_and_mirrored(0, mirror=True))
        at = torch.linspace(0, len(both.phase) - 1, len(self.values)).round().long()
        effect = both.effect[:, at]
        if frame == "push":
            channels = both.action_channels, both.effect_channels
            back = inverse(push_direction(condition_on_recorded_action(both), *channels))[:, None]
            effect = rotate_channels(effect, both.effect_channels, back, absolute_yaw=False)
        self.values = effect.mean(dim=0) / scale

    def forward(self, t: Float[Tensor, "b t"]) -> Float[Tensor, "b t c"]:
        at = t.clamp(0, 1) * (len(self.values) - 1)
        return between(self.values.expand(len(t), -1, -1), at)


class AroundMean:
    """A part of networks that predict differences from a `mean_trajectory` of their training."""

    def prepare(self, training: InteractionTensors) -> None:
        """Set the mean trajectory m."""
        self.mean_trajectory.fit(training, self.config.frame, self.effect_scale)


@network("cnp_last_pose", LastPoseConfig)
class LastPoseCNP(AroundMean, FiLMNetwork):
    """Predicts a trajectory from any observed part of it; satisfies `EffectModel`."""

    def make_layers(self, config: LastPoseConfig) -> None:
        """Create the encoders and decoders described above."""
        super().make_layers(config)
        c, w = config, config.width
        n_e = len(c.effect_channels)
        self.mean_trajectory = MeanTrajectory(c.steps, n_e)
        self.effect_encoder = nn.Sequential(*dense(n_e + 2, w, w, w))
        known = w + c.image_features + 2 * n_e + 2
        self.merge = nn.Linear(known + 2 * (2 * c.waves + 1), w)

    def outputs(
        self, features: Tensor, observations: Observations, t_target: Tensor
    ) -> tuple[Tensor, ...]:
        """(μ_a, σ_a, μ_e, σ_e), each (B, T, C) and standardised."""
        o = observations
        d = o.effect / self.effect_scale - self.mean_trajectory(o.effect_t)
        d_last, t_last, velocity = _last(d, o.effect_t, o.effect_mask)
        since = with_time(d - d_last[:, None], o.effect_t - t_last)
        r = self.represent(o, with_time(since, o.effect_t))
        seen = o.effect_mask.any(dim=1, keepdim=True).to(r.dtype)
        image = features.expand(len(r), -1)
        known = torch.cat([r, image, d_last, velocity, t_last, seen], dim=1)
        ahead = t_target - t_last
        n = self.config.waves
        times = torch.cat([waves(t_target, n), waves(ahead, n)], dim=-1)
        x = self.merge(torch.cat([known[:, None].expand(-1, times.shape[1], -1), times], dim=-1))
        mu_a, sigma_a, change, sigma_e = self.decode(x, features)
        # The change is zero at the last pose; the influence of the velocity decays.
        near = ahead.abs()[..., None] / (ahead.abs()[..., None] + _NEAR_PHASE)
        lasting = (10 * ahead * (-ahead.abs() / _VELOCITY_PHASE).exp())[..., None]
        moving = velocity[:, None] * lasting
        mu_e = self.mean_trajectory(t_target) + d_last[:, None] + moving + near * change
        return mu_a, sigma_a, mu_e, sigma_e


def _last(
    d: Float[Tensor, "b m c"], t: Float[Tensor, "b m"], seen: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Value (B, C) and phase (B, 1) of the last observation, and its velocity per tenth of phase.

    All are zero where nothing is observed; the velocity also where there is one observation.
    """
    order = t.masked_fill(~seen, -1.0).argsort(dim=1)[:, -2:]
    rows = torch.arange(len(d), device=d.device)
    late, early = order[:, -1], order[:, 0]
    any_seen, two = seen.any(dim=1), seen.sum(dim=1) >= 2
    gap = (t[rows, late] - t[rows, early]).clamp_min(1e-3)[:, None]
    velocity = (d[rows, late] - d[rows, early]) * (0.1 / gap) * two[:, None]
    return d[rows, late] * any_seen[:, None], (t[rows, late] * any_seen)[:, None], velocity


@torch.no_grad()
def predict_steps(
    model: EffectNetwork,
    tensors: InteractionTensors,
    protocol: str,
    start: int = 0,
    features: Tensor | None = None,
) -> tuple[Prediction, Float[Tensor, "n t c"]]:
    """Prediction and ground truth at the steps that a protocol queries; start: of the window.

    features: of the images, if already encoded.
    """
    check_choice("protocol", protocol, PROTOCOLS)
    n, last = len(tensors), len(tensors.phase)
    n_poses = {"window": N_OBSERVED, "first_step": 1, "image_only": 0}[protocol]
    first = start + N_OBSERVED if protocol == "window" else 1
    steps = torch.arange(first, first + N_PREDICTED if protocol == "window" else last)
    observed = condition_on_poses(tensors, torch.full((n,), start), n_poses)
    features = model.encode(tensors.image) if features is None else features
    return model.predict(features, observed, tensors.phases(steps)), tensors.effect[:, steps]


def n_windows(tensors: InteractionTensors) -> int:
    """Return the number of windows of 15 + 5 steps in a trajectory."""
    return len(tensors.phase) - N_OBSERVED - N_PREDICTED + 1


def errors_m(prediction: Prediction, truth: Tensor) -> Float[Tensor, "n t"]:
    """Distances [m] between predicted and true positions."""
    return (prediction.effect_mean - truth)[..., :3].norm(dim=-1)


@torch.no_grad()
def window_errors_m(model: EffectNetwork, tensors: InteractionTensors) -> Float[Tensor, "n w t"]:
    """Errors [m] of all windows of all trajectories, 1 to 5 steps ahead."""
    features = model.encode(tensors.image)
    starts = range(n_windows(tensors))
    found = [predict_steps(model, tensors, "window", start, features) for start in starts]
    return torch.stack([errors_m(*one) for one in found], dim=1)


def from_start_errors_m(model: EffectNetwork, tensors: InteractionTensors) -> Float[Tensor, "n t"]:
    """Errors [m] at all steps after the first, given only the image and the action."""
    return errors_m(*predict_steps(model, tensors, "image_only"))
