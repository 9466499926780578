"""Orientation and height: one partial action each, stopped at the phase of the desired effect.

Grasp and rotate have no parameters (Section 3.3), so a model of them covers only one gripper yaw.
But grasping with the hand rotated by α is equivalent to grasping the object rotated by -α: given
the image rotated back, the model predicts the effect for every gripper yaw. The planner chooses the
yaw, and interpolates the stop phase on the predicted trajectory yaw(t) or z(t).

The paper adds grasp and rotate to the branches of the search when the goal requires them (Section
3.4). They do not change the position and nothing can follow a grasp, so `PosePlanner` puts them
after the actions that bring the object to its position, and needs no image taken after these.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch

from affordlib.geometry import wrap_angle
from affordlib.models.base import EffectModel, condition_on_primitives, rotate_image
from affordlib.perception import adapt_to_object
from affordlib.planning.effect_map import checked_image
from affordlib.primitives import Grasp, Primitive, Rotate
from affordlib.types import Goal, Step

MAX_TURNS = 7
"""Maximum number of rotations: 360° in sweeps of 60°, and one more for the error of aligning."""

N_PHASES = 301
Z_90 = 1.28
"""One-sided 90 % quantile of a Gaussian; heights above mean + Z_90 σ count as unreachable."""

FULL_ROTATION_SHARE = 0.9
"""Fraction of the hand's sweep; a full rotation that turns the object by less has slipped."""

GRIPPER_YAWS_RAD = tuple(np.radians([0, 15, -15, 30, -30, 45, -45, 60, -60, 75, -75, 90]).tolist())
"""Candidate gripper yaws, by magnitude; they cover 180°, since the two fingers are identical."""


@dataclass(frozen=True)
class PredictedTrajectories:
    """Mean and std (m, n) of an effect, zero at first, for m gripper yaws over the phase (n,)."""

    gripper_yaws_rad: tuple[float, ...]
    phase: np.ndarray
    mean: np.ndarray
    std: np.ndarray


@torch.no_grad()
def predict_trajectories(
    model: EffectModel,
    image: np.ndarray,
    primitive: Grasp | Rotate,
    channel: str,
    gripper_yaws_rad: Sequence[float] = GRIPPER_YAWS_RAD,
) -> PredictedTrajectories:
    """Predict a channel of the effect for each gripper yaw [rad]; ValueError if it has none."""
    yaws = tuple(float(yaw) for yaw in gripper_yaws_rad)
    if channel not in model.effect_channels:
        raise ValueError(
            f"channel {channel!r} is not among the effects {model.effect_channels} of the model; "
            f"use the model of {primitive.name}"
        )
    turn = torch.tensor([[math.cos(yaw), -math.sin(yaw)] for yaw in yaws])
    features = model.encode(rotate_image(checked_image(image), turn))
    t = torch.linspace(0, 1, N_PHASES).expand(len(turn), -1)
    action = replace(adapt_to_object(primitive, image), grip_yaw=0.0)
    prediction = model.predict(features, condition_on_primitives(model, [action] * len(turn)), t)
    k = model.effect_channels.index(channel)
    both = prediction.effect_mean, prediction.effect_std
    mean, std = (values[:, :, k].double().numpy() for values in both)
    return PredictedTrajectories(yaws, t[0].double().numpy(), mean - mean[:, :1], std)


def crossings(phase: np.ndarray, values: np.ndarray, wanted: float) -> np.ndarray:
    """Phases at which a trajectory, linear between its samples, crosses the wanted value."""
    below = values < wanted
    at = np.flatnonzero(below[1:] != below[:-1])
    share = (wanted - values[at]) / (values[at + 1] - values[at])
    return phase[at] + share * (phase[at + 1] - phase[at])


def candidate_turns(
    predicted: PredictedTrajectories, xy_m: Sequence[float], turn_rad: float
) -> Iterator[Step]:
    """Steps that rotate an object at (x, y) by an angle, one for each gripper yaw, best first.

    The closing fingers align a cuboid; then the hand rotates counter-clockwise, so negative angles
    take a rotation of up to 360°. The best step has the lowest σ of those predicted to reach the
    angle while the object is held. If there is none, it is the full rotation of lowest σ that turns
    the object by most of its sweep, and another step has to follow.
    """
    wanted, phase = wrap_angle(turn_rad), predicted.phase
    closed, opening = Rotate().segment_phases[2], Rotate().segment_phases[-2]
    held = (phase >= closed) & (phase <= opening)
    stops = [
        (float(np.interp(stop, phase, std)), k, float(stop))
        for k, (mean, std) in enumerate(zip(predicted.mean, predicted.std, strict=True))
        for around in (0.0, 2 * math.pi)
        for stop in crossings(phase[held], mean[held], wanted + around)
    ]
    left = list(range(len(predicted.mean)))
    while left:
        if first := min((one for one in stops if one[1] in left), default=None):
            _, k, stop = first
        else:
            end = predicted.mean[left, -1]
            if end.max() < math.radians(1):
                return
            enough = end >= min(FULL_ROTATION_SHARE * Rotate.sweep_rad, end.max())
            k, stop = left[np.where(enough, predicted.std[left, -1], np.inf).argmin()], 1.0
        turned = float(np.interp(stop, phase, predicted.mean[k]))
        primitive = Rotate(predicted.gripper_yaws_rad[k])
        at = tuple(xy_m), np.array([xy_m, xy_m])
        yield Step(primitive, stop, *at, std_m=0.0, predicted_turn_rad=turned)
        left.remove(k)


