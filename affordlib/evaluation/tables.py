"""`data/results/effect_prediction.json` from the parts that units wrote (Table 2 of the paper).

    python -m affordlib.evaluation.tables

Means and standard errors are over objects; `all` is the mean over object classes with equal
weights, its median and 95th percentile are of all objects together. Of a grasp, by the paper's
rule, success is μ_z(1) > 0.1 m; TP is the share of the true successes that are foreseen, TN that of
the true failures, with Wilson's 95 % intervals, folds pooled. A part whose hash is not its unit's
is refused; the sets of ten times the size need not be here, if their parts agree.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from affordlib.evaluation import reported
from affordlib.evaluation.answers import calibration, final_error, yaw_error
from affordlib.evaluation.studies import FOLDER as STUDIES_FOLDER
from affordlib.evaluation.studies import STUDIES, read_study
from affordlib.evaluation.units import MODELS, NETWORKS, PARTS, TEN_TIMES, Unit, read_part
from affordlib.paths import resolve_out_dir
from affordlib.primitives import Grasp
from affordlib.results import write_results

NAME = "effect_prediction"
KNOWS = {
    "constant": "direction of the action, where it has one",
    "nearest": "true size, yaw and family, direction of the action",
    "gaussian_process": "true size, yaw and family, direction of the action",
    "logistic": "true size",
}
PLANE = ("push", "drag")

Part = dict[str, Any]


def wilson(k: int, n: int, z: float = 1.959964) -> tuple[float, float]:
    """Wilson's 95 % interval of a share of which k of n were seen (JASA 22, 1927)."""
    if not 0 <= k <= n or n < 1:
        raise ValueError(f"k of n must be 0 ≤ k ≤ n, n ≥ 1, got {k} of {n}")
    centre = (k + z * z / 2) / (n + z * z)
    half = z / (n + z * z) * math.sqrt(k * (n - k) / n + z * z / 4)
    return max(0.0, centre - half), min(1.0, centre + half)


def auc(score: np.ndarray, truth: np.ndarray, fold: np.ndarray) -> float | None:
    """The share of (success, failure) pairs that the score puts in order; None without pairs.

    Pairs are of one fold each: models of different folds are not on one scale.
    """
    pairs = truth[:, None] & ~truth & (fold[:, None] == fold)
    if not pairs.any():
        return None
    order = (score[:, None] > score) + (score[:, None] == score) / 2
    return float(order[pairs].mean())


def read_parts(folder: str | Path = PARTS) -> list[tuple[Unit, Part]]:
    """All parts with their units, in the order of models, folds and seeds; stale ones raise."""
    folder = resolve_out_dir(folder)
    units = [Unit(**json.loads(path.read_text())["unit"]) for path in folder.glob("*.json")]
    units.sort(key=lambda u: (u.data, MODELS.index(u.model), str(u.n), u.seed, u.fold))
    parts = [(unit, read_part(unit, folder)) for unit in units]
    kept = [(unit, part) for unit, part in parts if part is not None]
    seen: dict[tuple, Unit] = {}
    for unit, part in kept:
        key = (unit.model, unit.data, part["n"], unit.fold, unit.seed)
        if (other := seen.setdefault(key, unit)) != unit:
            raise ValueError(f"parts {other.file} and {unit.file} are the same; delete one")
    return kept


def _by_model(parts: Iterable[tuple[Unit, Part]], data: str) -> Iterable[tuple[dict, list[Part]]]:
    """The parts of a set, grouped, with the columns that say which they are."""
    groups: dict[tuple[str, int], list[tuple[Unit, Part]]] = defaultdict(list)
    for unit, part in parts:
        if unit.data.removesuffix(TEN_TIMES) == data:
            groups[unit.model, part["n"]].append((unit, part))
    for (model, n), group in groups.items():
        folds, seeds = ({getattr(u, name) for u, _ in group} for name in ("fold", "seed"))
        about = {"model": model, "n_interactions": n, "folds": len(folds), "seeds": len(seeds)}
        yield about, [part for _, part in group]


