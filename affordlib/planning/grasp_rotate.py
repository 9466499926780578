"""Orientation and height: one partial action each, stopped where the model foresees what is wanted.

Grasp and rotate have no parameters (Section 3.3), so a model of them knows only one hand. But a
turned hand is the same hand in a turned frame: the model is shown the image turned back, and says
for every angle of the hand what would come of it. The angle is chosen, and the phase at which to
stop is looked up on the course yaw(t) or z(t) that is foreseen; t is continuous.

The paper adds grasp and rotate to the branches of the search when the goal asks for them (Section
3.4). They leave the position as it is and nothing can follow a grasp, so `PosePlanner` puts them
after what brings the object to its place. One image serves all of it: a hand before a thing that a
push has turned is, in the frame of the image taken before, a hand turned back.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch

from affordlib.models.frame import turn_image
from affordlib.models.protocol import EffectModel, condition_on_primitives
from affordlib.perception import adapt_to_object
from affordlib.planning.effect_map import checked_image
from affordlib.primitives import Grasp, Rotate, wrap_angle
from affordlib.types import Goal, Step, check_finite, check_pair, check_within

SAMPLES = 301
Z_90 = 1.28
"""So many σ above a foreseen height are not yet beyond belief (90 %)."""

FULL_ROTATION_SHARE = 0.9
"""Of its sweep, by which a whole rotation has to turn an object to count as one."""

GRIPPER_YAWS_RAD = tuple(np.radians([0, 15, -15, 30, -30, 45, -45, 60, -60, 75, -75, 90]).tolist())
"""Angles of the hand that are weighed, the least first: the fingers are alike, so 180° in all."""


def aligned_gripper_yaws(yaw_rad: float) -> tuple[float, ...]:
    """Angles at which a hand takes an object as one at another angle has left it, unturned."""
    return tuple(wrap_angle(yaw_rad + k * math.pi / 2) for k in (0, 1, -1))


@dataclass(frozen=True)
class PredictedTrajectories:
    """One channel of the effect over the phase (n,): mean and std (m, n), for m angles of the hand.

    The effect is zero before anything.
    """

    grip_yaws: tuple[float, ...]
    phase: np.ndarray
    mean: np.ndarray
    std: np.ndarray


@torch.no_grad()
def predict_trajectories(
    model: EffectModel,
    image: np.ndarray,
    primitive: Grasp | Rotate,
    channel: str,
    grip_yaws: Sequence[float] = GRIPPER_YAWS_RAD,
) -> PredictedTrajectories:
    """What a model expects of a primitive for each angle of the hand [rad].

    Raises ValueError where the model has no such channel.
    """
    if not len(grip_yaws):
        raise ValueError("grip_yaws must hold at least one angle of the hand, got none")
    grip_yaws = [check_finite("grip_yaws", yaw) for yaw in grip_yaws]
    if channel not in model.effect_channels:
        raise ValueError(
            f"channel {channel!r} is not among the effects {model.effect_channels} of the model; "
            f"give the model of {primitive.name}"
        )
    turn = torch.tensor([[math.cos(yaw), -math.sin(yaw)] for yaw in grip_yaws])
    seen = model.encode(turn_image(checked_image(image), turn))
    t = torch.linspace(0, 1, SAMPLES).expand(len(turn), -1)
    observed = condition_on_primitives(
        model, [replace(adapt_to_object(primitive, image), grip_yaw=0.0)] * len(turn)
    )
    told = model.predict(seen, observed, t)
    k = model.effect_channels.index(channel)
    mean, std = (v[:, :, k].double().numpy() for v in (told.effect_mean, told.effect_std))
    return PredictedTrajectories(tuple(grip_yaws), t[0].double().numpy(), mean - mean[:, :1], std)


def predict_trajectory(
    model: EffectModel, image: np.ndarray, primitive: Grasp | Rotate, channel: str
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The same for the primitive's own angle of the hand: phases, mean and σ, (n,) each."""
    told = predict_trajectories(model, image, primitive, channel, [primitive.grip_yaw])
    return told.phase, told.mean[0], told.std[0]