def candidate_lifts(
    predicted: PredictedTrajectories, xy_m: Sequence[float], height_m: float
) -> Iterator[Step]:
    """Grasps that hold an object from (x, y) at a height [m], one for each yaw, best first.

    The best has the highest mean - σ of the height; ties, to a centimetre, go to the first.
    """
    phase = predicted.phase
    surely = (predicted.mean - predicted.std)[:, -1].round(2)
    for k in np.argsort(-surely, kind="stable"):
        mean, std = predicted.mean[k], predicted.std[k]
        primitive = Grasp(grip_yaw=predicted.gripper_yaws_rad[k])
        closed = phase >= primitive.segment_phases[-2]
        if mean.max() < height_m <= mean[-1] + Z_90 * std[-1]:
            # The object may slip; if it does not, it moves with the hand.
            hand = primitive.path(phase)[:, 2]
            mean = np.maximum(hand - hand[closed][0], 0.0)
        stops = crossings(phase[closed], mean[closed], height_m)
        if not len(stops):
            return
        at = tuple(xy_m), np.array([xy_m, xy_m])
        yield Step(primitive, float(stops[0]), *at, std_m=0.0, predicted_height_m=height_m)


@dataclass(frozen=True)
class PosePlanner:
    """Plans the steps that rotate and lift an object as a goal requires, from one image of it.

    image: (2, 48, 48); model: returns the model of a primitive; can_act: whether the arm can
    execute a step. Predictions are cached, so that a search can query every node.
    """

    image: np.ndarray
    model: Callable[[type[Primitive]], EffectModel]
    can_act: Callable[[Step], bool]
    _kept: dict[tuple[type, tuple[float, ...]], PredictedTrajectories] = field(
        default_factory=dict, init=False, repr=False, compare=False
    )

    def __call__(
        self, goal: Goal, xy_m: Sequence[float], turned_rad: float = 0.0, std_m: float = 0.0
    ) -> tuple[Step, ...] | None:
        """Plan for an object at (x, y) that has rotated by turned_rad since its image was taken.

        std_m: σ of that position. None where the goal's orientation or height is unreachable.
        """
        steps: list[Step | None] = []
        turned, grip_yaw = turned_rad, None
        while (error := goal.errors(xy_m, turned).get("orientation")) and not error.is_met():
            step = self.turn(error.left, xy_m, turned)
            if step is None or len(steps) == MAX_TURNS:
                return None
            steps.append(step)
            turned, grip_yaw = step.predicted_turn_rad, released_yaw(step)
        if goal.height_m is not None:
            steps.append(self.lift(goal.height_m, xy_m, turned, grip_yaw))
        return None if None in steps else tuple(replace(step, std_m=std_m) for step in steps)

    def turn(self, turn_rad: float, xy_m: Sequence[float], turned_rad: float = 0.0) -> Step | None:
        """The best step to rotate by, or towards, an angle; turned_rad: since the image."""
        predicted = self._predicted(Rotate, "yaw", GRIPPER_YAWS_RAD)
        return self._first(candidate_turns(predicted, xy_m, turn_rad), turned_rad)

    def lift(
        self,
        height_m: float,
        xy_m: Sequence[float],
        turned_rad: float = 0.0,
        grip_yaw: float | None = None,
    ) -> Step | None:
        """The best step that the arm can execute to lift the object to a height.

        grip_yaw: of a hand that has just released it; a grasp at another would rotate the object.
        """
        yaws = GRIPPER_YAWS_RAD
        if grip_yaw is not None:
            quarters = (0.0, math.pi / 2, -math.pi / 2)
            yaws = tuple(wrap_angle(grip_yaw - turned_rad + quarter) for quarter in quarters)
        predicted = self._predicted(Grasp, "z", yaws)
        return self._first(candidate_lifts(predicted, xy_m, height_m), turned_rad)

    def _first(self, candidates: Iterator[Step], turned_rad: float) -> Step | None:
        """The first candidate that the arm can execute, for an object that has rotated."""
        for step in candidates:
            yaw = step.primitive.grip_yaw + turned_rad
            # The equivalent yaw of smallest magnitude, the two fingers being identical.
            yaw = (yaw + math.pi / 2) % math.pi - math.pi / 2
            step = replace(
                step,
                primitive=replace(step.primitive, grip_yaw=yaw),
                predicted_turn_rad=turned_rad + step.predicted_turn_rad,
            )
            if self.can_act(step):
                return step
        return None

    def _predicted(
        self, kind: type[Grasp] | type[Rotate], channel: str, yaws: tuple[float, ...]
    ) -> PredictedTrajectories:
        """Cached predictions for gripper yaws relative to the image, rounded to half a degree."""
        key = kind, tuple(round(2 * math.degrees(yaw)) / 2 for yaw in yaws)
        if key not in self._kept:
            model, near = self.model(kind), np.radians(key[1])
            self._kept[key] = predict_trajectories(model, self.image, kind(), channel, near)
        return replace(self._kept[key], gripper_yaws_rad=yaws)


def released_yaw(step: Step) -> float:
    """Yaw [rad] of the hand at the end of a step."""
    return float(step.primitive.path(step.stop_phase)[0, 3])
