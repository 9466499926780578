"""Lever-ups against recurrent networks (Table 1 of the paper): makes `data/results/lever_up.json`.

    python -m experiments.lever_up --only model=lstm_seker2019

runs these jobs if they are missing, then makes the tables from all results. Each of the two
trainings per fold takes an hour on one core. glibc releases large arrays after every step;
`MALLOC_MMAP_MAX_=0 MALLOC_TRIM_THRESHOLD_=60000000000` before the command saves a quarter of it.

An object's errors are averaged over its windows; means, standard errors and intervals are over
objects.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from affordlib.models.lever_up import PROTOCOLS
from experiments import lever_tuning, reported, runner
from experiments.commands import command
from experiments.lever_cross_validation import (
    DATA,
    EACH,
    MODELS,
    N_FOLDS,
    RECURRENT,
    SINGLE,
    TESTED,
    edges_of,
    job,
)
from experiments.lstm_seker2019 import EPOCHS
from experiments.runner import FOLDER, Job, Result, Rows, interval, open_once, plain, read

NAME = "lever_up"
OURS = "cnp_last_pose"


def sorted_results(folder: str | Path = FOLDER) -> list[Result]:
    """Return all results in the order of models and folds."""

    def order(result: Result) -> list[Any]:
        about = {name: value or 0 for name, value in result[0].items()}
        names = ("trained_for", "edges_left_out", "fold", "epochs", "seed")
        return [MODELS.index(about["model"]), *(about[name] for name in names)]

    return sorted(read(NAME, job, folder), key=order)


def _errors(results: list[Result], edges_left_out: int | None = None) -> pd.DataFrame:
    """Return a row per tested object and step with the error [cm], averaged over windows."""
    parts = []
    for about, result in results:
        for protocol in PROTOCOLS if about["edges_left_out"] == edges_left_out else ():
            if protocol in result:
                means = pd.DataFrame(np.mean(result[protocol]["error_cm"], axis=1))
                means.columns += 1
                means = means.assign(interaction=result["interaction"], protocol=protocol, **about)
                names = [*about, "protocol", "interaction"]
                parts.append(means.melt(names, var_name="steps", value_name="error_cm"))
    table = pd.concat(parts)
    for name, order in (("protocol", PROTOCOLS), ("model", MODELS)):
        table[name] = pd.Categorical(table[name], order)
    return table


def error_rows(results: list[Result], edges_left_out: int | None = None) -> Rows:
    """Return the rows of Table 1; an object's errors are averaged over its windows.

    edges_left_out: use trainings without polygons that have this number of edges, tested on them.
    """
    if not results:
        return []
    keys, error = ["protocol", "model", "epochs", "steps"], "error_cm"
    groups = _errors(results, edges_left_out).groupby(keys, observed=True, dropna=False)
    rows = groups.agg(
        folds=("fold", "nunique"),
        n=(error, "size"),
        mean_cm=(error, "mean"),
        sem_cm=(error, "sem"),
        median_cm=(error, "median"),
        p95_cm=(error, lambda each: each.quantile(0.95)),
    )
    return plain(rows.reset_index())


def unseen_rows(results: list[Result], edges: dict[int, int]) -> Rows:
    """Return errors on polygons with a number of edges left out of training, and those if known.

    edges: number of edges by interaction number. The columns `known_…` are the errors of the
    networks of the folds on test polygons with the same number of edges.
    """
    known = _errors(results)
    keys = [known["interaction"].map(edges).rename("edges"), "model", "protocol", "steps"]
    known = known.groupby(keys, observed=True)["error_cm"].agg(known_n="size", known_mean_cm="mean")
    left_out = sorted({about["edges_left_out"] for about, _ in results} - {None})
    rows = [pd.DataFrame(error_rows(results, number)).assign(edges=number) for number in left_out]
    return plain(pd.concat(rows).join(known, on=known.index.names))


def paired_rows(results: list[Result]) -> Rows:
    """Return paired differences, ours minus a recurrent network, with bootstrap 95 % intervals.

    Ours is trained for all protocols, or for one at a time. Pairs are test objects of folds that
    both networks have, with errors averaged over windows.
    """
    rng, rows = np.random.default_rng(0), []
    errors = {
        key: of_one.pivot(index=["fold", "interaction"], columns="steps", values="error_cm")
        for key, of_one in _errors(results).groupby(["model", "protocol"], observed=True)
    }
    for ours, rival, protocol in product((OURS, SINGLE), RECURRENT, PROTOCOLS):
        if not {(ours, protocol), (rival, protocol)} <= errors.keys():
            continue
        gap = (errors[ours, protocol] - errors[rival, protocol]).dropna()
        mean, low, high = interval(gap, 2000, rng)
        table = pd.DataFrame({"difference_cm": mean, "low_cm": low, "high_cm": high}, gap.columns)
        table["ours_better_percent"] = 100 * (gap < 0).mean()
        table.insert(0, "n", len(gap))
        about = {"ours": ours, "rival": rival, "protocol": protocol}
        stride = 1 if protocol == "window" else 5
        rows += [about | row for row in plain(table[stride - 1 :: stride].reset_index())]
    return rows


def summary_rows(rows: Rows) -> Rows:
    """Return one row per model for the window protocol, as in the paper's Table 1."""
    summary: dict[tuple, dict[str, Any]] = {}
    for row in rows:
        if row["protocol"] == "window":
            columns = {name: row[name] for name in ("model", "folds", "epochs", "n")}
            one = summary.setdefault((row["model"], row["epochs"]), columns)
            one[f"step_{row['steps']}_mean_cm"] = row["mean_cm"]
    return list(summary.values())


def tables(folder: str | Path = FOLDER) -> dict[str, Rows]:
    """Return all tables from the results in a folder and the tuning study."""
    results = sorted_results(folder)
    if not results:
        raise FileNotFoundError(f"folder: there are no results in {folder}; run some jobs first")
    data, rows = open_once(DATA), error_rows(results)
    edges = dict(zip(data["interaction"].values.tolist(), edges_of(data).tolist(), strict=True))
    return {
        "lever_up": rows,
        "summary": [*reported.LEVER_UP_ROWS, *summary_rows(rows)],
        "unseen_edges": unseen_rows(results, edges),
        "paired": paired_rows(results),
        "tuning": lever_tuning.rows(folder),
    }


def _jobs(model: str, fold: int, edges: int | None = None, **more: int) -> list[Job]:
    kinds = [*TESTED][1:] if model in EACH else ["all"]
    return [job(model, kind, fold, edges, **more) for kind in kinds]


ALL = [model for model in MODELS if model not in ("lstm_seker2019", "cnp_mean")]
JOBS = [
    *(each for model, fold in product(ALL, range(N_FOLDS)) for each in _jobs(model, fold)),
    *(each for fold in range(3) for each in _jobs("lstm_seker2019", fold, epochs=EPOCHS)),
    *(
        each
        for model, edges in product((OURS, "lstm_tuned", "cnp"), (3, 5, 8))
        for each in _jobs(model, 0, edges)
    ),
]


@command(OSError, ValueError)
def main(argv: Sequence[str] | None = None) -> int:
    """Train and test models in folds and make the tables; only missing results are computed."""
    return runner.make(JOBS, NAME, runner.parser(NAME, main.__doc__).parse_args(argv), tables)


if __name__ == "__main__":
    sys.exit(main())
