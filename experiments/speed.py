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
from affordlib.commands import command
from affordlib.evaluation.tasks import STANDING
from affordlib.interactions import (
    InteractionTensors,
    Scaler,
    open_interactions,
    sampling,
    split_interactions,
)
from affordlib.interactions.lever_up import N_OBSERVED, N_PREDICTED, lever_up_tensors
from affordlib.interactions.recipes import RECIPES, interact
from affordlib.models.lever_up import LEVER_MODELS, predict_steps
from affordlib.models.training import batch_loss, final_errors_m
from affordlib.paths import repo_root
from affordlib.planning import EffectMap, PlanningProblem, plan_astar, plan_continuous
from affordlib.planning.astar import N_DIRECTIONS, STOP_PHASES, BranchTable, search
from affordlib.planning.continuous import DIRECTION_SPREAD_RAD, MIN_STOP_PHASE, N_REFINED
from affordlib.primitives import PRIMITIVES, Push
from affordlib.results import read_results, write_results
from affordlib.types import Observations
from affordlib.world import Tabletop
from experiments import lstm_seker2019
from experiments.literal import sample_literal, train_literal
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


def ratio_row(what: str, ratios: Sequence[float], goal: float) -> dict[str, Any]:
    """Return a row with median and range of the ratios of slow to fast; one ratio has no range."""
    low, high = (min(ratios), max(ratios)) if len(ratios) > 1 else (None, None)
    row = {"what": what, "ratio_median": float(np.median(ratios)), "ratio_min": low}
    return row | {"ratio_max": high, "goal": goal}


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
        return batch_loss(model, sample_literal(pushes, 10, generator))

    def many() -> torch.Tensor:
        some = pushes.select(torch.randint(len(pushes), (size,), generator=generator))
        return batch_loss(model, sampling.sample_mixed(some, n_targets, 10, generator))

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
    train_literal(model, pushes, iterations)
    literal_s = time.perf_counter() - began
    error = float(final_errors_m(model.eval(), validation).mean())
    # Small batches, because as long as errors are large, many steps help more than accurate ones.
    small = {"steps": 600, "validate_every": 10, "patience": 99, "batch_size": 8, "n_targets": 8}
    history = models.train(network(), pushes, validation, models.TrainingConfig(**small))
    reached = next((h.seconds for h in history if h.validation_error <= error), np.inf)
    return [
        ratio_row("training, batched : literal", ratios, 150),
        ratio_row("share of the matrix rate", shares, 0.5),
        ratio_row("time to the literal loop's error, literal : batched", [literal_s / reached], 20),
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
    for what, slow, fast, share, goal in (
        ("final positions", ends, at_once, 1, 100),
        ("final positions, image encoded before", ends, known, 1, 100),
        ("trajectories, a call a push", partial(query, phases, *each[::10]), together, 10, 30),
        ("trajectories, a call a step", partial(query, end, *each[::10]), together, 250, 30),
    ):
        slow(), fast()
        pairs = np.array([(share * seconds(slow), seconds(fast, 5)) for _ in range(5)])
        slow_ms, fast_ms = 1000 * np.median(pairs, axis=0)
        told = f"{name}, 180 {what}: {slow_ms:.0f} : {fast_ms:.1f} ms"
        rows.append(ratio_row(told, (pairs[:, 0] / pairs[:, 1]).tolist(), goal))
    return rows


def lever_up(n: int = 256, epoch: int = 1440) -> Rows:
    """Measure training and prediction of lever-ups for conditional and recurrent networks.

    An epoch has as many windows as there are training trajectories. Predictions are the next five
    steps of a window, and all 25 steps from the image only, for one object and for 64 at once.
    """
    data, rows = open_interactions("lever_up").isel(interaction=slice(0, n + 8)), []
    for name, lever in [*LEVER_MODELS.items(), ("lstm_seker2019", None)]:
        arrays = lever_up_tensors(data, view=lever.view if lever else "full")
        arrays = arrays.select(torch.arange(n))
        if lever:
            model, size = models.build(lever.network, Scaler.fit(arrays)).train(), 64
            epochs = lever.training.steps * size / epoch
        else:
            channels = arrays.action_channels, arrays.effect_channels
            config = lstm_seker2019.SekerConfig(*channels)
            model = lstm_seker2019.SekerLSTM(config, Scaler.fit(arrays)).train()
            size, epochs = lstm_seker2019.BATCH, lstm_seker2019.EPOCHS
        generator = torch.Generator().manual_seed(0)

        def loss(model=model, arrays=arrays, size=size, lever=lever, g=generator) -> torch.Tensor:
            part = arrays.select(torch.randint(0, n, (size,), generator=g))
            if lever is None:
                start = torch.randint(0, 11, (size,), generator=g)
                return model.next_step_loss(part, start, N_OBSERVED)
            batch = sampling.sample_windows(part, N_PREDICTED, N_OBSERVED, g)
            return batch_loss(model, batch, 0.5)

        step = _step(model, loss, True)
        step()
        epoch_s = min(seconds(step) for _ in range(5 if lever else 2)) * epoch / size
        row = {"model": name, "epoch_s": epoch_s, "training_s": epoch_s * epochs}
        model.eval()
        for count, protocol in product((1, 64), ("window", "image_only")):
            query = partial(predict_steps, model, arrays.select(torch.arange(count)), protocol)
            query()
            row[f"{protocol}_{count}_ms"] = 1000 * min(seconds(query) for _ in range(5))
        rows.append(row)
    return rows


NAIVE = (
    ("A*, to the disc", "an expansion is 180 calls"),
    ("continuous", "one start"),
    ("continuous", f"{N_REFINED} starts"),
    ("first plan", None),
)


def planning(n_goals: int = 15, seed: int = 300) -> Rows:
    """Measure milliseconds per plan, and the ratio to naive planners.

    `whole` includes the effect map of a new object. Naive A* evaluates the network for each branch,
    including the image. The naive continuous planner differentiates through the whole network until
    the predicted error is below 1 mm, from one start, or from as many in turn as ours uses at once.
    """
    film = models.load_checkpoint("film_5000")[0]
    modes = {"single_partial": "one action", "multi_partial": "up to three actions"}
    first = partial(plan_continuous, draft=True)
    astar = partial(plan_astar, heuristic="disc")
    planners = {NAIVE[0][0]: astar, "continuous": plan_continuous, "first plan": first}
    times: dict[tuple[str | None, ...], list[float]] = defaultdict(list)

    def whole(planner: Callable, problem: PlanningProblem) -> None:
        planner(replace(problem, effects=EffectMap(film, problem.effects.image)))

    def measure(work: Callable[[], object], *key: str, times_as_much: int = 1) -> None:
        times[key].append(1000 * times_as_much * seconds(work))

    with Tabletop() as world:
        for task in [t for mode in modes for t in uniform_tasks(mode, n_goals, seed, STANDING)]:
            world.place(task.obj, (0.0, 0.0), task.yaw_rad)
            image, mode = world.depth_image(), task.mode
            effects = EffectMap(film, image)
            measure(lambda e=effects: e.spline, "map")
            problem = PlanningProblem(world.object_pose()[:2], task.goal, effects, mode)
            effects.fine_grid  # noqa: B018, computed once per object
            phases, expanded = STOP_PHASES if problem.mode.partial else (1.0,), []
            search(problem, BranchTable(effects, N_DIRECTIONS, phases), expanded, "disc")
            for name, planner in planners.items():
                measure(partial(planner, problem), name, mode)
                measure(partial(whole, planner, problem), name, mode, "whole")
            if len(times[NAIVE[0][0], mode]) % 5 == 1:
                rng, naive = np.random.default_rng(seed), partial(_naive_descent, problem)
                branches = partial(_naive_branches, film, image)
                measure(branches, NAIVE[0][0], mode, NAIVE[0][1], times_as_much=len(expanded))
                measure(naive, "continuous", mode, NAIVE[1][1])
                each = [seconds(partial(naive, rng)) for _ in range(N_REFINED)]
                times["continuous", mode, NAIVE[2][1]].append(1000 * sum(each))
    median = {key: float(np.median(values)) for key, values in times.items()}
    rows = []
    for mode, (planner, naive) in product(modes, NAIVE):
        whole_ms = median[planner, mode, "whole"]
        row = {"planner": planner, "goals": modes[mode], "median_ms": median[planner, mode]}
        ratio = median[planner, mode, naive] / whole_ms if naive else None
        rows.append(row | {"whole_median_ms": whole_ms, "naive": naive, "ratio": ratio})
    row = {"planner": "map", "goals": "an object", "median_ms": median["map",]}
    return [*rows, row | dict.fromkeys(("whole_median_ms", "naive", "ratio"))]


@torch.no_grad()
def _naive_branches(model: models.EffectNetwork, image: np.ndarray) -> None:
    for angle, stop in product(np.arange(N_DIRECTIONS) * (2 * np.pi / N_DIRECTIONS), STOP_PHASES):
        features, push = EffectMap(model, image).features, [Push(angle)]
        model.predict(features, models.condition_on_primitives(model, push), torch.tensor([[stop]]))


def _naive_descent(problem: PlanningProblem, rng: np.random.Generator | None = None) -> None:
    """Optimise from the goal's direction, or with a generator from a random start like ours."""
    model, image = problem.effects.model, problem.effects.image
    target = torch.tensor(np.subtract(problem.goal.xy_m, problem.start_xy_m), dtype=torch.float32)
    n = 1 if problem.mode.max_steps == 1 else max(1, int(np.ceil(float(target.norm()) / 0.09)))
    direction, phase = torch.atan2(target[1], target[0]).repeat(n), torch.full((n,), 0.9)
    if rng is not None:
        spread = rng.uniform(-DIRECTION_SPREAD_RAD, DIRECTION_SPREAD_RAD, n)
        direction += torch.from_numpy(spread).float()
        phase = torch.from_numpy(rng.uniform(MIN_STOP_PHASE, 1.0, n)).float()
    optimiser = torch.optim.Adam([direction.requires_grad_(), phase.requires_grad_()], lr=0.02)
    x, y = (model.effect_channels.index(name) for name in "xy")
    for _ in range(300):
        end = torch.zeros(2)
        for angle, stop in zip(direction, phase.clamp(0, 1), strict=True):
            straight = models.condition_on_primitives(model, [Push.towards(0.0)])
            turn = torch.stack([angle.cos(), -angle.sin(), angle.sin(), angle.cos()]).view(2, 2)
            seen = replace(straight, action=straight.action[:, [0, -1]] @ turn.T)
            told = model.predict(EffectMap(model, image).features, seen, stop.view(1, 1))
            end = end + told.effect_mean[0, 0, [x, y]]
        loss = (end - target).square().sum()
        if float(loss.detach().sqrt()) < 0.001:
            return
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()


MEASUREMENTS = {f.__name__: f for f in (lever_up, planning, prediction, primitives, training)}


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
