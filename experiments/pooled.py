"""What units wrote, read back and put together: folds of one model, errors with their classes."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from affordlib.paths import resolve_out_dir
from affordlib.world.objects import CATEGORIES
from experiments.parts import parts_in
from experiments.units import MODELS, PARTS, TEN_TIMES, Unit, read_part

Part = dict[str, Any]


def read_parts(folder: str | Path = PARTS) -> list[tuple[Unit, Part]]:
    """All parts with their units, in the order of models, folds and seeds; stale ones raise."""
    folder = resolve_out_dir(folder)
    units = [Unit(**part["unit"]) for part in parts_in(folder).values()]
    units.sort(key=lambda u: (u.data, MODELS.index(u.model), str(u.n), u.seed, u.fold))
    parts = [(unit, read_part(unit, folder)) for unit in units]
    kept = [(unit, part) for unit, part in parts if part is not None]
    seen: dict[tuple, Unit] = {}
    for unit, part in kept:
        task = unit.data.removesuffix(TEN_TIMES)
        key = (unit.model, task, part["n"], unit.fold, unit.seed)
        if (other := seen.setdefault(key, unit)) != unit:
            raise ValueError(
                f"parts {other.file} and {unit.file} would be one row of the table; delete one"
            )
    return kept


def by_model(parts: Iterable[tuple[Unit, Part]], data: str) -> Iterable[tuple[dict, list[Part]]]:
    """The parts of a set, grouped, with the columns that say which they are."""
    groups: dict[tuple[str, int], list[tuple[Unit, Part]]] = defaultdict(list)
    for unit, part in parts:
        if unit.data.removesuffix(TEN_TIMES) == data:
            groups[unit.model, part["n"]].append((unit, part))
    for (model, n), group in groups.items():
        folds, seeds = ({getattr(u, name) for u, _ in group} for name in ("fold", "seed"))
        about = {"model": model, "n_interactions": n, "folds": len(folds), "seeds": len(seeds)}
        yield about, [part for _, part in group]


def data_of(parts: Iterable[tuple[Unit, Part]]) -> dict[str, list[str]]:
    """Hashes of the sets by name; parts of one set must be of the same data.

    Collected again, by another processor or with younger records beside the same, a set has another
    hash. Its parts go with the others if of all their test interactions the ends are the same, to
    1 µm or µrad; else ValueError names one.
    """
    files: dict[str, dict[str, str]] = defaultdict(dict)
    ends: dict[tuple[str, str], dict[tuple[int, str], float]] = defaultdict(dict)
    for unit, part in parts:
        for name, sha256 in part["data_sha256"].items():
            files[name].setdefault(sha256, unit.file)
            if name != unit.data or "fold_test" not in part:
                continue
            test = part["fold_test"]
            for channel, values in test["truth"].items():
                numbered = zip(test["interaction"], values, strict=True)
                ends[name, sha256] |= {(number, channel): end for number, end in numbered}
    for name, by_hash in files.items():
        first = max(by_hash, key=lambda sha256: len(ends[name, sha256]))
        known = ends[name, first]
        for sha256 in by_hash.keys() - {first}:
            told, file = ends[name, sha256], by_hash[sha256]
            alike = [abs(end - known.get(key, math.inf)) <= 1e-6 for key, end in told.items()]
            if not alike or not all(alike):
                raise ValueError(f"part {file} is of another {name!r} than others are")
    return {name: list(by_hash) for name, by_hash in sorted(files.items())}


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


def pool(answers: list[dict[str, Any]], key: str | Callable) -> Errors:
    """The errors of several folds in one; key: their name in the answers, or how to get them.

    A part names an object's category by its number in `CATEGORIES`.
    """
    known = list(CATEGORIES)
    values, objects, classes = [], [], []
    for told in answers:
        found = key(told) if callable(key) else told[key]
        values += list(found)
        objects += list(told.get("interaction", range(len(found))))
        classes += [known[k] for k in told["family"]]
    return Errors(values, objects, classes)
