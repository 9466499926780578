"""How much faster the batched network is than the literal one, as ratios of one run.

Training: target points a second of the paper's loop (one trajectory, one target an iteration)
against batches of 64 trajectories with 32 targets, and the share of this machine's matrix rate that
these reach. Asking: the end effects of 180 pushes, and their courses of 25 steps, with one call
against one call each, which looks at the image each time; the one call with its look at the image,
and, as planners ask, of an image that was encoded before. Seconds are of one core's work, so others
on the machine take none; pairs alternate. Then the same on all cores, in seconds of the clock: for
a machine that has nothing else to do. `--long` also trains both to the error that the literal
loop has after 20,000 iterations (a quarter of an hour), the batched one in batches of 8 with 8.
"""

import argparse
import os
import sys
import time
from itertools import product

import numpy as np
import torch

from affordlib.commands import command
from affordlib.interactions import (
    Normaliser,
    TrainingArrays,
    open_interactions,
    split_interactions,
)
from affordlib.interactions.batches import sample_batch
from affordlib.models import (
    CNPConfig,
    FiLMConfig,
    TrainingConfig,
    build,
    observe_actions,
    train,
    train_literal,
)
from affordlib.models.training import batch_loss, final_errors_m, literal_draw
from affordlib.primitives import Push
from experiments.speed.keeping import keep

BATCH, TARGETS = 64, 32
DIRECTIONS, STEPS = 180, 25
ROUNDS = 5
LITERAL_ITERATIONS = 20_000
KEPT = {"training": [], "asking": []}
GOALS = {"training": 150, "share": 0.5, "ends": 100, "courses": 30, "time": 20}


def seconds(work, repeats):
    clock = time.process_time if torch.get_num_threads() == 1 else time.perf_counter
    began = clock()
    for _ in range(repeats):
        work()
    return (clock() - began) / repeats


def multiply_adds(model, batch):
    """Of one forward pass, by counting what linear layers and convolutions really do."""
    from torch.utils.flop_counter import FlopCounterMode

    with FlopCounterMode(display=False) as counter:
        batch_loss(model, batch).backward()
    return counter.get_total_flops()


def stepper(model, draw, fused):
    optimiser = torch.optim.Adam(model.parameters(), 1e-4, fused=fused)

    def step():
        batch_loss(model, draw()).backward()
        optimiser.step()
        optimiser.zero_grad(set_to_none=True)

    return step


def report(table, what, ratios, goal):
    low, middle, high = min(ratios), np.median(ratios), max(ratios)
    print(f"{what:70} {middle:8.2f}   ({low:.2f} to {high:.2f}; goal {goal})")
    row = {"what": what, "ratio_median": middle, "ratio_min": low, "ratio_max": high, "goal": goal}
    KEPT[table].append(row)


def training_rates(training):
    model = build(CNPConfig(), Normaliser.fit(training)).train()
    g = torch.Generator().manual_seed(0)

    def batched():
        rows = torch.randint(len(training), (BATCH,), generator=g)
        return sample_batch(training, rows, TARGETS, 10, g)

    literal = stepper(model, lambda: literal_draw(training, 10, g), fused=None)
    together = stepper(model, batched, fused=True)
    flops = multiply_adds(model, batched())
    a, b = torch.rand(2, 1024, 1024)
    literal(), together()
    ratios, shares = [], []
    for _ in range(ROUNDS):
        one, many = seconds(literal, 20), seconds(together, 3)
        gemm = 2 * 1024**3 / seconds(lambda: a @ b, 10)
        ratios.append(BATCH * TARGETS / many * one)
        shares.append(flops / many / gemm)
    print(f"literal {1 / one:.0f}, batched {BATCH * TARGETS / many:.0f} targets a second")
    print(f"matrix rate {gemm / 1e9:.0f} GFLOP/s, a batch {flops / 1e9:.0f} GFLOP")
    report("training", "training, batched : literal", ratios, GOALS["training"])
    report("training", "share of the matrix rate", shares, GOALS["share"])


