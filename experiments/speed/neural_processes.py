"""Our networks against the `neuralprocesses` package on its own ground: curves of one dimension.

Curves are drawn from a Gaussian process (squared exponential, length 0.25 of the range 2, noise
0.05), observed at 1 to 10 points and asked at 50. Each pair has about as many parameters, sees the
same batches of 16 for the same number of steps with the same optimiser, and is judged on the same
curves: log-likelihood per target (mean ± standard error), and targets a second of one core.
Beside them stands what knows the Gaussian process: the best that any network can do.

The package is no dependency; without it this says so and ends. It wants an environment of its own:
    .venv/bin/python -m pip install neuralprocesses==0.2.7
    .venv/bin/python -m experiments.speed.neural_processes --steps 2000 --keep
writes the numbers to `data/results/neural_processes.json` as well.
"""

import argparse
import importlib.metadata
import importlib.util
import math
import sys
import time

import numpy as np
import torch

from affordlib.commands import command, count_type
from affordlib.interactions import Normaliser
from affordlib.models import CNPConfig, build
from affordlib.models.network import gaussian_nll
from affordlib.results import write_results
from affordlib.types import Observations
from experiments.attention import AttentionConfig

BATCH, MOST, TARGETS = 16, 10, 50
JUDGED = 1600
LENGTH, NOISE, RANGE = 0.25, 0.05, 2.0
CHANNELS = {"action_channels": ("z",), "effect_channels": ("z",), "sigma_floor": 0.01}
NO_SCALES = Normaliser((1.0,), (1.0,), (0.0, 0.0), (1.0, 1.0))


def covariances(t):
    """Of the values at phases t (n, m), with noise: (n, m, m)."""
    distance = (t[:, :, None] - t[:, None]) * RANGE / LENGTH
    return (-distance.square() / 2).exp() + NOISE**2 * torch.eye(t.shape[1])


def curves(n, generator):
    """Phases and values: context (n, k) for some k up to MOST, and target (n, TARGETS)."""
    t = torch.rand(n, MOST + TARGETS, generator=generator, dtype=torch.float64)
    covariance = covariances(t)
    white = torch.randn(n, t.shape[1], 1, generator=generator, dtype=torch.float64)
    y = (torch.linalg.cholesky(covariance) @ white).squeeze(2)
    t, y = t.float(), y.float()
    count = int(torch.randint(1, MOST + 1, (1,), generator=generator))
    return t[:, :count], y[:, :count], t[:, MOST:], y[:, MOST:]


def knowing(t_seen, y_seen, t, y):
    """The log-likelihood of each target under the process itself, given the context."""
    k = t_seen.shape[1]
    covariance = covariances(torch.cat([t_seen, t], dim=1).double())
    across = covariance[:, :k, k:]
    weights = torch.linalg.solve(covariance[:, :k, :k], across)
    mean = (weights * y_seen[..., None]).sum(dim=1)
    variance = covariance[:, k:, k:].diagonal(dim1=1, dim2=2) - (weights * across).sum(dim=1)
    return -gaussian_nll(y, mean, variance.sqrt())


def ours(config):
    """Our network as a regression: y is the effect at phase t; no action, an empty image."""
    model = build(config, NO_SCALES)

    def likelihood(t_seen, y_seen, t, y):
        n, none = len(t), torch.zeros(len(t), 1)
        seen = torch.ones_like(t_seen, dtype=torch.bool)
        observed = Observations(
            none[..., None], none, none > 0, y_seen[..., None], t_seen, seen, none[:, 0]
        )
        _, _, mean, std = model.outputs(model.features(torch.zeros(1, 2, 48, 48)), observed, t)
        return -gaussian_nll(y, mean[..., 0], std[..., 0]).reshape(n, -1)

    return model, likelihood


def theirs(attention, **sizes):
    import neuralprocesses.torch as nps

    make = nps.construct_agnp if attention else nps.construct_gnp
    model = make(dim_x=1, dim_y=1, likelihood="het", **sizes)

    def likelihood(t_seen, y_seen, t, y):
        x_seen, x = (2 * v[:, None] - 1 for v in (t_seen, t))
        told = model(x_seen, y_seen[:, None], x)
        mean, variance = told.mean[:, 0], told.var[:, 0]
        return -gaussian_nll(y, mean, variance.sqrt())

    likelihood(*curves(2, torch.Generator().manual_seed(0)))  # its layers learn their sizes
    return model, likelihood