class Errors:
    """Errors of interactions, each with its object and the object's class."""

    def __init__(self, values: Sequence[float], objects: Sequence[int], classes: Sequence[str]):
        self.values, self.objects = np.asarray(values, float), np.asarray(objects)
        self.classes = np.asarray(classes)

    def mean_sem(self, object_class: str) -> tuple[float, float]:
        """Mean and standard error over objects; of `all` over classes with equal weights."""
        if object_class == "all":
            each = [self.mean_sem(name) for name in sorted(set(self.classes))]
            means, sems = np.array(each).T
            return float(means.mean()), float(np.sqrt((sems**2).sum()) / len(sems))
        chosen = self.classes == object_class
        objects = self.objects[chosen]
        mine = np.array([self.values[chosen][objects == o].mean() for o in sorted({*objects})])
        sem = mine.std(ddof=1) / math.sqrt(len(mine)) if len(mine) > 1 else 0.0
        return float(mine.mean()), float(sem)

    def of(self, object_class: str) -> np.ndarray:
        return self.values if object_class == "all" else self.values[self.classes == object_class]

    def count(self, object_class: str) -> int:
        chosen = (self.classes == object_class) | (object_class == "all")
        return len(set(self.objects[chosen]))

    def columns(self, name: str, unit: str, object_class: str) -> dict[str, float]:
        mean, sem = self.mean_sem(object_class)
        told = self.of(object_class)
        return {
            f"{name}_mean_{unit}": mean,
            f"{name}_sem_{unit}": sem,
            f"{name}_median_{unit}": float(np.median(told)),
            f"{name}_p95_{unit}": float(np.quantile(told, 0.95)),
        }


def _pool(answers: list[dict[str, Any]], key: str | Callable) -> Errors:
    values, objects, classes = [], [], []
    for told in answers:
        found = key(told) if callable(key) else told[key]
        values += list(found)
        objects += list(told.get("interaction", range(len(found))))
        classes += told["family"]
    return Errors(values, objects, classes)


def error_rows(parts: list[tuple[Unit, Part]], data: str, test: str) -> list[dict[str, Any]]:
    """Rows of final, trajectory and yaw errors; test: "fold_test" or "fixed_test"."""

    def final(told: dict) -> Any:
        return told["final_error"] if "final_error" in told else final_error(told)

    def yaw(told: dict) -> Any:
        return told["yaw_error"] if "yaw_error" in told else yaw_error(told)

    unit = "m" if data in PLANE else "rad"
    first = "final_error" if data in PLANE else "error"
    rows = []
    for about, group in _by_model(parts, data):
        told = [part[test] for part in group if test in part]
        if not told:
            continue
        pooled = {first: _pool(told, final)}
        pooled |= {name: _pool(told, name) for name in ("trajectory_error", "after_contact_error")}
        turned = _pool(told, yaw) if data == "push" and yaw(told[0]) is not None else None
        for name in ("all", *sorted(set(pooled[first].classes))):
            row = about | {"object_class": name, "n": pooled[first].count(name)}
            row |= pooled[first].columns(first, unit, name)
            for key in ("trajectory_error", "after_contact_error"):
                row[f"{key}_mean_{unit}"] = pooled[key].mean_sem(name)[0]
            if data == "push":
                box = name == "cuboid" and turned is not None
                row["yaw_error_mean_rad"] = turned.mean_sem(name)[0] if box else None
                row["yaw_error_median_rad"] = float(np.median(turned.of(name))) if box else None
            rows.append(row)
    return rows


