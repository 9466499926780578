"""What a plan ends with where a goal has an orientation or a height: rotations, then a grasp.

The paper adds grasp and rotate to the branches of the search when the goal asks for them (Section
3.4). They leave the position as it is and nothing can follow a grasp, so they branch off only where
the position holds; a node from which they do not lead to the goal is none of the goal's nodes. One
look serves all of it: a hand before a thing that a push has turned is, in the frame of the image
taken before, a hand turned back.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from affordlib.models.protocol import EffectModel
from affordlib.planning.poses import (
    GRIP_YAWS,
    Courses,
    choose_lift,
    choose_turn,
    foresee_courses,
    hands_in_line,
)
from affordlib.primitives import Grasp, Rotate, wrap_angle
from affordlib.types import Goal, Plan, Step

TURN_TOLERANCE_RAD = math.radians(2)
MAX_TURNS = 7
"""A whole round in sweeps of 60°, and one more for what aligning may turn back."""


@dataclass(frozen=True)
class Finish:
    """The steps that turn and lift an object as a goal wants it, from one image (2, 48, 48) of it.

    rotate, grasp: the models; can_act: whether the arm can act, by primitive and position [m].
    What the models say is kept, so that a search can ask at every node.
    """

    image: np.ndarray
    rotate: EffectModel
    grasp: EffectModel
    can_act: Callable[[str, Sequence[float]], bool] = lambda *_: True
    _kept: dict[tuple[type, tuple[float, ...]], Courses] = field(default_factory=dict)

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
            courses = self._courses(Rotate, "yaw", GRIP_YAWS)
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
        angles = GRIP_YAWS
        if after is not None:
            hand = float(after.primitive.path(after.stop_phase)[0, 3])
            angles = hands_in_line(hand - turned_rad)
        step = choose_lift(self._courses(Grasp, "z", angles), xy_m, height_m)
        if step is None or not self.can_act("grasp", xy_m):
            return None
        return replace(step, primitive=Grasp(grip_yaw=_least(step.primitive.grip_yaw + turned_rad)))

    def _courses(
        self, kind: type[Grasp] | type[Rotate], channel: str, angles: tuple[float, ...]
    ) -> Courses:
        """What comes of hands at angles relative to the image, to half a degree."""
        key = kind, tuple(round(2 * math.degrees(angle)) / 2 for angle in angles)
        if key not in self._kept:
            model = self.rotate if kind is Rotate else self.grasp
            told = foresee_courses(model, self.image, kind(), channel, np.radians(key[1]).tolist())
            self._kept[key] = told
        return replace(self._kept[key], grip_yaws=angles)


def finished(plan: Plan, finish: Finish | None, began_s: float) -> Plan:
    """A plan that brings an object to its place, with what turns and lifts it there, and its time.

    began_s: when planning began, by `time.perf_counter`. A plan that lacks the turn or the height
    which its goal asks for does not reach the goal.
    """
    goal, steps = plan.goal, plan.steps
    reaches = plan.reaches_goal
    if reaches and (goal.turn_rad is not None or goal.height_m is not None):
        turned, std_m = (steps[-1].predicted_turn_rad, steps[-1].std_m) if steps else (0.0, 0.0)
        end = None if finish is None else finish(goal, plan.predicted_end_xy_m, turned, std_m)
        steps, reaches = steps + (end or ()), end is not None
    seconds = time.perf_counter() - began_s
    return replace(plan, steps=steps, reaches_goal=reaches, plan_s=seconds)


def _least(yaw_rad: float) -> float:
    """The same hand, its fingers being alike, turned as little as can be."""
    return (yaw_rad + math.pi / 2) % math.pi - math.pi / 2
