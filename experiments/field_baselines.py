"""Standard planners and a physics-based model, compared with ours in Table 3.

plan_astar_continuous: A*, with direction and stop phase of its last action optimised.
plan_cem: the cross-entropy method on the effect map, with our planner's objective.
LimitSurface: a quasi-static model of pushing in place of a network.
"""

from __future__ import annotations

import math
import time

import numpy as np
import torch
from scipy import ndimage
from scipy.optimize import minimize
from torch import Tensor
from torch.nn.functional import grid_sample

from affordlib.geometry import quarter_turn, rotate
from affordlib.interactions import InteractionTensors, split_interactions
from affordlib.logs.physics import ELLIPSOID, quasi_static_push
from affordlib.models.base import condition_on_primitives
from affordlib.planning import PlanningProblem, continuous, plan_astar
from affordlib.planning.rollout import make_steps, roll_out
from affordlib.primitives import PUSH_GAP_M, Push, min_jerk
from affordlib.types import CROP_WIDTH_M, Observations, Plan, Prediction
from experiments.runner import open_once

N_CHAINS, ROUNDS, N_ELITE = 218, 16, 22
"""Cross-entropy method: chains sampled per round, rounds, and number of elite chains.

In total 3,488 chains, about as many as our planner evaluates for a goal of three actions."""

MOVES_M = 0.001
"""Actions that move the object by less than this [m] are removed from a plan."""


def plan_astar_continuous(problem: PlanningProblem) -> Plan:
    """Plan with A*, then optimise the last action so that its predicted end is the goal."""
    began = time.perf_counter()
    plan = plan_astar(problem)
    if not plan.steps:
        return plan
    effects, (*first, last) = problem.effects, plan.steps
    start, turned = problem.start_xy_m, first[-1].predicted_turn_rad if first else 0.0
    left = np.subtract(problem.goal.xy_m, first[-1].predicted_end_xy_m if first else start)
    # The last action as a single one, in a frame rotated back by the object's predicted turn.
    back = torch.tensor(-turned, dtype=torch.float64)
    action = [last.primitive.direction_rad - turned, last.stop_phase]
    angle, stop = torch.tensor(action, dtype=torch.float64)[:, None, None]
    target = rotate(torch.from_numpy(left), back)
    better, _ = continuous.correct(effects, target, (angle, stop), problem.mode.partial, 20)
    chain = [(s.primitive.direction_rad, s.stop_phase) for s in first]
    chain = torch.tensor([*chain, (float(better[0, 0]) + turned, float(better[0, 1]))]).double()
    steps = make_steps(effects, start, chain)
    return problem.plan_of(steps, "astar_continuous", plan.reaches_goal, began)


def plan_cem(problem: PlanningProblem, seed: int = 0) -> Plan:
    """Plan with the cross-entropy method: sample chains, fit a Gaussian to the elite, repeat.

    Initial means are the goal's direction and a stop phase of 0.75, with the same spread as in our
    planner. The plan is the best of all chains, without actions that move nothing.
    """
    began = time.perf_counter()
    effects, mode, rng = problem.effects, problem.mode, np.random.default_rng(seed)
    goal = np.subtract(problem.goal.xy_m, problem.start_xy_m)
    mean = np.tile([math.atan2(goal[1], goal[0]), 0.75], (mode.max_steps, 1))
    std = np.broadcast_to([continuous.DIRECTION_SPREAD_RAD, 0.25], mean.shape)
    best, least = torch.from_numpy(mean), math.inf
    for _ in range(ROUNDS):
        drawn = mean + std * rng.standard_normal((N_CHAINS, *mean.shape))
        drawn[..., 1] = drawn[..., 1].clip(effects.kind.acts_from, 1) if mode.partial else 1.0
        chains = torch.from_numpy(drawn)
        cost, _ = continuous.objective(effects, torch.from_numpy(goal), chains.unbind(-1))
        if problem.obstacles:  # those that are not free are taken only where there are no others
            cost = cost + 1.0 * ~continuous.free(problem, chains.unbind(-1))
        order = cost.argsort()[:N_ELITE]
        elite = drawn[order]
        mean, std = elite.mean(axis=0), elite.std(axis=0)
        if cost[order[0]] < least:
            best, least = chains[order[0]], float(cost[order[0]])
    if problem.obstacles and least > 1.0:
        return problem.plan_of((), "cem", False, began)
    positions, _, _ = roll_out(effects, *best.T[:, None])
    moved = positions[0].diff(dim=0, prepend=torch.zeros(1, 2)).norm(dim=-1)
    steps = make_steps(effects, problem.start_xy_m, best[moved > MOVES_M])
    end = steps[-1].predicted_end_xy_m if steps else problem.start_xy_m
    reaches = problem.goal.distance_m(end) <= problem.goal.tolerance_m
    return problem.plan_of(steps, "cem", reaches, began)


STEP_M, N_FITTED = 0.001, 100
"""Quasi-static model: step of the gripper [m], and number of training pushes for its fit."""

FINGER_AHEAD_M, FINGER_WIDTH_M = 0.01, 0.012
"""Distance [m] of the fingers' front from the tool's tip, and width [m] of each finger."""


