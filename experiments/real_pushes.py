"""Real pushes of one object: who predicts them best, from how few, told what.

    python -m experiments.real_pushes --logs FOLDER

makes `data/results/real_pushes.json`. FOLDER holds the logs of seven conditions, as published (or
compressed by xz): github.com/robinzhoucmu/Pushing, icra_data_proc/SensorLogs (Apache License 2.0;
Zhou, Paolini, Bagnell and Mason, A convex polynomial force-motion model for planar sliding, ICRA
2016). Steps and rates were taken over from an earlier trial on the same logs, not chosen here.
"""

from __future__ import annotations

import argparse
import lzma
import math
from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.stats import norm

from affordlib.commands import command, names_type, whole_type
from affordlib.interactions.log import Log, PushLog
from affordlib.models.fit import EFFORT, MODELS, fit
from affordlib.models.neural_process import PRETRAINED
from affordlib.results import write_results
from experiments.runner import Job, frame, read, run

TABLE = "real_pushes"
SHOTS = (0, 5, 10)
CORNERS_MM = ((0, 0), (150, 0), (0, 150))
SUPPORTS_MM = {
    "3points1": ((30, 30), (63.33, 43.33), (43.33, 63.33)),
    "3points2": ((10, 10), (130, 10), (10, 130)),
    "3points3": ((30, 30), (90, 30), (30, 90)),
    "3points4": ((10, 10), (90, 30), (10, 130)),
    "patch": None,
}
CONDITIONS = (
    *(f"hardboard_{support}" for support in ("3points1", "3points2", "3points3", "patch")),
    *(f"plywood_{support}" for support in ("3points1", "3points3", "3points4")),
)


def feet_of(support: str) -> np.ndarray:
    """Feet (12, 3) from the centroid: x, y [m], share of the weight; a face by points all over."""
    feet = np.zeros((12, 3))
    if SUPPORTS_MM[support] is None:
        cells = [(i + 1 / 3, j + 1 / 3) for i in range(4) for j in range(4 - i)]
        cells = np.array([(0.5, 0.5), (3, 0.5), (0.5, 3), *cells[1:9], cells[0]])
        feet[:, :2], feet[:, 2] = cells / 4 * 150 - 50, 1 / 12
        feet[:, :2] -= feet[:, :2].mean(axis=0)
    else:
        points = np.array(SUPPORTS_MM[support]) - 50
        feet[:3, :2] = points
        feet[:3, 2] = np.linalg.solve(np.vstack([points.T, np.ones(3)]), (0, 0, 1))
    return feet * (1e-3, 1e-3, 1)


def read_condition(log: Log, path: Path, told: bool) -> None:
    """Add the pushes of one condition to a log; told: with where the object is supported."""
    packed = path.read_bytes()
    text = (lzma.decompress(packed) if path.suffix == ".xz" else packed).decode()
    values = iter([float(word) for word in text.split()])

    def take(*shape: int) -> np.ndarray:
        return np.array([next(values) for _ in range(math.prod(shape))]).reshape(shape)

    def pose(row: np.ndarray) -> tuple[float, float, float]:
        x, y, _, w, i, j, k = row
        return x, y, math.atan2(2 * (w * k + i * j), 1 - 2 * (j * j + k * k))

    group = path.name.split(".")[0]
    context = {"feet": feet_of(group.split("_")[1])} if told else {}
    for _ in range(int(take(1)[0])):
        start, end = pose(take(7)), pose(take(7))
        take(int(take(1)[0]), 3)  # forces
        tool = take(int(take(1)[0]), 8)
        log.add(start, tool[:, 0], tool[:, 1:3], end=end, context=context, group=group)


@lru_cache
def read_logs(folder: str | Path, told: bool = True) -> PushLog:
    """All pushes of the seven conditions."""
    log = Log(unit="mm", outline=CORNERS_MM, crop_width_m=0.24)
    for name in CONDITIONS:
        found = sorted(Path(folder).glob(f"{name}.txt*"))
        if not found:
            raise FileNotFoundError(f"there is no {name}.txt or {name}.txt.xz in {folder}")
        read_condition(log, found[0], told)
    return log.tensors()


def fold_of(data: PushLog, seed: int, folds: int = 5) -> np.ndarray:
    """The fold (n,) of each push, drawn within its condition."""
    rng, fold = np.random.default_rng(seed), np.zeros(len(data), dtype=int)
    for group in CONDITIONS:
        fold[data.groups == group] = rng.permutation((data.groups == group).sum()) % folds
    return fold


def untold(data: PushLog) -> PushLog:
    """The same pushes without what no camera sees."""
    return replace(data, context={})


