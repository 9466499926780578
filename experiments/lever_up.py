"""Lever-ups against the recurrent network, in units that can be interrupted (Table 1).

Five folds, 80/10/10, by object (each interaction has an object of its own, so the random split of
the older study is the same); or all objects of some number of edges left out of training. A unit
is one training, or one baseline, tested in every protocol that it is trained for; its part holds
the errors of every test trajectory. Errors are distances between foreseen and true positions, in
cm, after steps of 150 ms. `lever_tables.py` makes the tables.

    python -m experiments.lever_up --models anchored,anchored_single,lstm_tuned,paper
    python -m experiments.lever_up --models lstm_published --folds 3

The last takes an hour of one core for each of its two trainings a fold. glibc gives its large
arrays back after every step; with `MALLOC_MMAP_MAX_=0 MALLOC_TRIM_THRESHOLD_=60000000000` before
the command, a quarter less.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import torch
import xarray as xr
from torch import Tensor

from affordlib.commands import command, count_type, names_type, whole_type
from affordlib.interactions import InteractionTensors, Scaler, Split, split_interactions
from affordlib.interactions.dataset import valid_interactions
from affordlib.interactions.lever_up import (
    N_OBSERVED,
    N_PREDICTED,
    POSE_CHANNELS,
    lever_up_tensors,
    n_windows,
)
from affordlib.interactions.recipes import Recipe, sample_scene
from affordlib.interactions.store import stored_sha256
from affordlib.models.calibration import LEVELS, coverage
from affordlib.models.lever import (
    LEVER_MODELS,
    PROTOCOLS,
    TRAINED_FOR,
    LeverModel,
    errors_m,
    foresee,
    train_lever_model,
)
from affordlib.models.network import EffectNetwork
from affordlib.results import write_text_atomically
from affordlib.types import Prediction
from experiments.lstm_published import (
    EPOCHS,
    PublishedConfig,
    PublishedLSTM,
    train_published,
)
from experiments.parts import (
    checked_part,
    open_once,
    options_of,
    run_parts,
    sha256_of,
)
from experiments.shipped import shipped_lever_model

FORMAT = 1
"""Counts the changes of code that change a unit's numbers without changing its configuration."""

NAME = "lever_up"
DATA = "lever_up"
PARTS = "data/results/parts/lever_up"
N_FOLDS = 5
BASELINES = ("persistence", "constant_velocity")
RECURRENT = ("lstm_tuned", "lstm_published")
SINGLE = "anchored_single"
"""Ours, trained for one protocol at a time, as the recurrent ones are."""

MODELS = ("paper", "anchored", SINGLE, "lstm_published", "lstm_tuned", *BASELINES)
EDGES = range(3, 9)


@dataclass(frozen=True)
class LeverUnit:
    """One training and its tests; no_edges: polygons of so many edges are only in the test."""

    model: str
    trained_for: str = "all"
    fold: int = 0
    no_edges: int | None = None
    seed: int = 0
    epochs: int | None = None

    def __post_init__(self) -> None:
        for name, known in (("model", MODELS), ("trained_for", TRAINED_FOR)):
            if getattr(self, name) not in known:
                raise ValueError(f"{name} must be one of {known}, got {getattr(self, name)!r}")
        if self.fold not in range(N_FOLDS):
            raise ValueError(f"fold must lie in [0, {N_FOLDS - 1}], got {self.fold!r}")
        if self.no_edges is not None and self.no_edges not in EDGES:
            raise ValueError(f"no_edges must lie in [3, 8], got {self.no_edges!r}")
        if (self.trained_for == "all") == (self.model in (SINGLE, *RECURRENT)):
            raise ValueError(
                f"trained_for: {(SINGLE, *RECURRENT)} are trained for one protocol each, the "
                f"others for all; got {self.trained_for!r} for {self.model!r}"
            )
        if (self.epochs is not None) != (self.model == "lstm_published"):
            raise ValueError(f"epochs belong to 'lstm_published', got {self.epochs!r}")

    @property
    def file(self) -> str:
        """The name of its part."""
        split = f"fold{self.fold}" if self.no_edges is None else f"no{self.no_edges}edges"
        epochs = f"-{self.epochs}epochs" if self.epochs else ""
        return f"{self.model}-{self.trained_for}-{split}-seed{self.seed}{epochs}.json"

    @property
    def protocols(self) -> tuple[str, ...]:
        """Those that it is tested in."""
        kinds = {"all": PROTOCOLS, "window": PROTOCOLS[:1], "first_step": PROTOCOLS[1:]}
        return kinds[self.trained_for]


