"""Make the shipped data sets, checkpoints and reachability: `make data`, `make checkpoints`.

python -m experiments.shipped data --only push_x10 --to data
python -m experiments.shipped checkpoints --only film_500
python -m experiments.shipped reachability
python -m experiments.shipped goals
"""

import argparse
import json
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch
import xarray as xr
from torch import nn

from affordlib.interactions import open_interactions, recipes, sample_mixed, split_interactions
from affordlib.interactions.collect import collect
from affordlib.interactions.recipes import Variation
from affordlib.interactions.store import SUFFIX as DATA_SUFFIX
from affordlib.interactions.store import dataset_sha256
from affordlib.models import CNPConfig, FiLMConfig, NetworkConfig
from affordlib.models.checkpoint import SUFFIX, save_checkpoint
from affordlib.models.lever_up import lever_up_tensors
from affordlib.models.training import Sampler, TrainingConfig, about_training, train_model
from affordlib.planning.skills import REACHABILITY, Reachability, reach_features
from affordlib.results import repo_root, write_atomically
from affordlib.world import ROLLABLE, STANDING, Tabletop, WorldConfig
from experiments import lever_up
from experiments.commands import command, worker_type
from experiments.lever_up import Symmetry, augment_by_symmetry
from experiments.lstm import LSTMConfig, sample_forward
from experiments.published import PUBLISHED, ConstantRate, one_at_a_time
from experiments.tasks import FROZEN, PlanningTask, constructed_tasks, sealed, uniform_tasks

RECIPES = recipes.RECIPES | {
    f"{name}_x10": replace(recipe, n_interactions=10 * recipe.n_interactions, seed=recipe.seed + 10)
    for name, recipe in recipes.RECIPES.items()
    if name not in ("push_test", "partial", "reach")
}
RECIPES["grasp_firm_x10"] = replace(RECIPES["grasp_x10"], seed=18, world=WorldConfig())
"""The shipped sets, sets of ten times the size, and grasps with the friction of the pushes, with
which objects slip less."""


@dataclass(frozen=True)
class CheckpointSpec:
    """The data set, network and training of a checkpoint; symmetries: of `augment_by_symmetry`."""

    data: str
    network: NetworkConfig
    training: TrainingConfig
    symmetries: tuple[Symmetry, ...] = ()
    sampler: Sampler = sample_mixed


_PUSH_FRAME = TrainingConfig(
    steps=4000, n_targets=8, patience=99, beta=0.5, weight_decay=0.1, final_sigma_floor=0.005,
    ema=0.99,
)  # fmt: skip
_TABLE_FRAME = replace(_PUSH_FRAME, augment=False)
_LONG = replace(_PUSH_FRAME, steps=16000)
_YAW = FiLMConfig(effect_channels=("x", "y", "yaw"))
_LIFT = FiLMConfig(frame="table", action_channels=("z", "gripper"), effect_channels=("z",))
_TURN = FiLMConfig(frame="table", action_channels=("yaw", "gripper"), effect_channels=("yaw",))
_LSTM = LSTMConfig(effect_channels=_YAW.effect_channels, frame="push", width=128)
HALF_TURNS: tuple[Symmetry, ...] = ((0, False), (2, False))
GRASP_SYMMETRIES: tuple[Symmetry, ...] = (*HALF_TURNS, (0, True), (2, True))
"""Symmetries of rotations and grasps, which have no direction."""

CHECKPOINT_SPECS: dict[str, CheckpointSpec] = {
    "cnp_500": CheckpointSpec("push", CNPConfig(), TrainingConfig(steps=5000, patience=20)),
    "cnp_published": CheckpointSpec("push", CNPConfig(), PUBLISHED, sampler=one_at_a_time),
    "film_500": CheckpointSpec("push", _YAW, _PUSH_FRAME),
    "film_5000": CheckpointSpec("push_x10", _YAW, _LONG),
    "film_5000_perturbed": CheckpointSpec("push_varied_x10", _YAW, _LONG),
    "drag_film_500": CheckpointSpec("drag", FiLMConfig(), _PUSH_FRAME),
    "grasp_film_1000": CheckpointSpec("grasp_x10", _LIFT, _TABLE_FRAME, GRASP_SYMMETRIES),
    "grasp_film_1000_firm": CheckpointSpec("grasp_firm_x10", _LIFT, _TABLE_FRAME, GRASP_SYMMETRIES),
    "rotate_film_1000": CheckpointSpec("rotate_x10", _TURN, _TABLE_FRAME, HALF_TURNS),
    "lstm_500": CheckpointSpec("push", _LSTM, _PUSH_FRAME, sampler=sample_forward),
}
"""Definitions by name. On one core, training takes ten minutes for `cnp_500`, five for `lstm_500`
and for 5,000 pushes, one or two for others. Five use `_x10` sets, which are not shipped.
`cnp_published`, by the paper's own recipe, takes hours: it is resumed, and made only if named."""

