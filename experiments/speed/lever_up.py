"""Lever-ups: what training and prediction cost, of the conditional and the recurrent networks.

All in one run, on one thread, on the same 256 lever-ups. Training: seconds for as many windows as
there are training trajectories (one epoch of the older study), and for the whole training as it is
done here (the older study's: 100 epochs). Prediction: a window's five next steps, and all 25 from
the image alone, of one object and of 64 at once. Ratios are to ours.
"""

import time

import torch

from affordlib.interactions import Normaliser, open_interactions
from affordlib.interactions.lever import AHEAD, SEEN, draw_windows, lever_arrays
from affordlib.models import build
from affordlib.models.lever import LEVER_MODELS, foresee
from affordlib.models.training import batch_loss
from experiments.lstm_published import BATCH, EPOCHS, PublishedConfig, PublishedLSTM
from experiments.speed.keeping import keep

N = 256
EPOCH = 1440
REPEATS = 5


def seconds(do, repeats=REPEATS):
    """The least of a few runs, after one to warm up."""
    do()
    times = []
    for _ in range(repeats):
        began = time.perf_counter()
        do()
        times.append(time.perf_counter() - began)
    return min(times)


def training_step(model, arrays, optimiser):
    """One step of the training loop, and how many windows it sees."""
    generator = torch.Generator().manual_seed(0)

    def published():
        rows = torch.randint(0, N, (BATCH,), generator=generator)
        start = torch.randint(0, 11, (BATCH,), generator=generator)
        return model.next_step_loss(arrays.select(rows), start, SEEN)

    def ours():
        rows = torch.randint(0, N, (64,), generator=generator)
        return batch_loss(model, draw_windows(arrays, rows, AHEAD, SEEN, generator), 0.5)

    make = published if isinstance(model, PublishedLSTM) else ours

    def step():
        optimiser.zero_grad()
        make().backward()
        optimiser.step()

    return step, BATCH if make is published else 64


def main():
    torch.set_num_threads(1)
    data = open_interactions("lever_up").isel(interaction=slice(0, N + 8))
    models = {name: (lever.view, lever) for name, lever in LEVER_MODELS.items()}
    models["lstm_published"] = ("full", None)
    rows = {}
    for name, (view, lever) in models.items():
        arrays = lever_arrays(data, view=view).select(torch.arange(N))
        normaliser = Normaliser.fit(arrays)
        channels = arrays.action_channels, arrays.effect_channels
        model = build(lever.network, normaliser) if lever else None
        model = model or PublishedLSTM(PublishedConfig(*channels), normaliser)
        optimiser = torch.optim.Adam(model.parameters(), 1e-4, fused=True)
        step, n = training_step(model.train(), arrays, optimiser)
        a_step = seconds(step, 2 if lever is None else REPEATS)
        model.eval()
        row = {"epoch s": a_step * EPOCH / n}
        row["training s"] = a_step * lever.training.steps if lever else row["epoch s"] * EPOCHS
        for count in (1, 64):
            few = arrays.select(torch.arange(count))
            for protocol in ("window", "image_only"):
                taken = seconds(lambda few=few, p=protocol, m=model: foresee(m, few, p))
                row[f"{protocol} {count} ms"] = 1000 * taken
        rows[name] = row
    columns = list(rows["anchored"])
    print(f"{'model':16}" + "".join(f"{c:>20}" for c in columns) + "   (ratio to ours)")
    for name, row in rows.items():
        cells = (f"{row[c]:9.2f} ({row[c] / rows['anchored'][c]:7.2f})" for c in columns)
        print(f"{name:16}" + "".join(f"{cell:>20}" for cell in cells))
    kept = {name: {c.replace(" ", "_"): v for c, v in row.items()} for name, row in rows.items()}
    keep("lever_up", [{"model": name} | row for name, row in kept.items()])


if __name__ == "__main__":
    main()
