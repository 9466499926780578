"""Studies of the limits of prediction: errors of the object's pose, partial actions, reachability.

pose_sensitivity: repeats pushes with an error of 1 mm and 1° in the object's estimated pose.
partial_execution: tests models of full actions on partial actions that stop at phase t, against
the state of the full action at t and against the object's rest position.
reachability_accuracy: compares learned reachability with the arm's kinematics at new positions.
"""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import torch

from affordlib.interactions import open_interactions
from affordlib.interactions.recipes import Recipe, sample_scene, sample_world
from affordlib.models.checkpoint import load_checkpoint
from affordlib.models.predictions import about_objects
from affordlib.models.protocol import condition_on_primitives
from affordlib.planning.reachability import Reachability
from affordlib.primitives import Drag, Grasp, Push, Rotate
from affordlib.world import Tabletop
from experiments.planning import POSITION_ERROR_M, YAW_ERROR_RAD
from experiments.runner import Rows, study

N_PUSHES, REPEATS = 200, 3
WHOLE_ACTION_MODELS = ("film_500", "film_5000", "drag_film_500")
PHASES = (0.0, 0.55, 0.65, 0.75, 1.0)
"""Edges of the phase bins; the gripper touches nothing before 0.5."""

N_PLACES = 1000
NEAR_THE_LIMIT = (0.2, 0.8)
"""Range of learned probabilities at positions near the limit of the arm's reach."""


@study("push_test", settings=(N_PUSHES, REPEATS, POSITION_ERROR_M, YAW_ERROR_RAD))
def pose_sensitivity() -> Rows:
    """Measure the change of displacement and final position due to errors of the object's pose."""
    data = open_interactions("push_test")
    recipe = Recipe.from_json(data.attrs["recipe"])
    rng = np.random.default_rng(0)
    moved, ended = np.empty((2, N_PUSHES, REPEATS))
    with Tabletop(recipe.world) as world:
        for k in range(N_PUSHES):
            index = int(data["interaction"][k])
            obj, yaw, _ = sample_scene(recipe, index)
            config = sample_world(recipe, index, obj)
            recorded = data["effect"].values[k, -1]
            for r in range(REPEATS):
                side, sign = rng.uniform(0, math.tau), rng.choice([-1, 1])
                bias = POSITION_ERROR_M * np.array([math.cos(side), math.sin(side)])
                perturbed = replace(config, bias_m=tuple(bias))
                world.place(obj, (0.0, 0.0), yaw + sign * YAW_ERROR_RAD, config=perturbed)
                done = world.execute_primitive(
                    Push(float(data["theta"][k])), record_unreachable=True
                ).effect[-1]
                moved[k, r] = math.dist(done[:2], recorded[:2])
                ended[k, r] = math.dist(done[:2], recorded[:2] + bias)
    rows, kinds = [], np.array(about_objects(data, np.arange(N_PUSHES))["family"])
    for name in sorted(set(kinds)):
        row = {"object_class": str(name), "n": int((kinds == name).sum()), "repeats": REPEATS}
        for what, error in (("displacement", moved), ("end", ended)):
            row[f"{what}_mean_m"] = float(error[kinds == name].mean())
            row[f"{what}_median_m"] = float(np.median(error[kinds == name]))
        rows.append(row)
    return rows


@study("partial", checkpoints=WHOLE_ACTION_MODELS, settings=PHASES)
@torch.no_grad()
def partial_execution() -> Rows:
    """Measure the errors on partial actions of networks trained only on full actions."""
    data = open_interactions("partial")
    names = data["primitive"].attrs["flag_meanings"].split()
    kinds = np.array(names)[data["primitive"].values]
    phase = data["stop_phase"].values
    whole, rest = (data[name].values for name in ("full_effect", "rest_effect"))
    slid = np.hypot(*(rest - whole)[:, :2].T)
    rows = []
    for name in WHOLE_ACTION_MODELS:
        model, _ = load_checkpoint(name)
        kind = Drag if name.startswith("drag") else Push
        mine = np.flatnonzero((kinds == kind.name) & ~data["fault"].values)
        actions = [kind(float(theta)) for theta in data["theta"].values[mine]]
        image = torch.from_numpy(data["image"].values[mine])
        at = torch.from_numpy(phase[mine]).float()[:, None]
        predicted = model.predict(model.encode(image), condition_on_primitives(model, actions), at)
        columns = [model.effect_channels.index(c) for c in "xy"]
        mean = predicted.effect_mean[:, 0, columns].numpy()
        errors = [np.hypot(*(mean - truth[mine, :2]).T) for truth in (whole, rest)]
        for low, high in pairwise(PHASES):
            of = (phase[mine] > low) & (phase[mine] <= high)
            row = {"model": name, "from_phase": low, "to_phase": high, "n": int(of.sum())}
            for what, error in zip(("whole", "rest"), errors, strict=True):
                row[f"{what}_mean_m"] = float(error[of].mean())
                row[f"{what}_median_m"] = float(np.median(error[of]))
            rows.append(row | {"slid_mean_m": float(slid[mine][of].mean())})
    return rows


@study(checkpoints=("reachability",), settings=(N_PLACES, NEAR_THE_LIMIT))
def reachability_accuracy() -> Rows:
    """Measure the agreement of learned reachability, with threshold ½, with the kinematics."""
    model, rng = Reachability.load(), np.random.default_rng(0)
    rows = []
    with Tabletop() as world:
        for kind in (Push, Drag, Grasp, Rotate):
            likely, can = np.empty(N_PLACES), np.empty(N_PLACES, bool)
            for k in range(N_PLACES):
                place = rng.uniform([-0.45, -0.65], [0.65, 0.65])
                angle = rng.uniform(-math.pi, math.pi) if kind in (Push, Drag) else None
                action = kind() if angle is None else kind.towards(angle)
                can[k] = world.can_reach(action, at_xy_m=tuple(place))
                likely[k] = model.probability(kind.name, place[None], angle)[0]
            right = (likely > 0.5) == can
            near = (likely > NEAR_THE_LIMIT[0]) & (likely < NEAR_THE_LIMIT[1])
            both = (right[can].mean() + right[~can].mean()) / 2
            rows.append(
                {
                    "primitive": kind.name,
                    "n": N_PLACES,
                    "can_percent": 100 * float(can.mean()),
                    "agree_percent": 100 * float(right.mean()),
                    "balanced_percent": 100 * float(both),
                    "edge_percent": 100 * float(near.mean()),
                    "agree_off_edge_percent": 100 * float(right[~near].mean()),
                }
            )
    every = {k: float(np.mean([r[k] for r in rows])) for k in rows[0] if k.endswith("_percent")}
    return [*rows, {"primitive": "all", "n": sum(r["n"] for r in rows)} | every]
