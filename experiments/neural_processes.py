"""Comparison with the `neuralprocesses` package on its standard task: one-dimensional regression.

Curves are sampled from a Gaussian process (squared exponential, length scale 0.25 on a range of 2,
noise 0.05), observed at 1 to 10 points and queried at 50. The networks of a pair have about the
same number of parameters, and are trained with the same batches, steps and optimiser. They are
compared by log-likelihood per target on the same curves (mean ± standard error), together with the
Gaussian process itself, which is the upper bound.

The package is not a dependency and has to be installed first:
    .venv/bin/python -m pip install neuralprocesses==0.2.7
    .venv/bin/python -m experiments.neural_processes --steps 2000
"""

from __future__ import annotations

import argparse
import importlib.metadata
import importlib.util
import sys
from collections.abc import Callable, Sequence

import pandas as pd
import torch
from scipy.stats import sem

from affordlib.interactions import Scaler
from affordlib.models import CNPConfig, build
from affordlib.models.base import NetworkConfig, gaussian_nll
from affordlib.results import write_results
from affordlib.types import Observations
from experiments.attention import AttentionConfig
from experiments.commands import command, count_type

BATCH, MAX_OBSERVED, TARGETS, JUDGED = 16, 10, 50, 1600
LENGTH, NOISE, RANGE = 0.25, 0.05, 2.0
CHANNELS = {"action_channels": ("z",), "effect_channels": ("z",), "sigma_floor": 0.01}
NO_SCALES = Scaler((1.0,), (1.0,), (0.0, 0.0), (1.0, 1.0))

Likelihood = Callable[..., torch.Tensor]
"""Log-likelihood (n, TARGETS) of targets (t, y) given observed (t, y): four arguments (n, ·)."""


def covariances(t: torch.Tensor) -> torch.Tensor:
    """Return the covariances (n, m, m) of noisy values at phases t (n, m)."""
    distance = (t[:, :, None] - t[:, None]) * RANGE / LENGTH
    return (-distance.square() / 2).exp() + NOISE**2 * torch.eye(t.shape[1])


def curves(n: int, generator: torch.Generator) -> tuple[torch.Tensor, ...]:
    """Sample phases and values of context (n, k), k ≤ MAX_OBSERVED, and targets (n, TARGETS)."""
    t = torch.rand(n, MAX_OBSERVED + TARGETS, generator=generator, dtype=torch.float64)
    covariance = covariances(t)
    white = torch.randn(n, t.shape[1], 1, generator=generator, dtype=torch.float64)
    y = (torch.linalg.cholesky(covariance) @ white).squeeze(2)
    t, y = t.float(), y.float()
    count = int(torch.randint(1, MAX_OBSERVED + 1, (1,), generator=generator))
    return t[:, :count], y[:, :count], t[:, MAX_OBSERVED:], y[:, MAX_OBSERVED:]


def process_likelihood(t_seen, y_seen, t, y):
    """Return the log-likelihood under the Gaussian process itself."""
    k = t_seen.shape[1]
    covariance = covariances(torch.cat([t_seen, t], dim=1).double())
    across = covariance[:, :k, k:]
    weights = torch.linalg.solve(covariance[:, :k, :k], across)
    mean = (weights * y_seen[..., None]).sum(dim=1)
    variance = covariance[:, k:, k:].diagonal(dim1=1, dim2=2) - (weights * across).sum(dim=1)
    return -gaussian_nll(y, mean, variance.sqrt())


def ours(config: NetworkConfig) -> tuple[torch.nn.Module, Likelihood]:
    """Return our network as a regression of the effect y at phase t, with an empty image."""
    model = build(config, NO_SCALES)

    def likelihood(t_seen, y_seen, t, y):
        observed = Observations.of(model, effect=(t_seen, y_seen[..., None]))
        _, _, mean, std = model.outputs(model.features(torch.zeros(1, 2, 48, 48)), observed, t)
        return -gaussian_nll(y, mean[..., 0], std[..., 0]).reshape(len(t), -1)

    return model, likelihood


def theirs(attention: bool, **sizes: int) -> tuple[torch.nn.Module, Likelihood]:
    """Return the package's network with an independent Gaussian for each target."""
    import neuralprocesses.torch as nps

    make = nps.construct_agnp if attention else nps.construct_gnp
    model = make(dim_x=1, dim_y=1, likelihood="het", **sizes)

    def likelihood(t_seen, y_seen, t, y):
        x_seen, x = (2 * v[:, None] - 1 for v in (t_seen, t))
        predicted = model(x_seen, y_seen[:, None], x)
        return -gaussian_nll(y, predicted.mean[:, 0], predicted.var[:, 0].sqrt())

    likelihood(*curves(2, torch.Generator().manual_seed(0)))  # initialises lazy layers
    return model, likelihood


def train(model: torch.nn.Module, likelihood: Likelihood, steps: int, rate: float) -> None:
    """Train a network in place by maximum likelihood."""
    optimiser = torch.optim.AdamW(model.parameters(), rate, weight_decay=0.0, fused=True)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, steps)
    generator = torch.Generator().manual_seed(1)
    for _ in range(steps):
        optimiser.zero_grad()
        (-likelihood(*curves(BATCH, generator)).mean()).backward()
        torch.nn.utils.clip_grad_norm_(model.parameters(), 1.0)
        optimiser.step()
        schedule.step()


@torch.no_grad()
def _log_likelihood(likelihood: Likelihood) -> dict[str, float]:
    """Return log-likelihood per target of JUDGED curves, mean and standard error over curves."""
    generator = torch.Generator().manual_seed(2)
    each = [likelihood(*curves(BATCH, generator)).mean(dim=1) for _ in range(JUDGED // BATCH)]
    values = torch.cat(each).double().numpy()
    return {"log_likelihood_mean": float(values.mean()), "log_likelihood_sem": float(sem(values))}


@command(OSError, ValueError)
def main(argv: Sequence[str] | None = None) -> int:
    """Train and compare both types of networks; write `neural_processes.json`."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=count_type, default=3000)
    parser.add_argument("--rate", type=float, default=5e-4)
    parser.add_argument("--out", default="data/results")
    options = parser.parse_args(argv)
    if importlib.util.find_spec("neuralprocesses") is None:
        print("neuralprocesses is not installed; install it as the help (-h) says")
        return 1
    torch.set_num_threads(1)
    makers = {
        ("CNP", "ours"): lambda: ours(CNPConfig(**CHANNELS)),
        ("CNP", "theirs"): lambda: theirs(False, dim_embedding=256, width=512),
        ("attention", "ours"): lambda: ours(AttentionConfig(**CHANNELS, frame="table")),
        ("attention", "theirs"): lambda: theirs(True, dim_embedding=128, width=256),
    }
    rows = []
    for (network, whose), make in makers.items():
        torch.manual_seed(0)
        model, likelihood = make()
        size = sum(p.numel() for p in model.parameters())
        train(model, likelihood, options.steps, options.rate)
        row = {"network": network, "whose": whose, "parameters": size, "n": JUDGED}
        rows.append(row | _log_likelihood(likelihood))
    row = {"network": "the process itself", "whose": "known", "n": JUDGED}
    rows.append(row | _log_likelihood(process_likelihood))
    print(pd.DataFrame(rows).to_string(index=False))
    parameters = {"steps": options.steps, "rate": options.rate, "batch": BATCH}
    parameters["neuralprocesses"] = importlib.metadata.version("neuralprocesses")
    tables = {"log_likelihood": rows}
    print(write_results(options.out, "neural_processes", parameters, tables))
    return 0


if __name__ == "__main__":
    sys.exit(main())
