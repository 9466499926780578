"""Benchmarks of speed: `make bench`, or `python -m experiments.speed --only planning --keep`.

Each function measures one topic and returns the rows of a table; `--keep` writes them to
`data/results/speed.json`. Compared variants run alternately, so that a varying load of the machine
affects both.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from itertools import product
from typing import Any
from unittest import mock

import numpy as np
import pandas as pd
import pybullet
import torch
from torch.utils.flop_counter import FlopCounterMode

from affordlib import models
from affordlib.interactions import (
    InteractionTensors,
    Scaler,
    open_interactions,
    sampling,
    split_interactions,
)
from affordlib.interactions.recipes import RECIPES, interact
from affordlib.models.evaluation import final_errors_m
from affordlib.planning import EffectMap, PlanningProblem, plan_astar, plan_continuous
from affordlib.primitives import PRIMITIVES, Push
from affordlib.results import read_results, repo_root, write_results
from affordlib.types import Observations
from affordlib.world import STANDING, Tabletop
from experiments.commands import command
from experiments.literal import LITERAL, sample_literal, train_literal
from experiments.runner import Rows
from experiments.shipped import uniform_tasks

RESULTS = "data/results/speed.json"


def seconds(work: Callable[[], object], repeats: int = 1) -> float:
    """Return the mean time of a call [s]; on one thread CPU time, which excludes other programs."""
    clock = time.process_time if torch.get_num_threads() == 1 else time.perf_counter
    began = clock()
    for _ in range(repeats):
        work()
    return (clock() - began) / repeats


def ratio_row(what: str, ratios: Sequence[float]) -> dict[str, Any]:
    """Return a row with median and range of the ratios of slow to fast; one ratio has no range."""
    low, high = (min(ratios), max(ratios)) if len(ratios) > 1 else (None, None)
    median = float(np.median(ratios))
    return {"what": what, "ratio_median": median, "ratio_min": low, "ratio_max": high}


def primitives(n: int = 24) -> Rows:
    """Measure interactions per second on one core, and the ratio of total time to physics only."""
    rows = []
    with Tabletop() as world:
        step_simulation, whole_s, bare_s = world.client.stepSimulation, np.empty(n), np.empty(n)
        for name in (name for name in PRIMITIVES if name in RECIPES):
            interact(RECIPES[name], 0, world)
            for index in range(n):
                steps_s: list[float] = []
                timed = partial(lambda into: into.append(seconds(step_simulation)), steps_s)
                with mock.patch.object(pybullet, "stepSimulation", timed):
                    whole_s[index] = seconds(partial(interact, RECIPES[name], index, world))
                bare_s[index] = sum(steps_s)
            row = {"primitive": name, "per_second": 1 / whole_s.mean(), "n": n}
            rows.append(row | {"ratio_median": float(np.median(whole_s / bare_s))})
    return rows


def _pushes() -> list[InteractionTensors]:
    """Return training and validation pushes."""
    data = open_interactions("push")
    split = split_interactions(data.sizes["interaction"])
    return [InteractionTensors.from_dataset(data, part) for part in (split.train, split.validation)]


def _step(network: models.EffectNetwork, loss: Callable, fused: bool | None) -> Callable[[], None]:
    """Return a function that makes one training step on the loss that `loss` returns."""
    optimiser = torch.optim.Adam(network.parameters(), 1e-4, fused=fused)

    def step() -> None:
        loss().backward()
        optimiser.step()
        optimiser.zero_grad(set_to_none=True)

    return step


def training(
    size: int = 64, n_targets: int = 32, rounds: int = 5, iterations: int = 20_000
) -> Rows:
    """Measure targets per second in batches, relative to the paper's loop with one per iteration.

    Also measures a batch's share of this machine's rate of matrix products, and the time to the
    error of the paper's loop after `iterations` (which takes a quarter of an hour).
    """
    pushes, validation = _pushes()
    generator = torch.Generator().manual_seed(0)

    def network() -> models.EffectNetwork:
        torch.manual_seed(0)
        return models.build(models.CNPConfig(), Scaler.fit(pushes))

    def one() -> torch.Tensor:
        return model.loss(sample_literal(pushes, 10, generator))

    def many() -> torch.Tensor:
        some = pushes.select(torch.randint(len(pushes), (size,), generator=generator))
        return model.loss(sampling.sample_mixed(some, n_targets, 10, generator))

    model = network().train()
    literal, batched = _step(model, one, None), _step(model, many, True)
    with FlopCounterMode(display=False) as counter:
        many().backward()
    a, b = torch.rand(2, 1024, 1024)
    literal(), batched()
    ratios, shares = [], []
    for _ in range(rounds):
        one_s, many_s = seconds(literal, 20), seconds(batched, 3)
        products_per_s = 2 * 1024**3 / seconds(lambda: a @ b, 10)
        ratios.append(size * n_targets * one_s / many_s)
        shares.append(counter.get_total_flops() / many_s / products_per_s)

    model, began = network(), time.perf_counter()
    train_literal(model, pushes, validation, replace(LITERAL, steps=iterations))
    literal_s = time.perf_counter() - began
    error = float(final_errors_m(model.eval(), validation).mean())
    # Small batches, because as long as errors are large, many steps help more than accurate ones.
    small = {"steps": 600, "validate_every": 10, "patience": 99, "batch_size": 8, "n_targets": 8}
    history = models.train(network(), pushes, validation, models.TrainingConfig(**small))
    reached = next((h.seconds for h in history if h.validation_error <= error), np.inf)
    return [
        ratio_row("targets a second, batches : the paper's loop", ratios),
        ratio_row("speed of a batch : of matrix products", shares),
        ratio_row("time to one error, the paper's loop : batches", [literal_s / reached]),
    ]


def prediction() -> Rows:
    """Compare one call for 180 pushes with one call for each, which encodes the image each time.

    It is measured on one core, and then on all cores, for an otherwise idle machine.
    """
    rows, (pushes, _) = [], _pushes()
    configs = (models.CNPConfig(), models.FiLMConfig())
    for threads, config in product(sorted({1, os.cpu_count()}), configs):
        torch.set_num_threads(threads)
        model = models.build(config, Scaler.fit(pushes)).eval()
        rows += _prediction_rows(model, pushes.image[:1], threads)
    torch.set_num_threads(1)
    return rows


@torch.inference_mode()
def _prediction_rows(model: models.EffectNetwork, image: torch.Tensor, threads: int) -> Rows:
    pushes = [Push(float(a)) for a in np.linspace(0, 2 * np.pi, 180, endpoint=False)]
    each = [models.condition_on_primitives(model, [p]) for p in pushes]
    every = models.condition_on_primitives(model, pushes)
    end, phases, encoded = torch.ones(1, 1), torch.linspace(0, 1, 25)[None], model.encode(image)

    def query(t: torch.Tensor, *some: Observations, features: torch.Tensor | None = None) -> None:
        for seen in some:
            known = model.encode(image) if features is None else features
            model.predict(known, seen, t.expand(len(seen.weight), -1))

    # The compared calls, and the factor from the measured slow calls to all of them.
    ends, at_once = partial(query, end, *each), partial(query, end, every)
    known, together = (partial(query, t, every, features=encoded) for t in (end, phases))
    name = type(model).__name__ + (f" on {threads} cores" if threads > 1 else "")
    rows = []
    for what, slow, fast, share in (
        ("final positions", ends, at_once, 1),
        ("final positions, image encoded before", ends, known, 1),
        ("trajectories, a call a push", partial(query, phases, *each[::10]), together, 10),
        ("trajectories, a call a step", partial(query, end, *each[::10]), together, 250),
    ):
        slow(), fast()
        pairs = np.array([(share * seconds(slow), seconds(fast, 5)) for _ in range(5)])
        slow_ms, fast_ms = 1000 * np.median(pairs, axis=0)
        told = f"{name}, 180 {what}: {slow_ms:.0f} : {fast_ms:.1f} ms"
        rows.append(ratio_row(told, (pairs[:, 0] / pairs[:, 1]).tolist()))
    return rows


def planning(n_goals: int = 15, seed: int = 300) -> Rows:
    """Measure milliseconds per plan; `whole` includes the map of the effects of a new object."""
    film = models.load_checkpoint("film_5000")[0]
    modes = {"single_partial": "one action", "multi_partial": "up to three actions"}
    planners = {
        "A*, to the disc": partial(plan_astar, heuristic="disc"),
        "continuous": plan_continuous,
        "first plan": partial(plan_continuous, draft=True),
    }
    times: dict[tuple[str, ...], list[float]] = defaultdict(list)

    def whole(planner: Callable, problem: PlanningProblem) -> None:
        planner(replace(problem, effects=EffectMap(film, problem.effects.image)))

    with Tabletop() as world:
        for task in [t for mode in modes for t in uniform_tasks(mode, n_goals, seed, STANDING)]:
            world.place(task.obj, (0.0, 0.0), task.yaw_rad)
            effects = EffectMap(film, world.depth_image())
            times["map",].append(seconds(lambda e=effects: e.spline))
            effects.fine_grid  # noqa: B018, computed once per object
            problem = PlanningProblem(world.object_pose()[:2], task.goal, effects, task.mode)
            for name, planner in planners.items():
                times[name, task.mode].append(seconds(partial(planner, problem)))
                times[name, task.mode, "whole"].append(seconds(partial(whole, planner, problem)))
    median = {key: 1000 * float(np.median(values)) for key, values in times.items()}
    rows = []
    for mode, name in product(modes, planners):
        row = {"planner": name, "goals": modes[mode], "median_ms": median[name, mode]}
        rows.append(row | {"whole_median_ms": median[name, mode, "whole"]})
    map_ms = median["map",]
    return [
        *rows,
        {"planner": "map", "goals": "an object", "median_ms": map_ms, "whole_median_ms": None},
    ]


MEASUREMENTS = {f.__name__: f for f in (planning, prediction, primitives, training)}


@command(OSError, ValueError)
def main(argv: Sequence[str] | None = None) -> int:
    """Run the named benchmarks, or all but `training`, which takes a quarter of an hour."""
    parser = argparse.ArgumentParser(prog="python -m experiments.speed", description=main.__doc__)
    names = list(MEASUREMENTS)
    parser.add_argument("--only", nargs="+", choices=names, default=names[:-1])
    parser.add_argument("--keep", action="store_true", help=f"write the rows to {RESULTS}")
    options = parser.parse_args(argv)
    torch.set_num_threads(1)
    for name in options.only:
        rows = MEASUREMENTS[name]()
        load = f"load {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores"
        print(f"{name}: {load}\n{pd.DataFrame(rows).to_string(index=False)}", flush=True)
        if options.keep:
            path = repo_root() / RESULTS
            tables = read_results(path)["tables"] if path.is_file() else {}
            write_results(path.parent, path.stem, {}, dict(sorted((tables | {name: rows}).items())))
    return 0


if __name__ == "__main__":
    sys.exit(main())