def hashes(unit: LeverUnit) -> dict[str, Any]:
    """What a part must hold to be this unit's: hashes of its configuration and its data."""
    told: dict[str, Any] = {"format": FORMAT, "unit": asdict(unit)}
    if lever := _lever(unit):
        told |= {"network": type(lever.network).__name__, "view": lever.view}
        for name in ("network", "training"):
            told |= {f"{name}_{k}": v for k, v in options_of(getattr(lever, name)).items()}
    return {"configuration_sha256": sha256_of(told), "data_sha256": {DATA: stored_sha256(DATA)}}


def _lever(unit: LeverUnit) -> LeverModel | None:
    return LEVER_MODELS.get("anchored" if unit.model == SINGLE else unit.model)


def edges_of(data: xr.Dataset) -> np.ndarray:
    """How many edges the polygon of each interaction has (n,)."""
    recipe = Recipe.from_json(data.attrs["recipe"])
    numbers = data["interaction"].values
    return np.array([len(sample_scene(recipe, int(i))[0].footprint_m) for i in numbers])


def numbered_edges() -> dict[int, int]:
    """The same by the number of the interaction, of the shipped set."""
    data = open_once(DATA)
    return dict(zip(data["interaction"].values.tolist(), edges_of(data).tolist(), strict=True))


def split_of(unit: LeverUnit, data: xr.Dataset) -> Split:
    """80/10/10 in five folds whose test parts do not overlap, or all but some edges."""
    split = split_interactions(data.sizes["interaction"], unit.seed, 2 * unit.fold, 2 * N_FOLDS)
    if unit.no_edges is None:
        return split
    edges = edges_of(data)
    others = np.concatenate([split.train, split.test])
    return Split(
        np.sort(others[edges[others] != unit.no_edges]),
        split.validation[edges[split.validation] != unit.no_edges],
        np.flatnonzero(edges == unit.no_edges),
    )


def run_unit(unit: LeverUnit, folder: Path, progress: bool = False) -> bool:
    """Train and ask one unit, and write its part; whether that had to be done.

    Broken off while it trains, it goes on from its last validation. A stale part is replaced.
    """
    try:
        if checked_part(unit, folder, hashes(unit)) is not None:
            return False
    except ValueError:
        pass  # of an earlier configuration or data: made again
    data = open_once(DATA)
    split = split_of(unit, data)
    part: dict[str, Any] = {"unit": asdict(unit)} | hashes(unit)
    halfway = folder / f".{unit.file}.{sha256_of(hashes(unit))[:8]}.pt"
    test = lever_up_tensors(data, split.test, _view(unit))
    told: dict[str, list[tuple[Prediction, Tensor]]]
    if unit.model in BASELINES:
        told = {protocol: _guesses(unit.model, test, protocol) for protocol in unit.protocols}
    else:
        model, part["training"] = _fit(unit, data, split, halfway, progress)
        told = {protocol: _foreseen(model, test, protocol) for protocol in unit.protocols}
    part["interaction"] = data["interaction"].values[valid_interactions(data, split.test)].tolist()
    part["tests"] = {protocol: _answers(found) for protocol, found in told.items()}
    if unit.model == BASELINES[0]:
        part["step_moves_cm"] = (100 * test.effect[..., :3].diff(dim=1).norm(dim=-1)).tolist()
    text = json.dumps(_shortened(part), allow_nan=False, separators=(",", ":"))
    write_text_atomically(folder / unit.file, text + "\n")
    halfway.unlink(missing_ok=True)
    return True


def _shortened(value: Any) -> Any:
    """The same, with four decimals of every float: of a centimetre, a micrometre."""
    if isinstance(value, dict):
        return {k: _shortened(v) for k, v in value.items()}
    if isinstance(value, list):
        return [_shortened(v) for v in value]
    return round(value, 4) if isinstance(value, float) else value


def _view(unit: LeverUnit) -> str:
    known = _lever(unit)
    return known.view if known else "full" if unit.model == "lstm_published" else "near"


