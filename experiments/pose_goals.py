"""Pose goals by pushing only: position and yaw of objects that are known only from their image.

    python -m experiments.pose_goals [--only model|goals]

`model` fine-tunes the pretrained neural process on off-centre pushes of random cuboids and prisms,
given their outlines, in the simulated world (about 5 minutes on one core). `goals` plans and
executes with it on other objects, with both cameras (about 5 minutes).
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from affordlib.geometry import rotated, wrap_angle
from affordlib.logs import LoggedPushes, PushedObject, Pushes, plan_push_at
from affordlib.logs.fit import Forecast, PushModel, in_object_frame, push_rows, told_feet
from affordlib.logs.neural_process import load_neural_process, train_neural_process
from affordlib.logs.planning import primitive_of
from affordlib.perception import outline_of, turn_between
from affordlib.results import repo_root, write_results
from affordlib.types import Goal, Observation, Step, UnreachableError
from affordlib.world import Cuboid, Prism, Tabletop, TabletopObject, WorldConfig
from affordlib.world.robot import ROD_WIDTH_M
from experiments.commands import command
from experiments.pretrain_np import save_neural_process

N_PARTS, N_OBJECTS, N_PUSHES, TRAINING = 2, 40, 12, (1500, 5e-4, 32)
HEIGHTS_M = 0.04, 0.06
FIRST_GOAL, N_GOALS, GOAL_PUSHES, GOAL_LENGTHS_M = 10_000, 50, 2, (0.015, 0.045)
CORRECTIONS = 4
TURN_M = 0.04
"""Weight of yaw errors [m/rad] relative to position errors: 3° count as 2 mm."""
N_IMAGES = {"ideal": 1, "kinect": 8}
"""Number of images over which an observation averages, by camera."""
WITHIN_M, WITHIN_RAD = 0.005, math.radians(5)


SEEN = "np_seen_objects"


class PretrainedNeuralProcess:
    """A neural process for objects known only from their image, given feet from their outline."""

    def __init__(self, name_or_path: str | Path = SEEN) -> None:
        self.network = load_neural_process(name_or_path)

    def predict(self, pushes: Pushes) -> Forecast:
        """Predict mean and σ (n, 3) of displacement [m] and turn [rad], in the object's frame."""
        rows, none = push_rows(pushes), torch.zeros(0, 10)
        feet = told_feet(pushes)[0]
        return in_object_frame(pushes, *self.network.predict(rows[:, :7], none, feet))


def drawn_object(rng: np.random.Generator) -> TabletopObject:
    """Sample a cuboid or a prism, 4 to 8 cm wide and 4 to 6 cm tall, as the rod is short."""
    return (Cuboid, Prism)[int(rng.integers(2))].sample(rng, height_range_m=HEIGHTS_M)


def collect(n_objects: int, seed: int) -> tuple[Tensor, Tensor]:
    """Collect pushes (n, 12, 10) of random objects for the neural process, and feet (n, 12, 3)."""
    rng, rows, feet = np.random.default_rng(seed), [], []
    with Tabletop() as world:
        while len(rows) < n_objects:
            obj, done = drawn_object(rng), {}
            drawn = PushedObject(obj.footprint_m, ROD_WIDTH_M / 2).draw(2 * N_PUSHES, rng)
            yaw = rng.uniform(-math.pi, math.pi)
            for k in range(2 * N_PUSHES):
                world.place(obj, (0.0, 0.0), yaw, tool="rod")
                try:
                    effect = world.execute_primitive(primitive_of(drawn, k, yaw))
                except UnreachableError:
                    continue
                if not (effect.faults or effect.fell):
                    done[k] = *rotated(effect.rest_effect[:2], -yaw), effect.rest_effect[3]
                if len(done) == N_PUSHES:
                    break
            if len(done) == N_PUSHES:
                effect = np.array([*done.values()])
                of_one = vars(drawn.select(np.array([*done])))
                effects = {"displacement_m": effect[:, :2], "turn_rad": effect[:, 2]}
                of_one = LoggedPushes(**of_one, **effects)
                rows.append(push_rows(of_one))
                feet.append(told_feet(of_one)[0])
    return torch.stack(rows), torch.stack(feet)


class Remembered:
    """Caches a model's prediction for candidate pushes, which are the same for one seed."""

    def __init__(self, model: PushModel) -> None:
        self.model, self.known = model, None

    def predict(self, pushes: Pushes) -> Forecast:
        """Return the model's prediction for the first pushes."""
        if self.known is None:
            self.known = self.model.predict(pushes)
        return self.known


def observed(world: Tabletop) -> Observation:
    """Observe the object; position and image are means over several images of the Kinect."""
    views = [world.observe() for _ in range(N_IMAGES[world.config.camera])]
    x, y = np.mean([view.xy_m for view in views], axis=0).tolist()
    return Observation((x, y), np.mean([view.image for view in views], axis=0))


def act(world: Tabletop, step: Step, seen: Observation) -> None:
    """Execute a step at the object's position in the plan, whether it is there or not."""
    seen = replace(seen, xy_m=tuple(step.predicted_path_xy_m[0].tolist()))
    world.execute_primitive(step.primitive, seen=seen)


