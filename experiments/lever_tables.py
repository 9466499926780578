"""`data/results/lever_up.json` from the parts that `lever_up.py` wrote (Table 1 of the paper).

    python -m experiments.lever_tables

An object's errors are meaned over its windows; means, standard errors and intervals are over
objects. A part whose hash is not its unit's is refused.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Iterable, Sequence
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from affordlib.commands import command
from affordlib.interactions.lever_up import POSE_CHANNELS
from affordlib.models.lever import PROTOCOLS
from affordlib.paths import resolve_out_dir
from affordlib.results import write_results
from experiments import reported
from experiments.lever_up import (
    BASELINES,
    MODELS,
    NAME,
    PARTS,
    RECURRENT,
    SINGLE,
    LeverUnit,
    hashes,
    numbered_edges,
)
from experiments.parts import checked_part, parts_in
from experiments.studies import read_study

OURS = "anchored"
RESTS_M = 0.005
"""A window in which the object moves by less, from the last observed step to the last foreseen."""


def read_parts(folder: str | Path = PARTS) -> list[tuple[LeverUnit, dict[str, Any]]]:
    """All parts with their units, in the order of models and folds; stale ones raise."""
    folder = resolve_out_dir(folder)
    units = [LeverUnit(**part["unit"]) for part in parts_in(folder).values()]
    units.sort(key=lambda u: (MODELS.index(u.model), u.trained_for, u.no_edges or 0, u.fold))
    seen: dict[tuple, str] = {}
    for unit in units:
        other = seen.setdefault(
            (unit.model, unit.trained_for, unit.fold, unit.no_edges, unit.seed), unit.file
        )
        if other != unit.file:
            raise ValueError(
                f"{other} and {unit.file} are of one fold, trained for other numbers of epochs; "
                "delete one of them"
            )
    return [(unit, checked_part(unit, folder, hashes(unit))) for unit in units]


Group = list[tuple[LeverUnit, dict[str, Any]]]


def _groups(
    parts: Group, no_edges: int | None = None
) -> Iterable[tuple[dict[str, Any], str, Group]]:
    """The parts of a model and protocol, and the columns that say which they are."""
    for protocol, model in product(PROTOCOLS, MODELS):
        group = [
            (unit, part)
            for unit, part in parts
            if unit.model == model and protocol in unit.protocols and unit.no_edges == no_edges
        ]
        if group:
            epochs = [u.epochs for u, _ in group if u.epochs]
            about = {"model": model, "protocol": protocol}
            about["folds"] = len({unit.fold for unit, _ in group})
            yield about | {"epochs": min(epochs) if epochs else None}, protocol, group


def _pooled(group: Group, protocol: str) -> np.ndarray:
    """Errors (N, W, T) [cm] of all folds together."""
    return np.concatenate([part["tests"][protocol]["error_cm"] for _, part in group])


def _told(errors_cm: np.ndarray) -> dict[str, float]:
    """Mean, standard error, median, 95th percentile of errors (N,) [cm], one an object."""
    sem = errors_cm.std(ddof=1) / math.sqrt(len(errors_cm)) if len(errors_cm) > 1 else 0.0
    return {
        "n": len(errors_cm),
        "mean_cm": float(errors_cm.mean()),
        "sem_cm": float(sem),
        "median_cm": float(np.median(errors_cm)),
        "p95_cm": float(np.quantile(errors_cm, 0.95)),
    }


def error_rows(parts: Group, no_edges: int | None = None) -> list[dict[str, Any]]:
    """Table 1: an object's errors are meaned over its windows.

    no_edges: of the trainings that left out polygons of so many edges, on those.
    """
    rows = []
    for about, protocol, group in _groups(parts, no_edges):
        errors = _pooled(group, protocol).mean(axis=1)
        rows += [about | {"steps": k + 1} | _told(errors[:, k]) for k in range(errors.shape[1])]
    return rows


def unseen_rows(parts: Group, edges: dict[int, int]) -> list[dict[str, Any]]:
    """Polygons of a number of edges that a network has never seen, beside networks that have.

    edges: of each interaction, by its number. The second are those of the folds, on the polygons of
    that kind which they are tested on (*known*).
    """
    rows = []
    for left_out in sorted({u.no_edges for u, _ in parts if u.no_edges is not None}):
        known = {}
        for about, protocol, group in _groups(parts):
            alike = [edges[i] == left_out for _, part in group for i in part["interaction"]]
            errors = _pooled(group, protocol).mean(axis=1)[alike]
            known |= {
                (about["model"], protocol, k + 1): {
                    "known_n": len(errors),
                    "known_mean_cm": float(errors[:, k].mean()),
                }
                for k in range(errors.shape[1])
            }
        for row in error_rows(parts, left_out):
            key = row["model"], row["protocol"], row["steps"]
            rows.append({"edges": left_out} | row | known.get(key, {}))
    return rows


def motion_rows(parts: Group) -> list[dict[str, Any]]:
    """Windows in which the object moves on and those in which it rests, apart.

    How far it moves is by how much persistence errs at the last step.
    """
    moved = {
        unit.fold: np.array(part["tests"]["window"]["error_cm"])[..., -1]
        for unit, part in parts
        if unit.model == BASELINES[0] and unit.no_edges is None
    }
    rows = []
    for about, protocol, group in _groups(parts):
        if protocol != "window":
            continue
        errors = _pooled(group, protocol)
        moves = np.concatenate([moved[unit.fold] for unit, _ in group])
        for kind, which in (("moving", moves >= 100 * RESTS_M), ("resting", moves < 100 * RESTS_M)):
            chosen = errors[which]
            for k in range(chosen.shape[1] if len(chosen) else 0):
                told = {"n_windows": len(chosen), "mean_cm": float(chosen[:, k].mean())}
                rows.append(about | {"windows": kind, "steps": k + 1} | told)
    return rows


def paired_rows(parts: Group, draws: int = 2000) -> list[dict[str, Any]]:
    """Ours minus each of the recurrent ones, object by object, with bootstrapped 95 % intervals.

    Ours as it is, and trained for one protocol at a time.

    Objects of the folds that both were trained on; of the windows of an object, the mean.
    """
    rng, rows = np.random.default_rng(0), []
    for ours, rival, protocol in product((OURS, SINGLE), RECURRENT, PROTOCOLS):
        found = {
            model: {
                (unit.fold, number): np.mean(error, axis=0)
                for unit, part in parts
                if unit.model == model and protocol in unit.protocols and unit.no_edges is None
                for number, error in zip(
                    part["interaction"], part["tests"][protocol]["error_cm"], strict=True
                )
            }
            for model in (ours, rival)
        }
        both = sorted(found[ours].keys() & found[rival].keys())
        if not both:
            continue
        gap = np.array([found[ours][key] - found[rival][key] for key in both])
        means = gap[rng.integers(0, len(gap), (draws, len(gap)))].mean(axis=1)
        low, high = np.quantile(means, [0.025, 0.975], axis=0)
        every = 1 if protocol == "window" else 5
        for k in range(every - 1, gap.shape[1], every):
            row = {"ours": ours, "rival": rival, "protocol": protocol}
            row |= {"steps": k + 1, "n": len(gap)}
            row |= {"difference_cm": float(gap[:, k].mean()), "low_cm": float(low[k])}
            row |= {
                "high_cm": float(high[k]),
                "ours_better_percent": float(100 * (gap[:, k] < 0).mean()),
            }
            rows.append(row)
    return rows


def coverage_rows(parts: Group) -> list[dict[str, Any]]:
    """How often the truth lies in the central 50 and 90 % intervals, by channel."""
    rows = []
    for about, protocol, group in _groups(parts):
        told = [part["tests"][protocol]["coverage"] for _, part in group]
        if about["model"] == "lstm_published" or None in told:
            continue
        for channel in POSE_CHANNELS:
            half, most = np.mean([t[channel] for t in told], axis=0)
            row = {"channel": channel, "coverage_50": float(half), "coverage_90": float(most)}
            rows.append(about | row)
    return rows


def step_rows(parts: Group) -> list[dict[str, Any]]:
    """How far the object moves in each step of 150 ms."""
    group = [(u, p) for u, p in parts if u.model == BASELINES[0] and u.no_edges is None]
    moves = np.concatenate([part["step_moves_cm"] for _, part in group])
    return [
        {"step": k + 1, "mean_cm": float(move.mean()), "p95_cm": float(np.quantile(move, 0.95))}
        for k, move in enumerate(moves.T)
    ]


def summary_rows(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """The windows in one row per model, as the paper's Table 1 has them."""
    summary: dict[str, dict[str, Any]] = {}
    for row in rows:
        if row["protocol"] == "window":
            names = ("model", "folds", "epochs", "n")
            told = summary.setdefault(row["model"], {name: row[name] for name in names})
            told[f"step_{row['steps']}_mean_cm"] = row["mean_cm"]
    return list(summary.values())


