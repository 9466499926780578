"""Adaptation in the perturbed world: do predictions and plans improve after a few pushes?

    python -m experiments.adaptation

The hidden parameters are the same in all pushes of an object. Pushes reveal one of them, the
camera's position error: the object ends where the gripper stops, so its measured displacement
differs from the prediction by about this error. The robot subtracts its estimate of the error.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, Self

import numpy as np
import pandas as pd
import torch

from affordlib.geometry import rotated
from affordlib.interactions.recipes import Variation
from affordlib.models.checkpoint import load_checkpoint
from affordlib.planning import EffectMap
from affordlib.primitives import Push
from affordlib.world import STANDING, Tabletop, TabletopObject, WorldConfig, category_named
from experiments import runner
from experiments.commands import command
from experiments.planning import CONFIGS, attempt
from experiments.real_pushes import named
from experiments.runner import FOLDER, Job, Rows, frame, interval
from experiments.tasks import EARLIEST_STOP, frozen_tasks, tasks_sha256

TABLE, PLANS = "adaptation", CONFIGS["perturbed_corrected"]
N_OTHERS, N_TESTS, SHOTS = 40, 2, (0, 2, 5, 10)


@lru_cache(maxsize=1)
def robot() -> tuple[Tabletop, Any, Any]:
    """Return a simulated world, what poses problems in it, and the planner's network."""
    torch.set_num_threads(1)
    world = Tabletop()
    return world, PLANS.pose(world), load_checkpoint(PLANS.model)[0]


def push_often(obj: TabletopObject, config: WorldConfig, rng: np.random.Generator) -> Rows:
    """Push an object repeatedly in random directions, each time from the table's centre.

    error_m: error of the camera; beyond_m: measured minus predicted displacement, along the push
    and to its left; truly_m: the same with the ground truth; std_m: the network's σ.
    """
    (world, _, model), rows = robot(), []
    for _ in range(max(SHOTS) + N_TESTS):
        angle, stop = rng.uniform(-math.pi, math.pi), rng.uniform(EARLIEST_STOP, 1.0)
        config = replace(config, noise_seed=int(rng.integers(2**31)))
        world.place(obj, (0.0, 0.0), rng.uniform(-math.pi, math.pi), config=config)
        done = world.execute_primitive(Push.towards(angle), stop)
        action = torch.tensor([angle]).double(), torch.tensor([stop]).double()
        mean, std = (v[0, :2].numpy() for v in EffectMap(model, done.image)(*action))
        seen = np.subtract(world.observe().xy_m, done.estimated_xy_m)
        row = {"angle": angle, "error_m": done.estimated_xy_m, "std_m": std}
        for name, moved in (("beyond_m", seen), ("truly_m", done.rest_effect[:2])):
            row[name] = rotated(moved, -angle) - mean
        rows.append({name: np.asarray(value).tolist() for name, value in row.items()})
    return rows


@dataclass(frozen=True)
class Camera:
    """Gaussian prior of the camera's error, mean_m (x, y) and sd_m, and its update from pushes.

    The network's σ² includes the variance of this error. The rest of σ² and noise_m, the noise of
    two observations, are the measurement noise of the update.
    """

    mean_m: tuple[float, float]
    sd_m: float
    noise_m: float

    @classmethod
    def fit(cls, others: Sequence[dict[str, Rows]]) -> Self:
        """Estimate the prior from observations of many objects at known positions."""
        errors = np.array([[push["error_m"] for push in other["pushes"]] for other in others])
        of_object, noise_m = errors.mean(axis=1), math.sqrt(2) * errors.std(axis=1).mean()
        sd_m = float(of_object.std(axis=0).mean())
        return cls(tuple(of_object.mean(axis=0).tolist()), sd_m, float(noise_m))

    def error_m(self, pushes: Rows) -> np.ndarray:
        """Return the posterior mean (2,) [m] of the error after some pushes."""
        precision, weighted = np.eye(2) / self.sd_m**2, np.array(self.mean_m) / self.sd_m**2
        for push in pushes:
            variance = np.maximum(np.square(push["std_m"]) - self.sd_m**2, 0) + self.noise_m**2
            axes = rotated(np.eye(2), push["angle"])  # ahead and to the left
            precision += axes.T / variance @ axes
            weighted += axes.T / variance @ push["beyond_m"]
        return np.linalg.solve(precision, weighted)


