"""A robot in pure Python, models with known dynamics, and problems: no simulator, no network."""

import math
from dataclasses import dataclass, field, replace
from types import SimpleNamespace

import numpy as np
import torch

from affordlib.planning import EffectMap, PlanningProblem, Skills
from affordlib.primitives import Grasp, Push, Rotate
from affordlib.types import NothingSeenError, Observation, Observations, Prediction

REACH_M = 0.09
STARTS = 0.6


def moved_m(phase):
    """Distance [m] by which a push that stops at a phase moves the object."""
    return REACH_M * (np.clip(phase - STARTS, 0, 1 - STARTS) / (1 - STARTS)) ** 2


def problem_of(model, image, start_xy_m, goal, mode="multi_partial", kind=Push, **more):
    """A problem, given the model and the image of its effects."""
    return PlanningProblem(start_xy_m, goal, EffectMap(model, image, kind), mode, **more)


class Still:
    """A model of pushes that do not move the object."""

    def predict(self, pushes):
        return np.zeros((len(pushes), 3)), np.ones((len(pushes), 3))


class KnownDynamics:
    """An `EffectModel` of pushes with known dynamics.

    The object moves away from the gripper's start, from t = 0.6 on, by 9 cm in all; queried by a
    final effect, it predicts the nearest push.
    """

    action_channels = effect_channels = ("x", "y")

    def encode(self, image: torch.Tensor) -> torch.Tensor:
        return torch.zeros(len(image), 1)

    def predict(self, features: torch.Tensor, observations: Observations, t_target: torch.Tensor):
        start = observations.action[:, 0] + 1e-9
        wanted = observations.effect[:, 0]
        by_effect = observations.effect_mask.any(1, keepdim=True)
        direction = torch.where(by_effect, wanted, -start)
        direction = direction / direction.norm(dim=-1, keepdim=True)
        share = ((t_target - STARTS) / (1 - STARTS)).clamp(0, 1).square()[..., None]
        effect = REACH_M * share * direction[:, None]
        action = (-0.2 + 0.25 * t_target[..., None]) * direction[:, None]
        std = torch.full_like(effect, 0.001)
        return Prediction(action, std, effect, std)


class FollowsTheHand:
    """An `EffectModel` of a held object: it moves with the hand from closing to opening."""

    def __init__(self, kind, channel):
        self.kind, self.action_channels, self.effect_channels = kind, (channel,), (channel,)

    encode = KnownDynamics.encode

    def predict(self, features, observations, t_target):
        column = {"z": 2, "yaw": 3}[self.effect_channels[0]]
        way = hand_moves(self.kind(), t_target.numpy().ravel())[:, column]
        effect = torch.from_numpy(way).reshape(*t_target.shape, 1).float()
        std = torch.full_like(effect, 0.001)
        return Prediction(effect, std, effect, std)


def hand_moves(primitive, phase):
    """Motion (n, 5) of the hand while it is closed."""
    closed = primitive.segment_phases[2]
    opens = 1.0 if primitive.holds else primitive.segment_phases[-2]
    return primitive.path(np.clip(phase, closed, opens)) - primitive.path(closed)


def point_skills():
    """Skills of the robot, without limits of reach."""
    grasp, rotate = FollowsTheHand(Grasp, "z"), FollowsTheHand(Rotate, "yaw")
    return Skills({"push": KnownDynamics(), "grasp": grasp, "rotate": rotate})


def disc_image(height_m=0.05, radius_m=0.02):
    """Camera image of an upright cylinder."""
    pixel_m = 0.16 / 48
    at = (np.arange(48) - 23.5) * pixel_m
    mask = np.clip((radius_m - np.hypot(at, at[:, None])) / pixel_m + 0.5, 0, 1)
    return np.stack([1.0 - height_m * mask, mask]).astype(np.float32)


@dataclass
class PointRobot:
    """A `Robot` that pushes, turns and lifts a disc; pushes overshoot by a fraction.

    refuses: which actions the arm cannot execute where. before: called with the robot before it
    observes. sees_yaw: whether it measures the yaw, as from a marker. slips: number of lifts in
    which the object slips out of the hand. velocity: of the object [m/s], zero after half a second.
    """

    xy_m: tuple[float, float] = (0.0, 0.0)
    too_far: float = 0.05
    refuses: object = lambda *_: False
    before: object = lambda *_: None
    yaw_rad: float = 0.2
    sees_yaw: bool = True
    slips: int = 0
    velocity: tuple[float, float] = (0.0, 0.0)
    visible: bool = True
    height_m: float = 0.05
    obstacles: tuple = ()
    executed: list = field(default_factory=list)

    def observe(self):
        self.before(self)
        if not self.visible:
            raise NothingSeenError("nothing is seen")
        seen = Observation(self.xy_m, disc_image(self.height_m), obstacles=self.obstacles)
        return replace(seen, yaw_rad=self.yaw_rad, yaw_std_rad=0.001) if self.sees_yaw else seen

    def execute(self, step, seen=None):
        primitive, (x, y) = step.primitive, self.xy_m
        phase = np.linspace(0, step.stop_phase, 26)
        tool, holds = primitive.path(phase), primitive.holds and not self.slips
        tool[:, 4] = np.maximum(primitive.opening_m * tool[:, 4], 0.04 * holds)
        height, yaw = 0.0, self.yaw_rad
        if primitive.name == "push":
            angle, far = primitive.direction_rad, (1 + self.too_far) * moved_m(step.stop_phase)
            self.xy_m = (x + far * math.cos(angle), y + far * math.sin(angle))
        else:
            _, _, height, turned, _ = hand_moves(primitive, np.array([step.stop_phase]))[0].tolist()
            self.yaw_rad = yaw + turned
        self.slips -= primitive.holds and self.slips > 0
        self.executed.append(step)
        path = np.array([[x, y, 0.0, yaw], [*self.xy_m, holds * height, self.yaw_rad]])
        return SimpleNamespace(tool=tool, object_path=path)

    def can_reach(self, primitive, stop_phase, at_xy_m):
        return not self.refuses(primitive, at_xy_m)

    def park(self):
        pass

    def settle(self, seconds=0.5):
        self.xy_m = tuple(np.add(self.xy_m, np.multiply(seconds, self.velocity)).tolist())
        self.velocity = tuple(max(0.0, 1 - 2 * seconds) * v for v in self.velocity)