def assemble(folder: str | Path = PARTS, out_dir: str | Path = "data/results") -> Path:
    """Write `lever_up.json` from all parts of a folder; returns its path."""
    parts = read_parts(folder)
    if not any(unit.model == BASELINES[0] for unit, _ in parts):
        raise FileNotFoundError(f"folder: no part of the baselines in {folder}; run them first")
    rows = error_rows(parts)
    tables = {
        "lever_up": rows,
        "summary": [*reported.lever_up_rows(), *summary_rows(rows)],
        "motion": motion_rows(parts),
        "unseen_edges": unseen_rows(parts, numbered_edges()),
        "paired": paired_rows(parts),
        "coverage": coverage_rows(parts),
        "steps": step_rows(parts),
        "training": [
            {
                "model": u.model,
                "trained_for": u.trained_for,
                "fold": u.fold,
                "edges_left_out": u.no_edges,
            }
            | {k: part["training"].get(k) for k in ("steps", "epochs", "seconds", "checkpoint")}
            for u, part in parts
            if "training" in part
        ],
        "tuning": read_study("lever_tuning") or [],
    }
    parameters = {"units": len(parts), "step_ms": 150, "data_sha256": parts[0][1]["data_sha256"]}
    return write_results(out_dir, NAME, parameters, tables)


@command(OSError, ValueError)
def main(argv: Sequence[str] | None = None) -> int:
    """Make the tables of lever-ups from the parts that units wrote."""
    parser = argparse.ArgumentParser(
        prog="python -m experiments.lever_tables", description=main.__doc__
    )
    parser.add_argument("--parts", default=PARTS)
    parser.add_argument("--out", default="data/results")
    options = parser.parse_args(argv)
    print(assemble(options.parts, options.out))
    return 0


if __name__ == "__main__":
    sys.exit(main())