def crossings(phase: np.ndarray, values: np.ndarray, wanted: float) -> np.ndarray:
    """Phases at which a course, straight between its samples, has the wanted value."""
    below = values < wanted
    at = np.flatnonzero(below[1:] != below[:-1])
    share = (wanted - values[at]) / (values[at + 1] - values[at])
    return phase[at] + share * (phase[at + 1] - phase[at])


def plan_turn(
    model: EffectModel,
    image: np.ndarray,
    xy_m: Sequence[float],
    turn_rad: float,
    grip_yaws: Sequence[float] = GRIPPER_YAWS_RAD,
) -> Step | None:
    """The rotation that turns an object at (x, y) by an angle, or as far towards it as it can.

    grip_yaws: the angles of the hand to choose from, as `choose_turn` does.
    """
    return choose_turn(
        predict_trajectories(model, image, Rotate(), "yaw", grip_yaws), xy_m, turn_rad
    )


def choose_turn(
    courses: PredictedTrajectories, xy_m: Sequence[float], turn_rad: float
) -> Step | None:
    """Of courses of yaw, the hand and the phase that turn an object at (x, y) by an angle.

    Closing, the fingers align a cuboid; then the hand turns counter-clockwise, so an angle far
    behind is reached by going on around. Of the angles at which the hand may begin, the one that
    is surest (least σ) to have the object turned as wanted while it is held. Where none has, the
    surest whole rotation of those that turn it by most of their sweep is taken, and another has to
    follow. None when none is foreseen to turn it by 1°.
    """
    wanted = wrap_angle(check_finite("turn_rad", turn_rad))
    phase, mean, std = courses.phase, courses.mean, courses.std
    closed, opening = Rotate().segment_phases[2], Rotate().segment_phases[-2]
    held = (phase >= closed) & (phase <= opening)
    stops = [
        (float(np.interp(stop, phase, unsure)), k, float(stop))
        for k, (course, unsure) in enumerate(zip(mean, std, strict=True))
        for around in (0.0, 2 * math.pi)
        for stop in crossings(phase[held], course[held], wanted + around)
    ]
    if stops:
        _, k, stop = min(stops)
    else:
        end = mean[:, -1]
        if end.max() < math.radians(1):
            return None
        enough = end >= min(FULL_ROTATION_SHARE * Rotate.sweep_rad, end.max())
        k, stop = int(np.where(enough, std[:, -1], np.inf).argmin()), 1.0
    turned = float(np.interp(stop, phase, mean[k]))
    return _step_at(xy_m, Rotate(courses.grip_yaws[k]), stop, predicted_turn_rad=turned)


def plan_lift(
    model: EffectModel,
    image: np.ndarray,
    xy_m: Sequence[float],
    height_m: float,
    grip_yaws: Sequence[float] = GRIPPER_YAWS_RAD,
) -> Step | None:
    """The grasp that ends holding an object from (x, y) at a height [m] above where it stands.

    grip_yaws: the angles of the hand to choose from, as `choose_lift` does.
    """
    return choose_lift(predict_trajectories(model, image, Grasp(), "z", grip_yaws), xy_m, height_m)


def choose_lift(
    courses: PredictedTrajectories, xy_m: Sequence[float], height_m: float
) -> Step | None:
    """Of courses of z, the hand and the phase that hold an object from (x, y) at a height [m].

    Of the angles of the hand the one that is sure (mean less σ) to lift it highest, of equals (to
    a centimetre) the first. None when the model is sure (90 %) that it does not get so high, or
    slips.
    """
    height = check_within("height_m", height_m, 0.0, 0.5, "m")
    phase = courses.phase
    k = int((courses.mean - courses.std)[:, -1].round(2).argmax())
    course, std, primitive = courses.mean[k], courses.std[k], Grasp(grip_yaw=courses.grip_yaws[k])
    if course.max() < height <= course[-1] + Z_90 * std[-1]:
        # It may slip, or not; if it does not, it goes where the hand goes.
        hand = primitive.path(phase)[:, 2]
        course = np.maximum(hand - hand[phase >= primitive.segment_phases[-2]][0], 0.0)
    lifting = phase >= primitive.segment_phases[-2]
    stops = crossings(phase[lifting], course[lifting], height)
    if not len(stops):
        return None
    return _step_at(xy_m, primitive, float(stops[0]), predicted_height_m=height)


