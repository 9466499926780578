"""Cross-validation in units that can be interrupted: (model, data set, size, fold, seed).

A unit trains one model on the training part of a fold, stops it early on the validation part, and
asks it about the test part: the image and the commanded action at t = 0 and t = 1, no effect. Its
answers are written, whole or not at all, to `data/results/parts/` with the hashes of its
configuration and of its data; a part that is there is not made again. `tables.py` makes the tables.

    python -m experiments.units --models film,paper --sets push --folds 3
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr

from affordlib.commands import command, count_type, names_type, whole_type
from affordlib.evaluation.baselines import BASELINES, baseline_predictions, logistic_predictions
from affordlib.evaluation.predictions import (
    network_predictions,
    stored,
    summary,
)
from affordlib.interactions import InteractionTensors, Scaler, Split, split_interactions
from affordlib.interactions.dataset import Symmetry, augment_by_symmetry, valid_interactions
from affordlib.interactions.store import stored_sha256
from affordlib.models.calibration import fit_temperature
from affordlib.models.checkpoint import load_checkpoint
from affordlib.models.cnp import CNPConfig
from affordlib.models.ensemble import Ensemble
from affordlib.models.film import FiLMConfig
from affordlib.models.network import EffectNetwork, NetworkConfig
from affordlib.models.training import TrainingConfig, about_training, train_model
from affordlib.paths import repo_root
from affordlib.results import write_text_atomically
from affordlib.workers import dask_client
from experiments.attention import AttentionConfig
from experiments.inverse import along_effect, executed_record, inverse_record
from experiments.parts import checked_part, open_once, options_of, run_parts, sha256_of
from experiments.shipped import (
    CHECKPOINT_SPECS,
    GRASP_SYMMETRIES,
    HALF_TURNS,
)

if TYPE_CHECKING:
    from dask.distributed import Client

FORMAT = 2
"""Counts the changes of code that change a unit's numbers without changing its configuration."""

N_FOLDS = 10
FEW_STEPS = 800
"""Of training on the sets of 100 interactions."""

PARTS = "data/results/parts/effect_prediction"
NETWORKS = ("paper", "film", "paper_push_frame", "film_table_frame", "attention", "ensemble")
MODELS = (*NETWORKS, *BASELINES, "logistic")


@dataclass(frozen=True)
class Task:
    """What is asked of a data set: channels, which of its objects' symmetries hold, a test set.

    best_effects: what all but the paper's network foresee, where that foresees less;
    also: a set that tests beside the folds; symmetries: (quarter turns, mirrored) under which the
    primitive stays itself, None where the training turns and mirrors by itself, as for pushes.
    """

    action_channels: tuple[str, ...]
    effect_channels: tuple[str, ...]
    symmetries: tuple[Symmetry, ...] | None = None
    also: str | None = None
    best_effects: tuple[str, ...] = ()

    @property
    def all_effects(self) -> tuple[str, ...]:
        return self.best_effects or self.effect_channels


TASKS: dict[str, Task] = {
    "push": Task(("x", "y"), ("x", "y"), also="push_test", best_effects=("x", "y", "yaw")),
    "drag": Task(("x", "y"), ("x", "y")),
    "grasp": Task(("z", "gripper"), ("z",), GRASP_SYMMETRIES),
    "rotate": Task(("yaw", "gripper"), ("yaw",), HALF_TURNS),
}

TEN_TIMES = "_x10"
KINDS: dict[str, tuple[str, type[NetworkConfig]]] = {
    "paper": ("cnp_500", CNPConfig),
    "film": ("film_500", FiLMConfig),
    "attention": ("attention_500", AttentionConfig),
    "ensemble": ("film_500", FiLMConfig),
}
"""By the first word of a model: the shipped checkpoint whose training it has, its network."""

MEMBERS = 5
"""Networks of an `ensemble`, the first of which is that of `film`."""

OF_SET = {s.data: name for name, s in CHECKPOINT_SPECS.items() if isinstance(s.network, FiLMConfig)}
"""The shipped FiLM networks by the sets they learn from."""

