"""`data/results/lever_up.json`: lever-ups against recurrent networks (Table 1 of the paper).

    python -m experiments.lever_up --models cnp_last_pose,cnp_last_pose_single,lstm_tuned,cnp
    python -m experiments.lever_up --models lstm_seker2019 --folds 3

run the jobs that are missing, then make the tables from all results; without options only these.
The second takes an hour of one core for each of its two trainings a fold. glibc returns its large
arrays after every step; with `MALLOC_MMAP_MAX_=0 MALLOC_TRIM_THRESHOLD_=60000000000` before the
command, a quarter less.

An object's errors are averaged over its windows; means, standard errors and intervals are over
objects.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from affordlib.commands import command, count_type, names_type, whole_type
from affordlib.evaluation.metrics import error_row
from affordlib.models.lever_up import PROTOCOLS, TRAINED_FOR
from affordlib.results import write_results
from experiments import reported, runner, studies
from experiments.lever_cross_validation import (
    BASELINES,
    DATA,
    MODELS,
    N_FOLDS,
    RECURRENT,
    SINGLE,
    edges_of,
    job,
)
from experiments.lstm_seker2019 import EPOCHS
from experiments.runner import FOLDER, Result, Rows, open_once, read

NAME = "lever_up"
OURS = "cnp_last_pose"


def sorted_results(folder: str | Path = FOLDER) -> list[Result]:
    """All results in the order of models and folds."""

    def order(result: Result) -> list[Any]:
        about = {name: value or 0 for name, value in result[0].items()}
        names = ("trained_for", "edges_left_out", "fold", "epochs", "seed")
        return [MODELS.index(about["model"]), *(about[name] for name in names)]

    return sorted(read(NAME, job, folder), key=order)


def _groups(
    results: list[Result], edges_left_out: int | None = None
) -> Iterator[tuple[dict[str, Any], list[Result], np.ndarray]]:
    """Columns, results and errors (N, W, T) [cm] of each protocol, model and length of training."""
    for protocol, model in product(PROTOCOLS, MODELS):
        wanted = {"model": model, "edges_left_out": edges_left_out}
        mine = [r for r in results if wanted.items() <= r[0].items() and protocol in r[1]]
        for epochs in sorted({about["epochs"] for about, _ in mine}, key=str):
            same = [r for r in mine if r[0]["epochs"] == epochs]
            columns = {"model": model, "protocol": protocol}
            columns |= {"folds": len({about["fold"] for about, _ in same}), "epochs": epochs}
            yield columns, same, np.concatenate([r[protocol]["error_cm"] for _, r in same])


def error_rows(results: list[Result], edges_left_out: int | None = None) -> Rows:
    """Table 1: an object's errors are averaged over its windows.

    edges_left_out: of the trainings without polygons with so many edges, on those.
    """
    rows = []
    for about, _, errors in _groups(results, edges_left_out):
        for k, error in enumerate(errors.mean(axis=1).T):
            # Copied, as the last digit of a sum depends on how it lies in memory.
            row = error_row(error.copy(), **about, steps=k + 1)
            rows.append({name.replace("_m", "_cm"): value for name, value in row.items()})
    return rows


def unseen_rows(results: list[Result], edges: dict[int, int]) -> Rows:
    """Polygons with a number of edges that a network has never seen, beside networks that have.

    edges: of each interaction, by its number. The second are those of the folds, on the polygons of
    that kind in their tests (*known*).
    """
    rows = []
    for left_out in sorted({a["edges_left_out"] for a, _ in results} - {None}):
        known = {}
        for about, group, errors in _groups(results):
            alike = [edges[i] == left_out for _, result in group for i in result["interaction"]]
            some = errors.mean(axis=1)[alike]
            for k in range(some.shape[1]):
                columns = {"known_n": len(some), "known_mean_cm": float(some[:, k].mean())}
                known[about["model"], about["protocol"], k + 1] = columns
        for row in error_rows(results, left_out):
            same = known.get((row["model"], row["protocol"], row["steps"]), {})
            rows.append({"edges": left_out} | row | same)
    return rows


def paired_rows(results: list[Result], n_draws: int = 2000) -> Rows:
    """Ours minus each of the recurrent ones, object by object, with bootstrapped 95 % intervals.

    Ours as it is, and trained for one protocol at a time; objects of the folds that both were
    trained on, the windows of an object averaged.
    """
    rng, rows, found = np.random.default_rng(0), [], {}
    for about, group, errors in _groups(results):
        objects = [(of["fold"], i) for of, result in group for i in result["interaction"]]
        means = dict(zip(objects, (error.mean(axis=0) for error in errors), strict=True))
        found.setdefault((about["model"], about["protocol"]), {}).update(means)
    for ours, rival, protocol in product((OURS, SINGLE), RECURRENT, PROTOCOLS):
        one, other = (found.get((model, protocol), {}) for model in (ours, rival))
        if not (both := sorted(one.keys() & other.keys())):
            continue
        gap = np.array([one[key] - other[key] for key in both])
        means = gap[rng.integers(0, len(gap), (n_draws, len(gap)))].mean(axis=1)
        low, high = np.quantile(means, [0.025, 0.975], axis=0)
        stride = 1 if protocol == "window" else 5
        for k in range(stride - 1, gap.shape[1], stride):
            row = {"ours": ours, "rival": rival, "protocol": protocol, "steps": k + 1}
            row |= {"n": len(gap), "difference_cm": float(gap[:, k].mean())}
            row |= {"low_cm": float(low[k]), "high_cm": float(high[k])}
            rows.append(row | {"ours_better_percent": float(100 * (gap[:, k] < 0).mean())})
    return rows


def summary_rows(rows: Rows) -> Rows:
    """The windows in one row per model, as the paper's Table 1 has them."""
    summary: dict[tuple, dict[str, Any]] = {}
    for row in rows:
        if row["protocol"] == "window":
            columns = {name: row[name] for name in ("model", "folds", "epochs", "n")}
            one = summary.setdefault((row["model"], row["epochs"]), columns)
            one[f"step_{row['steps']}_mean_cm"] = row["mean_cm"]
    return list(summary.values())


