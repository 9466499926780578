"""How long a plan takes, beside its naive form, in one run on one core.

Naive A* asks the network anew for each branch, image and all. The naive continuous planner descends
the same two numbers an action, through the whole network in every iteration, until it expects to
end within a millimetre: from one start, straight at the goal, and from as many starts, one after
the other, as ours follows at once. A first plan is the continuous planner's draft. `map` is what an
object costs once; `whole` are plans of an object never seen before, its map and all. Seconds are of
one core's work, so that others on the machine take none.

    python -m experiments.speed.planning [--keep]
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
import torch

from affordlib.evaluation.goals import STANDING, uniform_tasks
from affordlib.models import load_checkpoint, observe_actions
from affordlib.planning import EffectMap, PlanningProblem, plan_astar, plan_continuous
from affordlib.planning.astar import N_DIRECTIONS, STOP_PHASES
from affordlib.planning.continuous import EARLIEST, KEPT, SPREAD_RAD
from affordlib.primitives import Push
from affordlib.world import Tabletop
from experiments.speed.keeping import keep

N_GOALS = 15
SEED = 300
MODES = {"single_partial": "one action", "multi_partial": "up to three actions"}
PLANNERS = {
    "A*": plan_astar,
    "continuous": plan_continuous,
    "first plan": partial(plan_continuous, draft=True),
}
MAX_ITERATIONS = 300
ENOUGH_M = 0.001


def milliseconds(call: Callable[[], object]) -> float:
    began = time.process_time()
    call()
    return 1000 * (time.process_time() - began)


@torch.no_grad()
def naive_branches(model, image) -> None:
    """Every branch a call of the whole network: what one expansion costs without a map."""
    for angle in np.arange(N_DIRECTIONS) * (2 * np.pi / N_DIRECTIONS):
        for stop in STOP_PHASES:
            features = EffectMap(model, image).features
            model.predict(features, observe_actions(model, [Push(angle)]), torch.tensor([[stop]]))


def naive_descent(model, image, start_xy_m, goal, mode, rng=None) -> float:
    """One start, the gradient through every call; the distance [m] expected.

    Straight at the goal, or, with a generator, from where one of our many starts might be.
    """
    target = torch.tensor(np.subtract(goal.xy_m, start_xy_m), dtype=torch.float32)
    n = 1 if mode.startswith("single") else max(1, int(np.ceil(float(target.norm()) / 0.09)))
    bearing = torch.atan2(target[1], target[0])
    direction, phase = bearing.repeat(n).clone(), torch.full((n,), 0.9)
    if rng is not None:
        direction += torch.from_numpy(rng.uniform(-SPREAD_RAD, SPREAD_RAD, n)).float()
        phase = torch.from_numpy(rng.uniform(EARLIEST, 1.0, n)).float()
    direction.requires_grad_()
    phase.requires_grad_()
    optimiser = torch.optim.Adam([direction, phase], lr=0.02)
    x, y = (model.effect_channels.index(name) for name in "xy")
    for _ in range(MAX_ITERATIONS):
        end = torch.zeros(2)
        for angle, stop in zip(direction, phase.clamp(0, 1), strict=True):
            start, travel = observe_actions(model, [Push.towards(0.0)]).action[0, [0, -1]]
            turn = torch.stack([angle.cos(), -angle.sin(), angle.sin(), angle.cos()]).view(2, 2)
            way = torch.stack([turn @ start, turn @ travel])[None]
            seen = replace(observe_actions(model, [Push.towards(0.0)]), action=way)
            told = model.predict(EffectMap(model, image).features, seen, stop.view(1, 1))
            end = end + told.effect_mean[0, 0, [x, y]]
        loss = (end - target).square().sum()
        if float(loss.detach().sqrt()) < ENOUGH_M:
            break
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    return float(loss.detach().sqrt())


def main() -> None:
    torch.set_num_threads(1)
    film = load_checkpoint("push_film_x10")[0]
    rows: dict[str, list[float]] = {}

    def add(name: str, value: float) -> None:
        rows.setdefault(name, []).append(value)

    with Tabletop() as world:
        for mode in MODES:
            for task in uniform_tasks(mode, N_GOALS, SEED, STANDING):
                world.place(task.thing, (0.0, 0.0), task.yaw_rad)
                image, start, goal = world.look(), world.object_pose()[:2], task.goal
                add(
                    "map of an object",
                    milliseconds(lambda i=image: EffectMap(film, i).coefficients),
                )
                problem = PlanningProblem(start, goal, EffectMap(film, image), mode)
                effects = problem.effects

                def whole(planner, problem=problem):
                    anew = EffectMap(film, problem.effects.image)
                    return planner(replace(problem, effects=anew))

                add("its fine grid", milliseconds(lambda e=effects: e.fine_grid))
                query = (film, image, start, goal, mode)
                plan = plan_astar(problem)
                for name, planner in PLANNERS.items():
                    add(f"{name}, {mode}", milliseconds(lambda p=planner, q=problem: p(q)))
                    add(f"{name}, {mode}, whole", milliseconds(lambda p=planner, w=whole: w(p)))
                if len(rows["map of an object"]) % 5 == 1:
                    each = milliseconds(lambda i=image: naive_branches(film, i))
                    add("180 branches, naive", each)
                    add(f"A*, {mode}, naive (an expansion is 180 calls)", each * plan.evaluations)
                    add(
                        f"continuous, {mode}, naive (one start)",
                        milliseconds(lambda q=query: naive_descent(*q)),
                    )
                    rng = np.random.default_rng(SEED)
                    starts = [
                        milliseconds(lambda q=query, r=rng: naive_descent(*q, r))
                        for _ in range(KEPT)
                    ]
                    add(f"continuous, {mode}, naive ({KEPT} starts)", sum(starts))
    print(f"{'':50s} {'median ms':>10s} {'p10':>8s} {'p90':>8s} {'n':>4s}")
    for name, values in rows.items():
        low, high = np.quantile(values, [0.1, 0.9])
        print(f"{name:50s} {np.median(values):10.1f} {low:8.1f} {high:8.1f} {len(values):4d}")
    kept = []
    for mode, words in MODES.items():
        for planner, form in (
            ("A*", "an expansion is 180 calls"),
            ("continuous", "one start"),
            ("continuous", f"{KEPT} starts"),
            ("first plan", None),
        ):
            ours, whole = (
                float(np.median(rows[f"{planner}, {mode}{end}"])) for end in ("", ", whole")
            )
            row = {"planner": planner, "goals": words, "median_ms": ours, "whole_median_ms": whole}
            ratio = form and float(np.median(rows[f"{planner}, {mode}, naive ({form})"])) / whole
            if form:
                print(f"{planner}, {mode}: {ratio:.0f} x faster than naive ({form}), map and all")
            kept.append(row | {"naive": form, "ratio": ratio})
    once = float(np.median(rows["map of an object"]))
    row = {"planner": "map", "goals": "an object", "median_ms": once, "whole_median_ms": None}
    kept.append(row | {"naive": None, "ratio": None})
    keep("planning", kept)


if __name__ == "__main__":
    main()