SETS = (*TASKS, *(f"{name}{TEN_TIMES}" for name in TASKS))


def task_of(data: str) -> Task:
    """What is asked of a set, or of the one that is ten times as large."""
    return TASKS[data.removesuffix(TEN_TIMES)]


@dataclass(frozen=True)
class Unit:
    """One training and one test; n counts the interactions of which ten folds are made."""

    model: str
    data: str
    n: int | str = "all"
    fold: int = 0
    seed: int = 0

    def __post_init__(self) -> None:
        for name, known in (("model", MODELS), ("data", SETS)):
            if getattr(self, name) not in known:
                raise ValueError(f"{name} must be one of {known}, got {getattr(self, name)!r}")
        if self.n != "all" and (not isinstance(self.n, int) or self.n < N_FOLDS):
            raise ValueError(f'n must be "all" or at least {N_FOLDS}, got {self.n!r}')
        if self.fold not in range(N_FOLDS):
            raise ValueError(f"fold must lie in [0, {N_FOLDS - 1}], got {self.fold!r}")
        if self.model == "logistic" and not self.data.startswith("grasp"):
            raise ValueError(f"model 'logistic' tells the success of grasps, not {self.data!r}")
        if task_of(self.data).symmetries is not None and self.model.endswith("_frame"):
            raise ValueError(f"data {self.data!r} has no direction, so model {self.model!r} no use")

    @property
    def file(self) -> str:
        """The name of its part."""
        return f"{self.data}-{self.model}-{self.n}-fold{self.fold}-seed{self.seed}.json"


def learner(unit: Unit) -> tuple[NetworkConfig, TrainingConfig] | None:
    """The network of a unit and its training; None for a baseline.

    Both are those of the shipped checkpoints, of FiLM of the one that learns from this very set, if
    there is one; the sets of 100 grasps and rotations get fewer steps.
    """
    if unit.model not in NETWORKS:
        return None
    task, kind = task_of(unit.data), unit.model.split("_", maxsplit=1)[0]
    name, config = KINDS[kind]
    shipped = CHECKPOINT_SPECS[name]
    if config is FiLMConfig and unit.n == "all":
        shipped = CHECKPOINT_SPECS.get(OF_SET.get(unit.data, ""), shipped)
    from_behind = unit.model in ("film", "attention", "ensemble", "paper_push_frame")
    network = config(
        action_channels=task.action_channels,
        effect_channels=task.effect_channels if kind == "paper" else task.all_effects,
        frame="push" if from_behind and task.symmetries is None else "table",
    )
    training = replace(shipped.training, seed=unit.seed)
    if task.symmetries is not None:
        few = not unit.data.endswith(TEN_TIMES)
        training = replace(training, augment=False, steps=FEW_STEPS if few else training.steps)
    return network, training


def configuration_sha256(unit: Unit) -> str:
    """Hash of all that decides a unit's numbers beside its data."""
    told: dict[str, Any] = {
        "format": FORMAT,
        "unit": asdict(unit),
        "task": asdict(task_of(unit.data)),
    }
    if configs := learner(unit):
        network, training = configs
        told |= {"network": type(network).__name__, **options_of(network)}
        told |= {f"training_{name}": value for name, value in options_of(training).items()}
    if unit.model == "ensemble":
        told |= {"members": MEMBERS}
    return sha256_of(told)


def data_sha256(unit: Unit) -> dict[str, str]:
    """Hashes of the sets that a unit reads; FileNotFoundError where one is not here."""
    names = [unit.data, task_of(unit.data).also]
    return {name: stored_sha256(name) for name in names if name}


def hashes(unit: Unit) -> dict[str, Any]:
    """What a part must hold to be this unit's."""
    return {"configuration_sha256": configuration_sha256(unit), "data_sha256": data_sha256(unit)}