class LimitSurface:
    """A physics-based `EffectModel` of pushes: ellipsoidal limit surface and Coulomb friction.

    The footprint is the image's mask, the centre of mass the image's middle. The fronts of both
    fingers advance in small steps, and the contact is the deepest point inside the object. It has
    two parameters, friction and the ratio of torque to force in radii of gyration, and no σ.
    """

    action_channels, effect_channels = ("x", "y"), ("x", "y", "yaw")

    def __init__(self, friction: float, size: float) -> None:
        self.friction, self.size = friction, size

    def encode(self, image: Tensor) -> Tensor:
        """Return the smoothed masks (B, 1, 48, 48)."""
        return torch.from_numpy(ndimage.gaussian_filter(image[:, 1:].numpy(), (0, 0, 1, 1)))

    def predict(self, features: Tensor, observations: Observations, t_target: Tensor) -> Prediction:
        """Predict as any model does; the action must be observed at t = 0 and t = 1."""
        travel = observations.action[:, -1] - observations.action[:, 0]
        length_m = travel.norm(dim=-1, keepdim=True)
        poses = self._poses(features.expand(len(travel), -1, -1, -1), travel / length_m)
        at = torch.from_numpy(min_jerk(t_target.numpy())).float() * (len(poses) - 1)
        before = at.long().clamp_max(len(poses) - 2)
        row = torch.arange(len(travel))[:, None]
        mean = torch.lerp(poses[before, row], poses[before + 1, row], (at - before)[..., None])
        action = observations.action[:, -1:].expand(-1, mean.shape[1], -1)
        return Prediction(action, torch.full_like(action, 1e-5), mean, torch.full_like(mean, 1e-5))

    @torch.no_grad()
    def _poses(self, mask: Tensor, ahead: Tensor) -> Tensor:
        """Return poses (S + 1, B, 3) after each step of full pushes in directions (B, 2)."""
        n, push = len(ahead), Push(0.0)
        axis = (torch.arange(mask.shape[-1]) + 0.5) / mask.shape[-1] - 0.5
        square = (axis[:, None] ** 2 + axis**2) * CROP_WIDTH_M**2
        radius = (torch.einsum("bchw,hw->b", mask, square) / mask.sum((1, 2, 3))).sqrt()[:, None]
        angle = torch.arange(3) * (2 * math.pi / 3)
        ring = [self.size * angle.cos(), self.size * angle.sin(), torch.full((3,), 1 / 3)]
        feet, friction = torch.stack(ring, -1).expand(n, -1, -1), torch.full((n,), self.friction)
        side = PUSH_GAP_M / 2 + FINGER_WIDTH_M * torch.linspace(0, 1, 4)
        tips = torch.cat([side, -side])[:, None] * quarter_turn(ahead)[:, None]
        near = 1e-3 * torch.tensor([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
        free = round((push.radius - FINGER_AHEAD_M - CROP_WIDTH_M / 2) / STEP_M)
        pose, poses = torch.zeros(n, 3), [torch.zeros(n, 3)] * free
        for k in range(free, round((push.radius + push.length) / STEP_M) + 1):
            front = (k * STEP_M - push.radius + FINGER_AHEAD_M) * ahead
            turned = -pose[:, 2:].expand(-1, len(side) * 2)
            local = rotate(front[:, None] + tips - pose[:, None, :2], turned)
            at = (local[:, :, None] + near) * (2 / CROP_WIDTH_M) * torch.tensor([1.0, -1.0])
            share = grid_sample(mask, at, align_corners=False)[:, 0]  # (B, tips, 3)
            deepest = torch.arange(n), share[..., 0].argmax(1)
            share, contact = share[deepest], local[deepest]
            slope = (share[:, 1:] - share[:, :1]) / 1e-3
            normal = slope / slope.norm(dim=-1, keepdim=True).clamp_min(1e-9)
            direction = rotate(ahead, -pose[:, 2])
            inside = share[:, :1] - 0.5
            depth = inside / (slope * direction).sum(-1, keepdim=True).clamp_min(1e-9)
            travel = depth.clamp(1e-7, 2 * STEP_M)
            rows = torch.cat([contact / radius, normal, direction, travel / radius], -1)
            moved = quasi_static_push(rows, feet, friction, ELLIPSOID, 1)
            shift = torch.cat([rotate(moved[:, :2] * radius, pose[:, 2]), moved[:, 2:]], -1)
            pose = pose + torch.where(inside > 0, shift, 0.0)
            poses.append(pose)
        return torch.stack(poses)

    @classmethod
    def fitted(cls) -> LimitSurface:
        """Fit the two parameters to training pushes."""
        data = open_once("push")
        rows = split_interactions(data.sizes["interaction"]).train[:N_FITTED]
        pushes = InteractionTensors.from_dataset(data, rows)
        seen = condition_on_primitives(cls, [Push(float(t)) for t in data["theta"].values[rows]])
        end = torch.ones(len(pushes), 1)

        def error(logs: np.ndarray) -> float:
            model = cls(*np.exp(logs).tolist())
            mean = model.predict(model.encode(pushes.image), seen, end).effect_mean[:, 0, :2]
            return float((mean - pushes.effect[:, -1]).norm(dim=-1).mean())

        found = minimize(error, np.log([0.3, 0.8]), method="Nelder-Mead", options={"maxfev": 40})
        return cls(*np.exp(found.x).tolist())