@torch.inference_mode()
def asking_rates(training, model):
    """One call for everything, against calls that each look at the image again."""
    image, name = training.image[:1], type(model).__name__
    if (threads := torch.get_num_threads()) > 1:
        name += f" on {threads} cores"
    pushes = [Push(float(a)) for a in np.linspace(0, 2 * np.pi, DIRECTIONS, endpoint=False)]
    each, every = [observe_actions(model, [p]) for p in pushes], observe_actions(model, pushes)
    end, course = torch.ones(1, 1), torch.linspace(0, 1, STEPS)[None]

    def ask(observed, t):
        model.predict(model.encode(image), observed, t)

    def compare(what, apart, together, goal, repeats=1):
        apart(), together()
        pairs = [(repeats * seconds(apart, 1), seconds(together, 5)) for _ in range(ROUNDS)]
        slow, fast = (1000 * np.median(v) for v in zip(*pairs, strict=True))
        report(
            "asking", f"{name}, {what}: {slow:.0f} : {fast:.1f} ms", [a / b for a, b in pairs], goal
        )

    def all_ends():
        ask(every, end.expand(DIRECTIONS, -1))

    def all_courses():
        ask(every, course.expand(DIRECTIONS, -1))

    features = model.encode(image)

    def all_ends_of_kept():
        model.predict(features, every, end.expand(DIRECTIONS, -1))

    compare("180 ends", lambda: [ask(o, end) for o in each], all_ends, GOALS["ends"])
    of_kept = [lambda: [ask(o, end) for o in each], all_ends_of_kept, GOALS["ends"]]
    compare("180 ends, image encoded before", *of_kept)
    of_push = [lambda: [ask(o, course) for o in each[::10]], all_courses, GOALS["courses"], 10]
    compare("180 courses, a call a push", *of_push)
    of_time = [lambda: [ask(o, end) for o in each[::10]], all_courses, GOALS["courses"], 10 * STEPS]
    compare("180 courses, a call a step", *of_time)


def time_to_error(training, validation):
    """Seconds that the batched training needs for the error of the literal loop, as a share."""
    torch.manual_seed(0)
    model = build(CNPConfig(), Normaliser.fit(training))
    began = time.perf_counter()
    train_literal(model, training, LITERAL_ITERATIONS)
    literal_s = time.perf_counter() - began
    error = float(final_errors_m(model.eval(), validation).mean())
    torch.manual_seed(0)
    model = build(CNPConfig(), Normaliser.fit(training))
    # Small batches: as long as errors are large, many steps gain more than sure ones.
    sizes = {"batch_size": 8, "n_targets": 8}
    config = TrainingConfig(steps=600, validate_every=10, patience=99, **sizes)
    history = train(model, training, validation, config, progress=False)
    reached = next((h.seconds for h in history if h.validation_error <= error), np.inf)
    print(f"literal: {1000 * error:.2f} mm after {literal_s:.0f} s; batched after {reached:.0f} s")
    report(
        "training", "time to the literal loop's error, literal : batched", [literal_s / reached], 20
    )


@command(OSError, ValueError)
def main() -> int:
    """Measure training and predicting beside loops over single trajectories."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--long", action="store_true")
    parser.add_argument("--keep", action="store_true")
    long = parser.parse_args().long
    torch.set_num_threads(1)
    print(f"one thread; {os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}")
    data = open_interactions("push")
    split = split_interactions(data.sizes["interaction"])
    training = TrainingArrays.from_dataset(data, split.train)
    training_rates(training)
    for threads, config in product(sorted({1, os.cpu_count()}), (CNPConfig(), FiLMConfig())):
        torch.set_num_threads(threads)
        asking_rates(training, build(config, Normaliser.fit(training)).eval())
    torch.set_num_threads(1)
    if long:
        time_to_error(training, TrainingArrays.from_dataset(data, split.validation))
        keep("training", KEPT["training"])
    keep("asking", KEPT["asking"])

    return 0


if __name__ == "__main__":
    sys.exit(main())