def write_tables(folder: str | Path = FOLDER, out_dir: str | Path = "data/results") -> Path:
    """Write `lever_up.json` from the results of a folder and the study of tuning."""
    results = sorted_results(folder)
    if not any(about["model"] == "persistence" for about, _ in results):
        raise FileNotFoundError(f"folder: no results of the baselines in {folder}; run them first")
    data, rows = open_once(DATA), error_rows(results)
    edges = dict(zip(data["interaction"].values.tolist(), edges_of(data).tolist(), strict=True))
    tables = {
        "lever_up": rows,
        "summary": [*reported.LEVER_UP_ROWS, *summary_rows(rows)],
        "unseen_edges": unseen_rows(results, edges),
        "paired": paired_rows(results),
    } | studies.tables(NAME, folder)
    return write_results(out_dir, NAME, {"jobs": len(results), "step_ms": 150}, tables)


@command(OSError, ValueError)
def main(argv: Sequence[str] | None = None) -> int:
    """Train and test models in folds, and make the tables; what is there is not made again."""
    parser = runner.parser(NAME, main.__doc__)
    parser.add_argument("--models", type=names_type(MODELS), default=[], help=",".join(MODELS))
    parser.add_argument("--folds", type=whole_type(1, N_FOLDS), default=N_FOLDS, help="of the five")
    edges = "leave polygons with so many edges out instead"
    parser.add_argument("--no-edges", type=whole_type(3, 8), help=edges)
    kinds = "to train for, one at a time, what is not trained for all"
    known, usual = names_type(TRAINED_FOR), "window,first_step"
    parser.add_argument("--protocols", type=known, default=usual, help=kinds)
    parser.add_argument("--epochs", type=count_type, default=EPOCHS, help="of lstm_seker2019")
    options = parser.parse_args(argv)
    jobs = []
    folds = range(options.folds) if options.no_edges is None else [0]
    models = dict.fromkeys([*BASELINES, *options.models] if options.models else [])
    for fold, model in product(folds, models):
        epochs = options.epochs if model == "lstm_seker2019" else None
        kinds = options.protocols if model in (SINGLE, *RECURRENT) else ["all"]
        jobs += [job(model, kind, fold, options.no_edges, epochs=epochs) for kind in kinds]
    return runner.make(jobs, NAME, options, write_tables)


if __name__ == "__main__":
    sys.exit(main())