def pursue(
    world: Tabletop,
    model: PushModel,
    goal: tuple[float, float, float],
    obj: PushedObject | None = None,
) -> Iterator[int]:
    """Push an object to a goal (x, y, turn), using only observations.

    A plan of up to three pushes is executed open loop from one observation. Then, up to four times,
    the robot observes the object and executes the first push of a new plan, unless no improvement
    is predicted. obj: the object; None uses the image's outline.
    Yields the number of pushes after the plan, and after the corrections.
    """
    first = seen = observed(world)
    obj = obj or PushedObject.of(PushedObject(outline_of(first.image), ROD_WIDTH_M / 2).draw())
    turned, pushes = 0.0, 0
    for n in (3, *(min(3, k) for k in range(CORRECTIONS, 0, -1))):
        wanted = Goal(goal[:2], 0.001, wrap_angle(goal[2] - turned))
        plan = plan_push_at(model, obj, (*seen.xy_m, turned), wanted, n, turn_m=TURN_M)
        end = plan.steps[-1]
        turn = TURN_M * wrap_angle(end.predicted_turn_rad - wanted.turn_rad)
        expected = math.hypot(plan.predicted_distance_m, turn, end.std_m)
        now = math.hypot(wanted.distance_m(seen.xy_m), TURN_M * wanted.turn_rad)
        if pushes and expected >= now:
            break
        steps = plan.steps[: 1 if pushes else 3]
        for step in steps:
            act(world, step, seen)
        if not pushes:
            yield len(steps)
        pushes += len(steps)
        seen = observed(world)
        turned += steps[-1].predicted_turn_rad
        told = turn_between(first.image, seen.image, turned)
        turned = told[0] if told else turned
    yield pushes


def attempt(world: Tabletop, *arguments) -> list[dict]:
    """Return the errors (ground truth) after the plan and after the corrections of `pursue`."""
    (*_, start), rows = world.object_pose(), []
    goal = arguments[1]
    for pushes in pursue(world, *arguments):
        *xy, yaw = world.object_pose()
        left = abs(wrap_angle(yaw - start - goal[2]))
        rows.append({"corrected": bool(rows), "pushes": pushes})
        rows[-1] |= {"position_m": math.dist(xy, goal[:2]), "yaw_rad": left}
    return rows


def task(world: Tabletop, rng: np.random.Generator) -> tuple[TabletopObject, list, list]:
    """Sample an object, a start pose (x, y, yaw), and a goal pose reached by random pushes."""
    while True:
        obj, start = drawn_object(rng), [*rng.uniform(-0.1, 0.1, 2), rng.uniform(-math.pi, math.pi)]
        world.place(obj, tuple(start[:2]), start[2], tool="rod")
        for _ in range(GOAL_PUSHES):
            drawn = PushedObject(obj.footprint_m, ROD_WIDTH_M / 2, GOAL_LENGTHS_M).draw(1, rng)
            world.execute_primitive(primitive_of(drawn, 0, world.object_pose()[2]))
        if not world.placed.fell():
            return obj, start, [*world.object_pose()]


def summary(rows: list[dict], by: list[str]) -> list[dict]:
    """Return statistics of the trials' errors, grouped by some columns."""
    table = pd.DataFrame(rows)
    near = (table["position_m"] <= WITHIN_M) & (table["yaw_rad"] <= WITHIN_RAD)
    table["within_percent"] = 100.0 * near
    return [
        dict(zip(by, key, strict=True))
        | {"n": len(part), "pushes": part["pushes"].mean()}
        | {
            f"{column}_{statistic}_{unit}": part[f"{column}_{unit}"].agg(statistic)
            for column, unit in (("position", "m"), ("yaw", "rad"))
            for statistic in ("median", "mean", "sem")
        }
        | {"within_percent": part["within_percent"].mean()}
        for key, part in table.groupby(by)
    ]


def goals(n: int = N_GOALS) -> dict[str, list[dict]]:
    """Return the table of goals and its trials."""
    model, rows = PretrainedNeuralProcess(), []
    for camera in N_IMAGES:
        with Tabletop(WorldConfig(camera=camera)) as world:
            for seed in range(FIRST_GOAL, FIRST_GOAL + n):
                obj, (*at, yaw), (*xy, end) = task(world, np.random.default_rng(seed))
                seen_by = replace(world.config, noise_seed=seed)
                world.place(obj, tuple(at), yaw, tool="rod", config=seen_by)
                goal = *xy, wrap_angle(end - yaw)
                about = {"camera": camera, "object_class": obj.category, "seed": seed}
                about |= {"goal_m": math.dist(at, xy), "goal_rad": goal[2]}
                rows += [about | row for row in attempt(world, Remembered(model), goal)]
    return {"goals": summary(rows, ["camera", "corrected"]), "trials": rows}


def tune() -> None:
    """Collect data, fine-tune the model and write the checkpoint."""
    model, parts = load_neural_process(), [collect(N_OBJECTS, seed) for seed in range(N_PARTS)]
    rows, feet = (torch.cat(part) for part in zip(*parts, strict=True))
    train_neural_process(model, rows, feet, TRAINING, torch.Generator().manual_seed(0))
    about = {"objects": len(rows), "pushes": N_PUSHES, "steps": TRAINING[0]}
    save_neural_process(model, repo_root() / f"data/checkpoints/{SEEN}.safetensors", about)


@command(OSError, ValueError)
def main(argv: Sequence[str] | None = None) -> int:
    """Fine-tune the model, execute the goals, or both."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", choices=("model", "goals"))
    only = parser.parse_args(argv).only
    if only != "goals":
        tune()
    if only != "model":
        write_results(repo_root() / "data/results", "pose_goals", {"n_goals": N_GOALS}, goals())
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
