"""Studies of what bounds a prediction: how the world spreads, where stopping differs, the arm.

floor: the same push of the same object, which stands a millimetre and a degree off where the robot
believes it: how far its displacement changes, and the place where it ends. stopped: what becomes of
an object when its action is broken off at t, by the state at t of the whole action, and by where
the object comes to rest. reach: the learned reachability against the arm's kinematics, on places
that it was not trained on.
"""

from __future__ import annotations

import hashlib
import math
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import torch

from affordlib.interactions import open_interactions
from affordlib.interactions.recipes import Recipe, sample_scene, sample_world
from affordlib.models.checkpoint import load_checkpoint, weights_bytes
from affordlib.models.protocol import condition_on_primitives
from affordlib.paths import repo_root
from affordlib.planning.reachability import SHIPPED as REACHABILITY
from affordlib.planning.reachability import Reachability
from affordlib.primitives import PRIMITIVES, Drag, Grasp, Push, Rotate
from affordlib.world import Tabletop
from experiments.planning import POSITION_ERROR_M, YAW_ERROR_RAD

Rows = list[dict[str, Any]]

N_PUSHES, REPEATS = 200, 3
STOPPED = ("film_500", "film_5000", "drag_film_500")
PHASES = (0.0, 0.55, 0.65, 0.75, 1.0)
"""Edges of the bins of phases; nothing is touched before 0.5."""

N_PLACES = 1000
EDGE = (0.2, 0.8)
"""Between these the learned probability says that a place is near the edge of the reach."""


def floor_settings() -> tuple[Any, ...]:
    """What decides the rows of `floor` beside its data."""
    return N_PUSHES, REPEATS, POSITION_ERROR_M, YAW_ERROR_RAD


def reach_settings() -> tuple[Any, ...]:
    """What decides the rows of `reach`: sizes, and the reachability that is shipped."""
    shipped = weights_bytes(repo_root() / REACHABILITY)
    return N_PLACES, EDGE, hashlib.sha256(shipped).hexdigest()


def floor() -> Rows:
    """What changes if an object does not stand where it is believed to: displacement, and end."""
    data = open_interactions("push_test")
    recipe, names = Recipe.from_json(data.attrs["recipe"]), _categories(data)
    rng = np.random.default_rng(0)
    moved, ended, turned = np.empty((3, N_PUSHES, REPEATS))
    with Tabletop(recipe.world) as world:
        for k in range(N_PUSHES):
            index = int(data["interaction"][k])
            obj, yaw, _ = sample_scene(recipe, index)
            config = sample_world(recipe, index, obj)
            told = data["effect"].values[k, -1]
            for r in range(REPEATS):
                side, sign = rng.uniform(0, math.tau), rng.choice([-1, 1])
                bias = POSITION_ERROR_M * np.array([math.cos(side), math.sin(side)])
                amiss = replace(config, bias_m=tuple(bias))
                world.place(obj, (0.0, 0.0), yaw + sign * YAW_ERROR_RAD, config=amiss)
                done = world.execute_primitive(
                    Push(float(data["theta"][k])), record_unreachable=True
                ).effect[-1]
                moved[k, r] = math.dist(done[:2], told[:2])
                ended[k, r] = math.dist(done[:2], told[:2] + bias)
                turned[k, r] = abs(done[3] - told[3])
    rows, kinds = [], np.array(names[:N_PUSHES])
    for name in ("all", *sorted(set(kinds))):
        of = (kinds == name) | (name == "all")
        row = {"object_class": name, "n": int(of.sum()), "repeats": REPEATS}
        row |= {"nudged_m": POSITION_ERROR_M, "nudged_rad": YAW_ERROR_RAD}
        for what, error in (("displacement", moved), ("end", ended)):
            row[f"{what}_mean_m"] = float(np.mean([error[kinds == c].mean() for c in {*kinds[of]}]))
            row[f"{what}_median_m"] = float(np.median(error[of]))
            row[f"{what}_p95_m"] = float(np.quantile(error[of], 0.95))
        rows.append(row | {"yaw_error_mean_rad": float(turned[of].mean())})
    return rows


def _categories(data: Any) -> list[str]:
    names = data["family"].attrs["flag_meanings"].split()
    return [names[k] for k in data["family"].values]


@torch.no_grad()
def stopped() -> Rows:
    """Errors of networks that learned from whole actions alone, on actions broken off at t."""
    data = open_interactions("partial")
    kinds = np.array(list(PRIMITIVES))[data["primitive"].values]
    phase = data["stop_phase"].values
    whole, rest = (data[name].values for name in ("full_effect", "rest_effect"))
    slid = np.hypot(*(rest - whole)[:, :2].T)
    rows = []
    for name in STOPPED:
        model, _ = load_checkpoint(name)
        kind = Drag if name.startswith("drag") else Push
        mine = np.flatnonzero((kinds == kind.name) & ~data["fault"].values)
        actions = [kind(float(theta)) for theta in data["theta"].values[mine]]
        seen = torch.from_numpy(data["image"].values[mine])
        at = torch.from_numpy(phase[mine]).float()[:, None]
        told = model.predict(model.encode(seen), condition_on_primitives(model, actions), at)
        columns = [model.effect_channels.index(c) for c in "xy"]
        mean = told.effect_mean[:, 0, columns].numpy()
        errors = [np.hypot(*(mean - truth[mine, :2]).T) for truth in (whole, rest)]
        for low, high in pairwise(PHASES):
            of = (phase[mine] > low) & (phase[mine] <= high)
            row = {"model": name, "from_phase": low, "to_phase": high, "n": int(of.sum())}
            for what, error in zip(("whole", "rest"), errors, strict=True):
                row[f"{what}_mean_m"] = float(error[of].mean())
                row[f"{what}_median_m"] = float(np.median(error[of]))
            rows.append(row | {"slid_mean_m": float(slid[mine][of].mean())})
    return rows


def reach() -> Rows:
    """Agreement of the learned reachability, cut at one half, with the arm's kinematics."""
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
            inside = (likely > EDGE[0]) & (likely < EDGE[1])
            both = (right[can].mean() + right[~can].mean()) / 2
            rows.append(
                {
                    "primitive": kind.name,
                    "n": N_PLACES,
                    "can_percent": 100 * float(can.mean()),
                    "agree_percent": 100 * float(right.mean()),
                    "balanced_percent": 100 * float(both),
                    "edge_percent": 100 * float(inside.mean()),
                    "agree_off_edge_percent": 100 * float(right[~inside].mean()),
                }
            )
    every = {k: float(np.mean([r[k] for r in rows])) for k in rows[0] if k.endswith("_percent")}
    return [*rows, {"primitive": "all", "n": sum(r["n"] for r in rows)} | every]