def trained(pair, steps, rate):
    """Train; returns the log-likelihood per target of each judged curve and targets a second."""
    model, likelihood = pair
    optimiser = torch.optim.AdamW(model.parameters(), rate, weight_decay=0.0, fused=True)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, steps)
    g = torch.Generator().manual_seed(1)
    busy = 0.0
    for _ in range(steps):
        batch = curves(BATCH, g)
        began = time.process_time()
        loss = -likelihood(*batch).mean()
        optimiser.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(model.parameters(), 1.0)
        optimiser.step()
        busy += time.process_time() - began
        schedule.step()
    return judged(likelihood), steps * BATCH * TARGETS / busy


@torch.no_grad()
def judged(likelihood):
    """The log-likelihood per target of each judged curve."""
    g = torch.Generator().manual_seed(2)
    told = [likelihood(*curves(BATCH, g)).mean(dim=1) for _ in range(JUDGED // BATCH)]
    return torch.cat(told).double().numpy()


def mean_sem(values):
    return float(np.mean(values)), float(np.std(values, ddof=1) / math.sqrt(len(values)))


@command(OSError, ValueError)
def main() -> int:
    """Train both kinds of networks side by side and print how well they predict."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=count_type, default=3000)
    parser.add_argument("--rate", type=float, default=5e-4)
    parser.add_argument("--keep", action="store_true", help="write neural_processes.json")
    options = parser.parse_args()
    if importlib.util.find_spec("neuralprocesses") is None:
        print("neuralprocesses is not installed; see the head of this file")
        return
    torch.set_num_threads(1)
    makers = {
        ("CNP", "ours"): lambda: ours(CNPConfig(**CHANNELS)),
        ("CNP", "theirs"): lambda: theirs(False, dim_embedding=256, width=512),
        ("attention", "ours"): lambda: ours(AttentionConfig(**CHANNELS, frame="table")),
        ("attention", "theirs"): lambda: theirs(True, dim_embedding=128, width=256),
    }
    told, rates, rows = {}, {}, []
    for (network, whose), make in makers.items():
        torch.manual_seed(0)
        pair = make()
        size = sum(p.numel() for p in pair[0].parameters())
        told[network, whose], rate = trained(pair, options.steps, options.rate)
        rates[network, whose] = rate
        mean, sem = mean_sem(told[network, whose])
        name = f"{network}, {whose}"
        print(
            f"{name:18} {size / 1e6:5.2f} M parameters   log-likelihood {mean:6.3f} "
            f"± {sem:.3f}   {rate:8.0f} targets a second",
            flush=True,
        )
        row = {"network": network, "whose": whose, "parameters": size, "n": JUDGED}
        row |= {"log_likelihood_mean": mean, "log_likelihood_sem": sem}
        rows.append(row | {"targets_per_second": rate})
    best, sem = mean_sem(judged(knowing))
    print(f"the process itself: log-likelihood {best:.3f} ± {sem:.3f}")
    rows.append(
        {"network": "the process itself", "whose": "known", "n": JUDGED}
        | {"log_likelihood_mean": best, "log_likelihood_sem": sem}
    )
    pairs = []
    for network in ("CNP", "attention"):
        mean, sem = mean_sem(told[network, "ours"] - told[network, "theirs"])
        ratio = rates[network, "ours"] / rates[network, "theirs"]
        print(
            f"{network}, ours - theirs: {mean:+.3f} ± {sem:.3f}; speed {ratio:.2f} : 1 (goal 1.5)"
        )
        pairs.append(
            {"network": network, "n": JUDGED, "speed_ratio": ratio}
            | {"log_likelihood_gain_mean": mean, "log_likelihood_gain_sem": sem}
        )
    if options.keep:
        parameters = {"steps": options.steps, "rate": options.rate, "batch": BATCH}
        parameters["neuralprocesses"] = importlib.metadata.version("neuralprocesses")
        tables = {"log_likelihood": rows, "difference": pairs}
        print(write_results("data/results", "neural_processes", parameters, tables))

    return 0


if __name__ == "__main__":
    sys.exit(main())