def known(camera: Camera, pushes: Rows) -> dict[str, np.ndarray]:
    """Return estimates (2,) of the camera's error: zero, after pushes, ground truth."""
    after = {f"{n} pushes": camera.error_m(pushes[:n]) for n in SHOTS}
    true = np.mean([push["error_m"] for push in pushes], axis=0)
    return {"nothing": np.zeros(2)} | after | {"the error": true}


def measure(camera: Camera | None, kind: str, number: int) -> dict[str, Rows]:
    """Return pushes of another object, or errors at a goal per estimate of the camera error."""
    rng = np.random.default_rng([2_000_029, number])
    if kind == "other":
        obj = category_named(STANDING[number % len(STANDING)]).sample(rng)
        return {"pushes": push_often(obj, Variation().sample(obj, rng), rng)}
    task, (world, pose, _), errors = frozen_tasks("perturbed")[number], robot(), []
    for name, error_m in known(camera, push_often(task.obj, task.config, rng)).items():
        config = replace(task.config, bias_m=tuple(task.config.bias_m - error_m))
        done = attempt(world, replace(task, config=config), pose, PLANS.plan, **PLANS.execution)
        planned = done.object_paths_xy_m[: len(done.plan.steps)]
        plan_m = task.goal.distance_m(planned[-1][-1]) if planned else done.distance_m
        for of, error in (("plan", plan_m), ("corrected plan", done.distance_m)):
            errors.append({"of": of, "known": name, "error_m": error})
    return {"errors": errors}


def job(kind: str, number: int, camera: Camera | None = None) -> Job:
    """Return the job for pushes of another object, which are used to fit the camera, or a goal."""
    settings = [PLANS, tasks_sha256("perturbed"), SHOTS, N_TESTS]
    arguments = {"kind": kind, "number": number}
    return Job(partial(measure, camera), arguments, settings, checkpoints=(PLANS.model,))


def tables(folder: str | Path = FOLDER) -> dict[str, Rows]:
    """Return the camera's prior, and errors by estimate with paired differences.

    Prediction errors are for the last pushes of the other objects.
    """
    results, errors, rows = runner.read(TABLE, job, folder), [], []
    others = [result for about, result in results if about["kind"] == "other"]
    camera = Camera.fit(others)
    for k, pushes in enumerate(other["pushes"] for other in others):
        for name, error_m in known(camera, pushes).items():
            off = [p["truly_m"] - rotated(error_m, -p["angle"]) for p in pushes[max(SHOTS) :]]
            error = {"of": "prediction", "error_m": np.linalg.norm(off, axis=1).mean()}
            errors.append({"number": k, "known": name} | error)
    every = pd.concat([pd.DataFrame(errors), frame(results, "errors")])
    for (of, name), some in every.groupby(["of", "known"], sort=False):
        nothing = every[(every["of"] == of) & (every["known"] == "nothing")]
        error, without = (table.set_index("number")["error_m"] for table in (some, nothing))
        row = {"of": of, "known": name, "n": len(some), "mean_m": error.mean()}
        row |= {"sem_m": error.sem(), "median_m": error.median()}
        off = interval(error - without)
        rows.append(row | dict(zip(named("difference", "m"), off, strict=True)))
    return {"camera": [vars(camera)], "errors": rows}


@command(OSError, ValueError)
def main(argv: Sequence[str] | None = None) -> int:
    """Push, plan and make the table; only missing results are computed."""
    options = runner.parser(TABLE, main.__doc__).parse_args(argv)
    others = [job("other", k) for k in range(N_OTHERS)]
    camera = Camera.fit(runner.run(others, TABLE, folder=options.raw))
    numbers = [k for k, t in enumerate(frozen_tasks("perturbed")) if t.mode == "multi_partial"]
    goals = [job("goal", k, camera) for k in numbers if k % 2 == 0]
    return runner.make(goals, TABLE, options, tables)


if __name__ == "__main__":
    raise SystemExit(main())