def grasp_rows(parts: list[tuple[Unit, Part]]) -> list[dict[str, Any]]:
    """The paper's Table 2: what can roll and what cannot, apart."""
    rows = []
    for about, group in _by_model(parts, "grasp"):
        told = [part["fold_test"] for part in group]
        height = np.concatenate([t["truth"]["z"] for t in told])
        rolls = np.concatenate([t["rollable"] for t in told])
        score = np.concatenate([success_probability(t) for t in told])
        fold = np.repeat(np.arange(len(told)), [len(t["rollable"]) for t in told])
        error = None
        if "mean" in told[0]:
            error = np.concatenate([final_error(t) for t in told])
        for rollable in (False, True):
            chosen = rolls == rollable
            truth = height[chosen] > Grasp.success_m
            counts = confusion_columns(score[chosen] > 0.5, truth)
            row = about | {"rollable": rollable, "n": int(chosen.sum())}
            row["error_mean_m"] = None if error is None else float(error[chosen].mean())
            row["error_median_m"] = None if error is None else float(np.median(error[chosen]))
            order = auc(score[chosen], truth, fold[chosen])
            brier = float(np.square(score[chosen] - truth).mean())
            rows.append(row | counts | {"auc": order, "brier": brier})
    return rows


def success_probability(answers: dict[str, Any]) -> np.ndarray:
    """P(z > 0.1 m) (N,); above one half exactly where a Gaussian's mean is above 0.1 m."""
    if "probability" in answers:
        return np.array(answers["probability"])
    mean, std = np.array(answers["mean"]["z"]), np.array(answers["std"]["z"])
    standard = (mean - Grasp.success_m) / (std * math.sqrt(2))
    return np.array([(1 + math.erf(v)) / 2 for v in standard])


def confusion_columns(foreseen: np.ndarray, truth: np.ndarray) -> dict[str, Any]:
    """TP and FN in per cent of the true successes, TN and FP of the true failures; intervals."""
    columns: dict[str, Any] = {}
    for right, wrong, those in (("tp", "fn", truth), ("tn", "fp", ~truth)):
        n, k = int(those.sum()), int((foreseen == truth)[those].sum())
        low, high = wilson(k, n) if n else (None, None)
        columns |= {
            f"{right}_percent": 100 * k / n if n else None,
            f"{right}_low_percent": None if low is None else 100 * low,
            f"{right}_high_percent": None if high is None else 100 * high,
            f"{wrong}_percent": 100 * (n - k) / n if n else None,
        }
    return columns | {"n_success": int(truth.sum()), "n_failure": int((~truth).sum())}


def inverse_rows(parts: list[tuple[Unit, Part]]) -> list[dict[str, Any]]:
    """Pushes decoded from wanted effects and carried out."""
    rows = []
    for about, group in _by_model(parts, "push"):
        group = [part for part in group if "inverse" in part]
        if not group:
            continue
        told = [part["inverse"] for part in group]
        error, theta, yaw = (_pool(told, f"{name}_error") for name in ("final", "theta", "yaw"))
        for name in ("all", *sorted(set(error.classes))):
            row = about | {"object_class": name, "n": error.count(name)}
            row |= error.columns("final_error", "m", name)
            row["theta_error_mean_rad"] = theta.mean_sem(name)[0]
            box = name == "cuboid"
            row["yaw_error_mean_rad"] = yaw.mean_sem(name)[0] if box else None
            rows.append(row)
    return rows


def calibration_table(parts: list[tuple[Unit, Part]]) -> list[dict[str, Any]]:
    """Coverage and likelihood at t = 1 by channel: folds together, and on the fixed test set."""
    rows = []
    for data in ("push", "drag", "grasp", "rotate"):
        for about, group in _by_model(parts, data):
            told = [part["fold_test"] for part in group]
            if "std" not in told[0]:
                continue
            about = {"data": data, **about}
            together = {
                kind: {c: [v for t in told for v in t[kind][c]] for c in told[0]["std"]}
                for kind in ("truth", "mean", "std")
            }
            rows += [about | {"test": "folds"} | row for row in calibration(together)]
            fixed = [part["fixed_test"]["calibration"] for part in group if "fixed_test" in part]
            for channel in zip(*fixed, strict=True):
                mean = {
                    key: float(np.mean([row[key] for row in channel]))
                    for key in ("coverage_50", "coverage_90", "std_mean", "nll")
                }
                first = {key: channel[0][key] for key in ("channel", "n")}
                rows.append(about | {"test": "push_test"} | first | mean)
    return rows


