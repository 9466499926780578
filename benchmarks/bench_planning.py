"""How long a plan takes, beside its naive form, in one run on one core.

Naive A* asks the network anew for each branch, image and all; the naive gradient planner has one
start and the whole network in every iteration. `map` is what an object costs once.

    python benchmarks/bench_planning.py
"""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
import torch

from affordlib.evaluation.goals import STANDING, uniform_tasks
from affordlib.models import load_checkpoint, observe_actions
from affordlib.planning import map_effects, plan_astar, plan_continuous, plan_gradient
from affordlib.planning.astar import N_DIRECTIONS, STOP_PHASES
from affordlib.planning.modes import encode_image
from affordlib.primitives import Push
from affordlib.world import Tabletop

N_GOALS = 15
SEED = 300


def milliseconds(call: Callable[[], object]) -> float:
    began = time.perf_counter()
    call()
    return 1000 * (time.perf_counter() - began)


@torch.no_grad()
def naive_branches(model, image) -> None:
    """Every branch a call of the whole network: what one expansion costs without a map."""
    for angle in np.arange(N_DIRECTIONS) * (2 * np.pi / N_DIRECTIONS):
        for stop in STOP_PHASES:
            features = encode_image(model, image)
            model.predict(features, observe_actions(model, [Push(angle)]), torch.tensor([[stop]]))


def main() -> None:
    torch.set_num_threads(1)
    film, paper = (load_checkpoint(name)[0] for name in ("push_film_x10", "push_cnp"))
    rows: dict[str, list[float]] = {}

    def add(name: str, value: float) -> None:
        rows.setdefault(name, []).append(value)

    expansions = []
    with Tabletop() as world:
        for mode in ("single_partial", "multi_partial"):
            for task in uniform_tasks(mode, N_GOALS, SEED, STANDING):
                world.place(task.thing, (0.0, 0.0), task.yaw_rad)
                image, start, goal = world.look(), world.object_pose()[:2], task.goal
                add("map of an object", milliseconds(lambda i=image: map_effects(film, i)))
                effects = map_effects(film, image)
                add("its fine grid", milliseconds(lambda e=effects: e.fine_grid))
                query = (film, image, start, goal, mode)
                plan = plan_astar(*query, effects=effects)
                add(f"A*, {mode}", 1000 * plan.plan_s)
                plan_s = plan_continuous(*query, effects=effects).plan_s
                add(f"continuous, {mode}", 1000 * plan_s)
                expansions.append(plan.evaluations)
                if len(rows["map of an object"]) % 5 == 1:
                    each = milliseconds(lambda i=image: naive_branches(film, i))
                    add("180 branches, naive", each)
                    add(f"A*, {mode}, naive (an expansion is 180 calls)", each * plan.evaluations)
                    query = (paper, *query[1:])
                    add(f"gradient, literal, {mode}", 1000 * plan_gradient(*query).plan_s)
    print(f"{'':50s} {'median ms':>10s} {'p10':>8s} {'p90':>8s} {'n':>4s}")
    for name, values in rows.items():
        low, high = np.quantile(values, [0.1, 0.9])
        print(f"{name:50s} {np.median(values):10.1f} {low:8.1f} {high:8.1f} {len(values):4d}")
    for mode in ("single_partial", "multi_partial"):
        naive = np.median(rows[f"A*, {mode}, naive (an expansion is 180 calls)"])
        ours = np.median(rows[f"A*, {mode}"]) + np.median(rows["map of an object"])
        print(f"A*, {mode}: {naive / ours:.0f} x faster than naive, the map counted")
        literal = np.median(rows[f"gradient, literal, {mode}"])
        ours = np.median(rows[f"continuous, {mode}"]) + np.median(rows["map of an object"])
        print(
            f"continuous, {mode}: {literal / ours:.1f} x faster than the literal gradient planner"
        )


if __name__ == "__main__":
    main()