def errors(model: object, data: PushLog, tested: np.ndarray, **columns: object) -> pd.DataFrame:
    """A row per push tested (n,)."""
    test = data.select(tested)
    mean, std = model.predict(test)
    off = np.abs(mean - np.column_stack([test.displacement_m, test.turn_rad]))
    inside = {f"inside_{p}": (off < norm.ppf(0.5 + p / 200) * std).mean(axis=1) for p in (50, 90)}
    yaw = {"push": np.flatnonzero(tested), "yaw_rad": off[:, 2]}
    return pd.DataFrame({"position_m": np.hypot(*off[:, :2].T)} | yaw | inside).assign(**columns)


def from_40(logs: str, model: str, seed: int, fold: int) -> dict[str, list]:
    """Of each condition, trained on its other folds alone."""
    data = untold(read_logs(logs))
    tested = fold_of(data, seed) == fold
    parts = []
    for group in CONDITIONS:
        of_group = data.groups == group
        fitted = fit(data.select(of_group & ~tested), model, seed)
        parts.append(errors(fitted, data, of_group & tested, told=False, shots=-1))
    return pd.concat(parts).to_dict("list")


def pooled(logs: str, model: str, seed: int, fold: int) -> dict[str, list]:
    """Trained on the other folds of all conditions, told the feet or not."""
    data = read_logs(logs)
    tested = fold_of(data, seed) == fold
    fitted = fit(data.select(~tested), model, seed)
    both = (errors(fitted, d, tested, told=bool(d.context), shots=-1) for d in (data, untold(data)))
    return pd.concat(both).to_dict("list")


def unseen(logs: str, model: str, seed: int, fold: int) -> dict[str, list]:
    """Of a condition of which nothing was trained on, after 0, 5 and 10 pushes of it as context."""
    data = read_logs(logs)
    of_group = data.groups == CONDITIONS[fold]
    order = np.random.default_rng(seed).permutation(np.flatnonzero(of_group))
    tested = np.isin(np.arange(len(data)), order[max(SHOTS) :])
    fitted = fit(data.select(~of_group), model, seed)
    parts = []
    for shots in SHOTS:
        given = fitted.given(data.select(order[:shots]))
        for d in (data, untold(data)):
            parts.append(errors(given, d, tested, told=bool(d.context), shots=shots))
    return pd.concat(parts).to_dict("list")


PROTOCOLS = {"from_40": (from_40, 5), "pooled": (pooled, 5), "unseen": (unseen, len(CONDITIONS))}


def measure(logs: str, protocol: str, model: str, seed: int, fold: int) -> dict[str, dict]:
    """The errors per push of one fold."""
    return {"errors": PROTOCOLS[protocol][0](logs, model, seed, fold)}


def job(protocol: str, model: str, seed: int, fold: int, logs: str = "") -> Job:
    """One fold of a protocol; where the logs lie decides nothing."""
    arguments = {"protocol": protocol, "model": model, "seed": seed, "fold": fold}
    checkpoints = (PRETRAINED,) if model == "np" else ()

    def measured(**what: object) -> dict[str, dict]:
        return measure(logs, **what)

    return Job(measured, arguments, settings=EFFORT, checkpoints=checkpoints)


def tables() -> dict[str, list[dict]]:
    """Mean errors and coverage by protocol and what was told; each push counts once."""
    every = frame(read(TABLE, job), "errors").drop(columns="fold")
    keys = ["protocol", "model", "told", "shots"]
    pushes = every.groupby([*keys, "push"]).mean(numeric_only=True).reset_index()
    pushes["condition"] = np.array(CONDITIONS)[pushes["push"] // 50]
    seeds = every.groupby("model")["seed"].nunique()
    found = {}
    for name, by in (("errors", keys), ("conditions", [*keys, "condition"])):
        found[name] = [
            dict(zip(by, key, strict=True))
            | {
                "n": len(part),
                "seeds": int(seeds[part["model"].iloc[0]]),
                "position_mean_m": part["position_m"].mean(),
                "position_sem_m": part["position_m"].sem(),
                "position_median_m": part["position_m"].median(),
                "yaw_mean_rad": part["yaw_rad"].mean(),
                "yaw_sem_rad": part["yaw_rad"].sem(),
            }
            | {f"coverage_{p}": part[f"inside_{p}"].mean() for p in (50, 90)}
            for key, part in pushes.groupby(by)
        ]
    return found


@command(OSError, ValueError)
def main(argv: Sequence[str] | None = None) -> int:
    """Run what is missing, and make the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--logs", help="folder of the published logs; without it, tables alone")
    parser.add_argument("--models", type=names_type(MODELS), default=["np"])
    parser.add_argument("--seeds", type=whole_type(1, 100), default=3)
    parser.add_argument("--protocols", type=names_type(PROTOCOLS), default=list(PROTOCOLS))
    options = parser.parse_args(argv)
    if options.logs:
        jobs = [
            job(protocol, model, seed, fold, options.logs)
            for seed in range(options.seeds)
            for model in options.models
            for protocol in options.protocols
            for fold in range(PROTOCOLS[protocol][1])
        ]
        run(jobs, TABLE)
    write_results("data/results", TABLE, {"conditions": list(CONDITIONS)}, tables())
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