def read_part(unit: Unit, folder: Path) -> dict[str, Any] | None:
    """A unit's part; None when there is none, ValueError when it is another configuration's.

    Of a set of ten times the size that is not here, which nobody ships, the data are not compared.
    """
    expected: dict[str, Any] = {"configuration_sha256": configuration_sha256(unit)}
    try:
        expected |= hashes(unit)
    except FileNotFoundError:
        if not unit.data.endswith(TEN_TIMES):
            raise
    return checked_part(unit, folder, expected)


def run_unit(unit: Unit, folder: Path, progress: bool = False) -> bool:
    """Train and ask one unit, and write its part; whether that had to be done.

    Broken off while it trains, it goes on from its last validation. A stale part is replaced.
    """
    try:
        if read_part(unit, folder) is not None:
            return False
    except ValueError:
        pass  # of an earlier configuration or data: made again
    data, task = open_once(unit.data), task_of(unit.data)
    n = data.sizes["interaction"] if unit.n == "all" else int(unit.n)
    if n > data.sizes["interaction"]:
        raise ValueError(f"n = {n}, but {unit.data!r} has {data.sizes['interaction']} interactions")
    split = split_interactions(n, unit.seed, unit.fold, N_FOLDS)
    tests = {"fold": (data, split.test)}
    if task.also:
        other = open_once(task.also)
        tests["fixed"] = (other, np.arange(other.sizes["interaction"]))
    part: dict[str, Any] = {"unit": asdict(unit), "n": n} | hashes(unit)
    configs = learner(unit)
    if configs is None:
        told = {name: _guess(unit, data, split.train, *test) for name, test in tests.items()}
        if unit.model == "constant" and task.also:
            kept = valid_interactions(data, split.test)
            part["inverse"] = executed_record(data, kept, along_effect(data, kept))
    else:
        halfway = folder / f".{unit.file}.{sha256_of(hashes(unit))[:8]}.pt"
        network, config = configs
        fit = partial(_fit, unit, network, data=data, split=split, progress=progress)
        if unit.model == "ensemble":
            channels = network.action_channels, network.effect_channels
            validation = InteractionTensors.from_dataset(data, split.validation, *channels)
            model, part["training"] = _fit_ensemble(fit, config, halfway, validation)
        else:
            model, part["training"] = fit(config, halfway)
        told = {name: network_predictions(model, *test) for name, test in tests.items()}
        if task.also:
            part["inverse"] = inverse_record(model, data, split.test)
    part["fold_test"] = told["fold"]
    if "fixed" in told:
        part["fixed_test"] = summary(told["fixed"])
    text = json.dumps(stored(part), allow_nan=False, separators=(",", ":"))
    write_text_atomically(folder / unit.file, text + "\n")
    for path in folder.glob(f".{unit.file}.*.pt*"):
        path.unlink()
    return True


def _guess(
    unit: Unit, data: xr.Dataset, train_on: np.ndarray, other: xr.Dataset, asked: np.ndarray
) -> dict[str, Any]:
    if unit.model == "logistic":
        return logistic_predictions(data, train_on, other, asked)
    task = task_of(unit.data)
    channels = task.action_channels, task.all_effects
    return baseline_predictions(BASELINES[unit.model], channels, data, train_on, other, asked)


def _fit(
    unit: Unit,
    network: NetworkConfig,
    config: TrainingConfig,
    halfway: Path,
    data: xr.Dataset,
    split: Split,
    progress: bool,
) -> tuple[EffectNetwork, dict[str, Any]]:
    channels = network.action_channels, network.effect_channels
    training = InteractionTensors.from_dataset(data, split.train, *channels)
    symmetries = task_of(unit.data).symmetries or ()
    if symmetries:
        training = augment_by_symmetry(training, symmetries)
    scaler = Scaler.fit(training)
    if (found := _shipped(network, config, scaler, data, split)) is not None:
        return found
    model, history = train_model(data, split, config, network, progress, symmetries, halfway)
    best = min(record.validation_error for record in history)
    return model, {
        "steps": history[-1].step,
        "seconds": history[-1].seconds,
        "validation_error": best,
        "temperature": model.temperature,
    }