N_GOALS = {"single_full": 50, "single_partial": 100, "multi_partial": 80}  # as in Table 3
REACH_STEPS, REACH_RATE = 1500, 1e-2

TOLERANCE_M = 0.00005
"""Largest median distance [m] between the final positions of two collections of the same set, on
other processors, too (see *Known limits* in data/README.md)."""


def compare(old: xr.Dataset, new: xr.Dataset) -> tuple[bool, str]:
    """Return whether two collections of a recipe agree, and a sentence with the difference."""
    if dataset_sha256(old) == dataset_sha256(new):
        return True, "the same, bit for bit"
    before, after = (data["rest_effect"].values[:, :2] for data in (old, new))
    if before.shape != after.shape:
        return False, f"not the same: {len(after)} interactions, formerly {len(before)}"
    gap_m = np.linalg.norm(before - after, axis=1)
    median_m = float(np.median(gap_m))
    agree = median_m <= TOLERANCE_M
    return agree, (
        f"{'the same within the tolerance' if agree else 'NOT the same'}: final positions differ "
        f"by {median_m * 1000:.3f} mm in the median (tolerance {TOLERANCE_M * 1000:g} mm) and by "
        f"at most {gap_m.max() * 1000:.3f} mm"
    )


def collect_sets(options: argparse.Namespace) -> bool:
    """Collect data sets; return whether each agrees with the existing one."""
    agree = True
    for name in options.only or recipes.RECIPES:
        try:
            old = open_interactions(name)
        except (FileNotFoundError, ValueError) as error:
            old = None
            print(f"{name}: there is no existing data set to compare with ({error})")
        target = f"{options.to}/{name}{DATA_SUFFIX}"
        new = open_interactions(collect(RECIPES[name], target, options.workers, replace=True))
        print(f"{name}: {new.sizes['interaction']} interactions, sha256 {dataset_sha256(new)}")
        if old is not None:
            same, sentence = compare(old, new)
            print(f"{name}: {sentence}")
            agree &= same
    return agree


def data_of(checkpoint: str) -> str:
    """Return the name of a shipped checkpoint's data set."""
    return CHECKPOINT_SPECS[checkpoint].data if checkpoint in CHECKPOINT_SPECS else "lever_up"


def train_checkpoint(name: str) -> None:
    """Train a shipped model on fold 0 of its data set and write it to data/checkpoints."""
    data = open_interactions(data_of(name))
    split = split_interactions(data.sizes["interaction"])
    if name in lever_up.LEVER_CHECKPOINTS:
        lever_name, trained_for = lever_up.LEVER_CHECKPOINTS[name]
        spec = lever_up.LEVER_MODELS[lever_name]
        parts = [lever_up_tensors(data, p, spec.view) for p in (split.train, split.validation)]
        model, history = lever_up.fit_lever_model(spec, *parts, trained_for)
        more = {"trained_for": trained_for, "view": spec.view}
    else:
        spec, more = CHECKPOINT_SPECS[name], {}
        augment = partial(augment_by_symmetry, symmetries=spec.symmetries)
        partly = f"runs/.{name}.pt" if isinstance(spec.training, ConstantRate) else None
        how = {"augment": augment, "sampler": spec.sampler, "resume_checkpoint": partly}
        model, history = train_model(data, split, spec.training, spec.network, **how)
    path = repo_root() / "data" / "checkpoints" / f"{name}{SUFFIX}"
    seen = np.concatenate([split.train, split.validation])
    save_checkpoint(model, path, about_training(data, seen, spec.training) | more)
    error, last = 1000 * min(record.validation_error for record in history), history[-1]
    took = f"{last.step} steps in {last.seconds:.0f} s"
    print(f"{path.name}: {took}, validation {error:.2f} mm or mrad")


def train_checkpoints(options: argparse.Namespace) -> bool:
    """Train the checkpoints whose data exist; return whether these are all."""
    complete = True
    usual = [name for name in CHECKPOINT_SPECS if name != "cnp_published"]
    for name in options.only or [*usual, *lever_up.LEVER_CHECKPOINTS]:
        data = data_of(name)
        if (repo_root() / "data" / f"{data}{DATA_SUFFIX}").is_file():
            train_checkpoint(name)
        else:
            complete = False
            print(
                f"{name}: unchanged, because its data set {data} is neither shipped nor here. "
                f"Collect it: .venv/bin/python -m experiments.shipped data --only {data} --to data"
            )
    return complete