def _fit(
    unit: LeverUnit, data: xr.Dataset, split: Split, halfway: Path, progress: bool
) -> tuple[EffectNetwork, dict[str, Any]]:
    if lever := _lever(unit):
        lever = replace(lever, training=replace(lever.training, seed=unit.seed))
        if found := shipped_lever_model(unit.model, unit.trained_for, lever, data, split):
            return found
        model, history = train_lever_model(lever, data, split, unit.trained_for, progress, halfway)
        best = min(record.validation_error for record in history)
        seconds = history[-1].seconds
        return model, {"steps": history[-1].step, "seconds": seconds, "validation_error": best}
    training, validation = (
        lever_up_tensors(data, part, "full") for part in (split.train, split.validation)
    )
    channels = {f"{k}_channels": getattr(training, f"{k}_channels") for k in ("action", "effect")}
    torch.manual_seed(unit.seed)
    published = PublishedLSTM(PublishedConfig(**channels), Scaler.fit(training))
    epochs = unit.epochs or EPOCHS
    return published, train_published(
        published, training, validation, unit.trained_for, epochs, unit.seed, checkpoint=halfway
    )


def _starts(arrays: InteractionTensors, protocol: str) -> range:
    return range(n_windows(arrays) if protocol == "window" else 1)


def _foreseen(
    model: EffectNetwork, arrays: InteractionTensors, protocol: str
) -> list[tuple[Prediction, Tensor]]:
    with torch.no_grad():
        features = model.encode(arrays.image)
    return [foresee(model, arrays, protocol, k, features) for k in _starts(arrays, protocol)]


def guess(baseline: str, effect: Tensor, protocol: str, start: int = 0) -> tuple[Tensor, Tensor]:
    """What persistence or constant velocity foresees of poses (N, S, C), and the truth (N, T, C).

    From the first step alone the velocity is not known; then both say that nothing moves.
    """
    window = protocol == "window"
    last = start + N_OBSERVED - 1 if window else 0
    n = N_PREDICTED if window else effect.shape[1] - 1
    ahead = torch.arange(1, n + 1)
    velocity = torch.zeros_like(effect[:, last])
    if window and baseline == "constant_velocity":
        velocity = effect[:, last] - effect[:, last - 1]
    mean = effect[:, last, None] + ahead[:, None] * velocity[:, None]
    return mean, effect[:, last + ahead]


def _guesses(
    baseline: str, arrays: InteractionTensors, protocol: str
) -> list[tuple[Prediction, Tensor]]:
    found = []
    for start in _starts(arrays, protocol):
        mean, truth = guess(baseline, arrays.effect, protocol, start)
        nothing = torch.zeros_like(mean)
        found.append((Prediction(nothing, nothing, mean, nothing), truth))
    return found


def _answers(found: list[tuple[Prediction, Tensor]]) -> dict[str, Any]:
    """Errors (N, W, T) [cm] of a protocol's windows, and how often σ covers the truth."""
    errors = torch.stack([100 * errors_m(told, truth) for told, truth in found], dim=1)
    mean, std, truth = (
        torch.cat(parts).flatten(0, 1)
        for parts in zip(*((p.effect_mean, p.effect_std, e) for p, e in found), strict=True)
    )
    covered = None
    if std.min() > 0:
        covered = {
            channel: [coverage(truth[:, k], mean[:, k], std[:, k], level) for level in LEVELS]
            for k, channel in enumerate(POSE_CHANNELS)
        }
    return {"error_cm": errors.tolist(), "coverage": covered}


@command(OSError, ValueError)
def main(argv: Sequence[str] | None = None) -> int:
    """Train and test models in folds; finished parts are kept, interrupted ones go on."""
    parser = argparse.ArgumentParser(
        prog="python -m experiments.lever_up", description=main.__doc__
    )
    parser.add_argument("--models", type=names_type(MODELS), default="anchored,lstm_tuned")
    parser.add_argument("--folds", type=whole_type(1, N_FOLDS), default=N_FOLDS, help="of the five")
    parser.add_argument(
        "--no-edges", type=whole_type(3, 8), help="leave polygons of so many edges out instead"
    )
    parser.add_argument(
        "--protocols",
        type=names_type(TRAINED_FOR),
        default="window,first_step",
        help="to train for, one at a time, what is not trained for all",
    )
    parser.add_argument("--epochs", type=count_type, default=EPOCHS, help="of the published LSTM")
    parser.add_argument("--out", default=PARTS)
    options = parser.parse_args(argv)
    units = []
    folds = range(options.folds) if options.no_edges is None else [0]
    for fold, model in product(folds, [*BASELINES, *options.models]):
        epochs = options.epochs if model == "lstm_published" else None
        kinds = options.protocols if model in (SINGLE, *RECURRENT) else ["all"]
        units += [LeverUnit(model, k, fold, options.no_edges, epochs=epochs) for k in kinds]
    ran = run_parts(units, run_unit, options.out)
    print(f"{ran} of {len(units)} units run, the others were there; {options.out}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