def _fit_ensemble(
    fit: Callable[[TrainingConfig, Path], tuple[EffectNetwork, dict[str, Any]]],
    config: TrainingConfig,
    halfway: Path,
    validation: InteractionTensors,
) -> tuple[Ensemble, dict[str, Any]]:
    """Members fitted one by one, each with a seed of its own; σ of all together calibrated."""
    fitted = []
    for k in range(MEMBERS):
        mine = replace(config, seed=MEMBERS * config.seed + k)
        fitted.append(fit(mine, halfway.with_name(f"{halfway.name}{k}")))
    ensemble = Ensemble([model for model, _ in fitted])
    temperature = fit_temperature(ensemble, validation)
    return ensemble, {"members": [told for _, told in fitted], "temperature": temperature}


def _shipped(
    network: NetworkConfig,
    config: TrainingConfig,
    scaler: Scaler,
    data: xr.Dataset,
    split: Split,
) -> tuple[EffectNetwork, dict[str, Any]] | None:
    """The shipped checkpoint that this very training gave, if there is one.

    Settings, interactions seen, and all scales of their data must be the same.
    """
    for name, shipped in CHECKPOINT_SPECS.items():
        if (shipped.network, shipped.training) != (network, config):
            continue
        try:
            model, about = load_checkpoint(name)
        except (FileNotFoundError, ValueError):
            continue
        same = replace(model.config, sigma_floor=network.sigma_floor, temperature=()) == network
        expected = about_training(data, np.concatenate([split.train, split.validation]), config)
        # Options that are younger than a checkpoint were off when it was trained.
        settings = vars(TrainingConfig()) | about["training"] | {"device": config.device}
        del settings["max_minutes"]
        known = scaler
        if model.scaler.effect_radius_m is None:
            known = replace(scaler, effect_radius_m=None)  # younger than the checkpoint
        same &= expected == about | {"training": settings} and model.scaler == known
        if same:
            return model, {"checkpoint": name, "temperature": list(model.temperature)}
    return None


def run_units(
    units: Sequence[Unit],
    out_dir: str | Path = PARTS,
    client: Client | None = None,
    progress: bool = True,
) -> int:
    """Run what is missing of some units, in order, or on a Dask client's workers; how many ran.

    Workers write their parts themselves, so `out_dir` must be a folder that they share.
    """
    return run_parts(units, run_unit, out_dir, client, progress)


@command(OSError, ValueError)
def main(argv: Sequence[str] | None = None) -> int:
    """Train and test models in folds; finished parts are kept, interrupted ones go on."""
    parser = argparse.ArgumentParser(prog="python -m experiments.units", description=main.__doc__)
    models, sets = (f"of {','.join(known)}" for known in (MODELS, SETS))
    parser.add_argument("--models", type=names_type(MODELS), default="film,paper", help=models)
    parser.add_argument("--sets", type=names_type(SETS), default="push", help=sets)
    parser.add_argument("--n", type=count_type, help="interactions that are used (default: all)")
    parser.add_argument("--folds", type=whole_type(1, N_FOLDS), default=N_FOLDS, help="of the ten")
    parser.add_argument("--seeds", type=count_type, default=1)
    parser.add_argument("--out", default=PARTS)
    parser.add_argument("--scheduler", help="address of a Dask scheduler")
    parser.add_argument("--workers", type=count_type, default=1, help="processes of this machine")
    options = parser.parse_args(argv)
    seeds, folds = range(options.seeds), range(options.folds)
    chosen = product(options.sets, seeds, folds, options.models)
    n = options.n or "all"
    units = [Unit(model, data, n, fold, seed) for data, seed, fold, model in chosen]
    with dask_client(options.workers, options.scheduler) as client:
        ran = run_units(units, options.out, client)
    print(f"{ran} of {len(units)} units run, the others were there; {repo_root() / options.out}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