def baseline_rows(tables: dict[str, list[dict[str, Any]]]) -> list[dict[str, Any]]:
    """What each baseline knows and how it does, beside the networks, all classes together."""
    rows = []
    for data in ("push", "drag", "rotate"):
        key = "final_error_mean_m" if data in PLANE else "error_mean_rad"
        for row in tables[data]:
            if row["object_class"] == "all":
                about = {"data": data, "model": row["model"], "folds": row["folds"], "n": row["n"]}
                about["knows"] = KNOWS.get(row["model"], "image, action at t = 0 and t = 1")
                about["error_mean_m"] = row[key] if data in PLANE else None
                about["error_mean_rad"] = None if data in PLANE else row[key]
                rows.append(about)
    return rows


def assemble(
    folder: str | Path = PARTS,
    out_dir: str | Path = "data/results",
    studies: str | Path = STUDIES_FOLDER,
) -> Path:
    """Write `effect_prediction.json` from all parts and studies of two folders; returns its path.

    A study that was not made has no table; one of other data or settings raises ValueError.
    """
    parts = read_parts(folder)
    if not parts:
        raise FileNotFoundError(f"folder: there are no parts in {folder}; run units first")
    grasps = grasp_rows(parts)
    tables = {
        "push": error_rows(parts, "push", "fold_test"),
        "push_test": error_rows(parts, "push", "fixed_test"),
        "drag": error_rows(parts, "drag", "fold_test"),
        "grasp": [*reported.grasp_rows(grasps[0]), *grasps] if grasps else [],
        "rotate": error_rows(parts, "rotate", "fold_test"),
        "inverse": inverse_rows(parts),
        "calibration": calibration_table(parts),
    }
    tables["baselines"] = baseline_rows(tables)
    tables["frames"] = frame_rows(parts)
    made = {name: read_study(name, studies) for name in STUDIES if STUDIES[name].of == NAME}
    tables |= {name: rows for name, rows in made.items() if rows is not None}
    trained = sum(unit.model in NETWORKS for unit, _ in parts)
    parameters = {"units": len(parts), "trained": trained, "data_sha256": _data(parts)}
    return write_results(out_dir, NAME, parameters, tables)


FRAMES = {
    "paper": ("paper", "table"),
    "paper_push_frame": ("paper", "push"),
    "film_table_frame": ("film", "table"),
    "film": ("film", "push"),
}


def frame_rows(parts: list[tuple[Unit, Part]]) -> list[dict[str, Any]]:
    """Two networks in two frames, from the same folds of the same pushes, on the fixed test set."""
    both = [(u, p) for u, p in parts if u.model in FRAMES and u.data == "push" and u.n == "all"]
    folds = [{(u.fold, u.seed) for u, _ in both if u.model == model} for model in FRAMES]
    shared = set.intersection(*folds)
    rows = error_rows([(u, p) for u, p in both if (u.fold, u.seed) in shared], "push", "fixed_test")
    told = []
    for row in rows:
        network, frame = FRAMES[row["model"]]
        told.append({"network": network, "frame": frame} | row)
    return told


def _data(parts: list[tuple[Unit, Part]]) -> dict[str, str]:
    """Hashes of the sets by name; parts of one set must be of the same data."""
    found: dict[str, str] = {}
    for unit, part in parts:
        for name, sha256 in part["data_sha256"].items():
            if found.setdefault(name, sha256) != sha256:
                raise ValueError(f"part {unit.file} is of another {name!r} than others are")
    return dict(sorted(found.items()))


def main(argv: Sequence[str] | None = None) -> int:
    """Make the tables of effect prediction from the parts that units wrote."""
    parser = argparse.ArgumentParser(
        prog="python -m affordlib.evaluation.tables", description=main.__doc__
    )
    parser.add_argument("--parts", default=PARTS)
    parser.add_argument("--out", default="data/results")
    parser.add_argument("--studies", default=STUDIES_FOLDER)
    options = parser.parse_args(argv)
    print(assemble(options.parts, options.out, options.studies))
    return 0


if __name__ == "__main__":
    sys.exit(main())