def _step_at(
    xy_m: Sequence[float], primitive: Grasp | Rotate, stop_phase: float, **foreseen: float
) -> Step:
    """A step that leaves the object at its place."""
    place = check_pair("xy_m", xy_m)
    path = np.array([place, place])
    return Step(primitive, stop_phase, place, path, std_m=0.0, **foreseen)


TURN_TOLERANCE_RAD = math.radians(2)
MAX_TURNS = 7
"""A whole round in sweeps of 60°, and one more for what aligning may turn back."""


@dataclass(frozen=True)
class PosePlanner:
    """The steps that turn and lift an object as a goal wants it, from one image (2, 48, 48) of it.

    rotate, grasp: the models; can_act: whether the arm can act, by primitive and position [m].
    What the models say is kept, so that a search can ask at every node.
    """

    image: np.ndarray
    rotate: EffectModel
    grasp: EffectModel
    can_act: Callable[[str, Sequence[float]], bool] = lambda *_: True
    _kept: dict[tuple[type, tuple[float, ...]], PredictedTrajectories] = field(default_factory=dict)

    def __call__(
        self, goal: Goal, xy_m: Sequence[float], turned_rad: float = 0.0, std_m: float = 0.0
    ) -> tuple[Step, ...] | None:
        """The steps for an object at (x, y) that has turned since its image was taken.

        std_m: σ of that position. None where the goal's orientation or height cannot be had.
        """
        if goal.turn_rad is None and goal.height_m is None:
            return ()
        turns = self._turns(goal, xy_m, turned_rad)
        if turns is None:
            return None
        turned = turns[-1].predicted_turn_rad if turns else turned_rad
        lifts = ()
        if goal.height_m is not None:
            lift = self._lift(goal.height_m, xy_m, turned, turns[-1] if turns else None)
            if lift is None:
                return None
            lifts = (replace(lift, predicted_turn_rad=turned),)
        return tuple(replace(step, std_m=std_m) for step in (*turns, *lifts))

    def _turns(self, goal: Goal, xy_m: Sequence[float], turned_rad: float) -> list[Step] | None:
        steps, turned = [], turned_rad
        for _ in range(MAX_TURNS + 1):
            off = 0.0 if goal.turn_rad is None else wrap_angle(goal.turn_rad - turned)
            if abs(off) <= TURN_TOLERANCE_RAD:
                return steps
            courses = self._courses(Rotate, "yaw", GRIPPER_YAWS_RAD)
            step = choose_turn(courses, xy_m, off)
            if step is None or not self.can_act("rotate", xy_m):
                return None
            hand = Rotate(_least(step.primitive.grip_yaw + turned))
            turned += step.predicted_turn_rad
            steps.append(replace(step, primitive=hand, predicted_turn_rad=turned))
        return None

    def _lift(
        self, height_m: float, xy_m: Sequence[float], turned_rad: float, after: Step | None
    ) -> Step | None:
        """A grasp at any angle; after a rotation as that left the object, or it is turned back."""
        angles = GRIPPER_YAWS_RAD
        if after is not None:
            hand = float(after.primitive.path(after.stop_phase)[0, 3])
            angles = aligned_gripper_yaws(hand - turned_rad)
        step = choose_lift(self._courses(Grasp, "z", angles), xy_m, height_m)
        if step is None or not self.can_act("grasp", xy_m):
            return None
        return replace(step, primitive=Grasp(grip_yaw=_least(step.primitive.grip_yaw + turned_rad)))

    def _courses(
        self, kind: type[Grasp] | type[Rotate], channel: str, angles: tuple[float, ...]
    ) -> PredictedTrajectories:
        """What comes of hands at angles relative to the image, to half a degree."""
        key = kind, tuple(round(2 * math.degrees(angle)) / 2 for angle in angles)
        if key not in self._kept:
            model = self.rotate if kind is Rotate else self.grasp
            told = predict_trajectories(
                model, self.image, kind(), channel, np.radians(key[1]).tolist()
            )
            self._kept[key] = told
        return replace(self._kept[key], grip_yaws=angles)


def _least(yaw_rad: float) -> float:
    """The same hand, its fingers being alike, turned as little as can be."""
    return (yaw_rad + math.pi / 2) % math.pi - math.pi / 2
