"""Orientation and height: one partial action each, stopped where the model foresees what is wanted.

Grasp and rotate have no parameters (Section 3.3), so the only choice is the phase at which they
stop. The model's course yaw(t) or z(t) is inverted; t is continuous.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
import torch

from affordlib.models.frame import turn_image
from affordlib.models.protocol import observe_actions
from affordlib.perception import aim
from affordlib.planning.modes import encode_image
from affordlib.primitives import Grasp, Primitive, Rotate, wrap_angle
from affordlib.types import Step, check_finite, check_within

if TYPE_CHECKING:
    from collections.abc import Sequence

    from affordlib.models.protocol import EffectModel

SAMPLES = 301
CAREFUL_RAD, CAREFULLY = math.radians(6), 0.6
PERHAPS = 1.28


@torch.no_grad()
def foresee_course(
    model: EffectModel, image: np.ndarray, primitive: Primitive, channel: str
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Phases (n,), and mean and σ (n,) of one effect channel over them, zero before anything."""
    if channel not in model.effect_channels:
        raise ValueError(
            f"channel {channel!r} is not among the effects {model.effect_channels} of the model; "
            f"give the model of {primitive.name}"
        )
    t = torch.linspace(0, 1, SAMPLES)[None]
    observed = observe_actions(model, [aim(primitive, image)])
    told = model.predict(encode_image(model, image), observed, t)
    k = model.effect_channels.index(channel)
    mean, std = (v[0, :, k].double().numpy() for v in (told.effect_mean, told.effect_std))
    return t[0].double().numpy(), mean - mean[0], std


def crossings(phase: np.ndarray, values: np.ndarray, wanted: float) -> np.ndarray:
    """Phases at which a course, straight between its samples, has the wanted value."""
    below = values < wanted
    at = np.flatnonzero(below[1:] != below[:-1])
    share = (wanted - values[at]) / (values[at + 1] - values[at])
    return phase[at] + share * (phase[at + 1] - phase[at])


def plan_turn(
    model: EffectModel, image: np.ndarray, xy_m: Sequence[float], turn_rad: float
) -> Step | None:
    """The rotation that turns an object at (x, y) by an angle, or as far towards it as it can.

    Closing, the fingers align a cuboid; then the hand turns counter-clockwise, so an angle behind
    is reached by going on around. Where the wanted angle is not on the foreseen course, the whole
    rotation is taken and another has to follow. None when it is foreseen to turn nothing.
    """
    wanted = wrap_angle(check_finite("turn_rad", turn_rad))
    primitive = Rotate()
    phase, course, _ = foresee_course(model, image, primitive, "yaw")
    closing, opening = primitive.leg_phases[2], primitive.leg_phases[-2]

    def where(turn: float, low: float, high: float) -> list[float]:
        there = (phase >= low) & (phase <= high)
        return [
            float(stop)
            for around in (0.0, 2 * math.pi)
            for stop in crossings(phase[there], course[there], turn + around)
        ]

    stops = where(wanted, closing, opening)
    if not stops:
        # Only the closing fingers turn it so, and that is foreseen to some degrees: by halves.
        by_halves = wanted if abs(wanted) <= CAREFUL_RAD else CAREFULLY * wanted
        stops = where(by_halves, 0.0, closing)
    if not stops and np.ptp(course) < math.radians(1):
        return None
    stop = max(stops, default=1.0)
    return Step(
        primitive,
        stop,
        (float(xy_m[0]), float(xy_m[1])),
        np.array([xy_m, xy_m], dtype=float),
        std_m=0.0,
        predicted_turn_rad=float(np.interp(stop, phase, course)),
    )


def plan_lift(
    model: EffectModel,
    image: np.ndarray,
    xy_m: Sequence[float],
    height_m: float,
    grip_yaw: float = 0.0,
) -> Step | None:
    """The grasp that ends holding an object from (x, y) at a height [m] above where it stands.

    grip_yaw [rad]: of the hand; the model, which knows only hands at 0, is shown the image turned
    back by it. None when the model is sure (90 %) that it does not get so high, or slips.
    """
    height = check_within("height_m", height_m, 0.0, 0.5, "m")
    primitive = aim(Grasp(grip_yaw=grip_yaw), image)
    back = torch.tensor([[math.cos(grip_yaw), -math.sin(grip_yaw)]])
    before_hand = turn_image(torch.as_tensor(image)[None].float(), back)[0].numpy()
    phase, course, std = foresee_course(model, before_hand, primitive, "z")
    if course.max() < height <= course[-1] + PERHAPS * std[-1]:
        # It may slip, or not; if it does not, it goes where the hand goes.
        hand = primitive.path(phase)[:, 2]
        course = np.maximum(hand - hand[phase >= primitive.leg_phases[-2]][0], 0.0)
    lifting = phase >= primitive.leg_phases[-2]
    stops = crossings(phase[lifting], course[lifting], height)
    if not len(stops):
        return None
    return Step(
        primitive,
        float(stops[0]),
        (float(xy_m[0]), float(xy_m[1])),
        np.array([xy_m, xy_m], dtype=float),
        std_m=0.0,
        predicted_height_m=height,
    )