def learn_reachability(data: xr.Dataset, seed: int = 0) -> Reachability:
    """Train reachability on interactions and their mirror images: the arm is on the x axis."""
    number = data["primitive"].values
    xy_m = data["estimated_xy"].values
    names = data["primitive"].attrs["flag_meanings"].split()
    direction = data["theta"].values + np.where(number == names.index("push"), np.pi, 0.0)
    kind = np.eye(len(names))[number]
    reached = torch.from_numpy(data["reached"].values).float()
    mirrored = reach_features(kind, xy_m * [1, -1], -direction)
    inputs = torch.cat([reach_features(kind, xy_m, direction), mirrored])
    torch.manual_seed(seed)
    model = Reachability(names)
    optimiser = torch.optim.AdamW(model.parameters(), REACH_RATE)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, REACH_RATE, REACH_STEPS)
    for _ in range(REACH_STEPS):
        logits = model.layers(inputs).squeeze(-1)
        loss = nn.functional.binary_cross_entropy_with_logits(logits, reached.repeat(2))
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        schedule.step()
    return model.eval()


def train_reachability(_: argparse.Namespace) -> None:
    """Train the shipped reachability on the shipped set `reach`."""
    learn_reachability(open_interactions("reach")).save(repo_root() / REACHABILITY)
    print(REACHABILITY)


VARIATIONS = {
    "perturbed": Variation(),
    "perturbed_rollable": Variation(),
    "outside": Variation(
        table_friction=(0.65, 1.0), density_kg_m3=(1200.0, 2400.0), com_offset=0.3, bias_sd_m=0.002
    ),
}
"""Variations of the worlds with frozen goals. `outside` is out of distribution for the networks:
rougher tables, denser objects, and other errors and offsets up to twice as large as in training."""


def draw_goals(_: argparse.Namespace) -> None:
    """Sample the goals of Table 3 and 40 validation goals, and write files that stay frozen."""
    missing = [world for world, path in FROZEN.items() if not (repo_root() / path).exists()]
    for name in missing:
        tasks: list[PlanningTask] = []
        seed = {"validation": 1, "fresh": 2, "fresh_rollable": 2}.get(name, 0)
        counts = {"multi_partial": 40} if name == "validation" else N_GOALS
        classes = ROLLABLE if name.endswith("rollable") else STANDING
        classes += ROLLABLE if name == "clean" else ()
        with Tabletop() as world:
            for mode, n in counts.items():
                tasks += constructed_tasks(world, mode, n, seed, classes, VARIATIONS.get(name))
                if name == "clean":
                    tasks += uniform_tasks(mode, n, seed, classes)
        rows = ",\n".join(json.dumps(task.to_json()) for task in tasks)
        text = f'{{"seed": {seed}, "tasks": [\n{rows}\n]}}\n'
        path = repo_root() / FROZEN[name]
        write_atomically(path, sealed(path.stem, text))
    print(f"goals sampled for the worlds: {', '.join(missing) or 'none, all files exist'}")


COMMANDS = {
    "data": collect_sets,
    "checkpoints": train_checkpoints,
    "reachability": train_reachability,
    "goals": draw_goals,
}


@command(OSError, ValueError, RuntimeError)
def main(argv: Sequence[str] | None = None) -> int:
    """Make shipped files again; exit with 1 if data sets differ or are missing, else with 0."""
    parser = argparse.ArgumentParser(prog="python -m experiments.shipped", description=main.__doc__)
    kinds = parser.add_subparsers(required=True)
    for name, make in COMMANDS.items():
        kinds.add_parser(name, help=make.__doc__).set_defaults(make=make)
    data, checkpoints = kinds.choices["data"], kinds.choices["checkpoints"]
    data.add_argument("--only", nargs="+", choices=sorted(RECIPES), help="default: shipped sets")
    data.add_argument("--to", default=str(repo_root() / "data"), help="output folder")
    cores = min(os.cpu_count() or 1, 256)
    data.add_argument("--workers", type=worker_type, default=cores, help="local processes")
    names = sorted([*CHECKPOINT_SPECS, *lever_up.LEVER_CHECKPOINTS])
    checkpoints.add_argument("--only", nargs="+", choices=names, help="default: all")
    options = parser.parse_args(argv)
    return int(options.make(options) is False)


if __name__ == "__main__":
    raise SystemExit(main())
