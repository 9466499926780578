"""Studies beside the cross-validation: what each part of a network is worth, and what it knows.

    ablation               our network, one thing left out at a time, on pushes
    incremental_ablation   the published training, one thing added after another until it is ours
    latent                 similarity of the codes r of an action and its effect, and the role of w₁
    rollability            whether an object rolls, from its image alone
    push_and_drag_model    one network for pushes and drags: which of them is meant
    perturbed_world        errors and calibration with perturbed physics and camera noise
    residual_distribution  why σ is too wide for most pushes: three fits to the residuals
    shared_network         one network for all primitives, beside one for each
    pose_sensitivity       the same push of an object that is a millimetre and a degree off
    partial_execution      actions that stop at t: the state then, and where objects come to rest
    reachability_accuracy  where the arm can act, as learned, against its kinematics
    tuning                 ours and the recurrent network on lever-ups, with the same budget

    python -m experiments.studies --only latent rollability

makes what is missing or stale of `data/results/raw/studies.jsonl.gz`; the tables are put beside
those of `experiments.effect_prediction` and `experiments.lever_up` by these.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from affordlib.commands import command
from affordlib.evaluation.metrics import refuse_seen
from affordlib.interactions import InteractionTensors, open_interactions, split_interactions
from affordlib.models.calibration import calibration_rows
from affordlib.models.checkpoint import load_checkpoint
from affordlib.models.film import FiLMConfig
from affordlib.models.training import final_errors_m, train_model
from experiments import ablation, limits, representation, residual_distribution, shared_network
from experiments import lever_cross_validation as lever
from experiments.representation import TRAINING
from experiments.runner import FOLDER, Job, read, run
from experiments.shipped import CHECKPOINT_SPECS

NAME = "studies"
PERTURBED_FOLDS = 3
NETWORK = CHECKPOINT_SPECS["film_500"].network
Rows = list[dict[str, Any]]


def perturbed_world() -> Rows:
    """Errors and calibration in a perturbed world with camera noise.

    Folds of 500 pushes together; and all of these, predicted by the network that learned from 4,000
    others.
    """
    data = open_interactions("push_varied")
    channels = NETWORK.action_channels, NETWORK.effect_channels
    errors, calibrated = [], []
    for fold in range(PERTURBED_FOLDS):
        split = split_interactions(data.sizes["interaction"], 0, fold)
        model, _ = train_model(data, split, TRAINING, NETWORK)
        test = InteractionTensors.from_dataset(data, split.test, *channels)
        errors.append(final_errors_m(model, test).numpy())
        calibrated.append(calibration_rows(model, test))
    rows = _perturbed_rows(500, PERTURBED_FOLDS, np.concatenate(errors), calibrated)
    model, about = load_checkpoint("film_5000_perturbed")
    everything = np.arange(data.sizes["interaction"])
    refuse_seen(about, data, everything)
    test = InteractionTensors.from_dataset(data, everything, *channels)
    error = final_errors_m(model, test).numpy()
    return rows + _perturbed_rows(5000, 1, error, [calibration_rows(model, test)])


def _perturbed_rows(
    n_interactions: int, folds: int, error: np.ndarray, calibrated: list[Rows]
) -> Rows:
    about = {"n_interactions": n_interactions, "folds": folds, "n": len(error)}
    about |= {"final_error_mean_m": float(error.mean())}
    about |= {"final_error_median_m": float(np.median(error))}
    rows = []
    for same in zip(*calibrated, strict=True):
        row = about | {key: same[0][key] for key in ("phase", "channel")}
        for key in ("coverage_50", "coverage_90", "std_mean", "nll"):
            row[key] = float(np.average([r[key] for r in same], weights=[r["n"] for r in same]))
        rows.append(row)
    return rows


@dataclass(frozen=True)
class Study:
    """A function of rows, and what decides them."""

    rows: Callable[..., Rows]
    data: tuple[str, ...] = ()
    checkpoints: tuple[str, ...] = ()
    settings: Any = ()


_PUSHES, _ROLLING = ("push", "push_test"), ("mixed", "partial", "push_test", "drag", "reach")
_ABLATION = (NETWORK, CHECKPOINT_SPECS["film_500"].training, ablation.STEPS, ablation.SEEDS)
_ADDED = [ablation.CHANGES[change] for change in ablation.LADDER.values()]
_BOTH = (TRAINING, FiLMConfig(), representation.PUSH_START_MIN_RADIUS_M)
_SEPARATE = [j.settings for jobs in shared_network.SEPARATE_JOBS.values() for j in jobs]
_SHARED = (shared_network.NETWORK, shared_network.TRAINING, _SEPARATE)
_POSE = (limits.N_PUSHES, limits.REPEATS, limits.POSITION_ERROR_M, limits.YAW_ERROR_RAD)
_REACH = (limits.N_PLACES, limits.NEAR_THE_LIMIT)
_MODELS, _RESIDUALS = representation.LATENT_MODELS, residual_distribution.CHECKPOINTS
_VARIED = ("push_varied",), ("film_5000_perturbed",), (TRAINING, NETWORK, PERTURBED_FOLDS)
_FOUR = (*shared_network.PRIMITIVES, "push_test")

STUDIES = {
    study.rows.__name__: study
    for study in (
        Study(ablation.ablation, _PUSHES, (), (_ABLATION, ablation.CHANGES)),
        Study(ablation.incremental_ablation, _PUSHES, (), (_ABLATION, _ADDED)),
        Study(representation.latent, ("push_test",), _MODELS, representation.WEIGHTS),
        Study(representation.rollability, _ROLLING),
        Study(representation.push_and_drag_model, ("mixed", "partial"), (), _BOTH),
        Study(perturbed_world, *_VARIED),
        Study(
            residual_distribution.residual_distribution, ("push", "drag", "push_test"), _RESIDUALS
        ),
        Study(shared_network.shared_network, _FOUR, (), _SHARED),
        Study(limits.pose_sensitivity, ("push_test",), (), _POSE),
        Study(limits.partial_execution, ("partial",), limits.WHOLE_ACTION_MODELS, limits.PHASES),
        Study(limits.reachability_accuracy, (), ("reachability",), _REACH),
        Study(lever.tuning, ("lever_up",), (), lever.TUNING),
    )
}


def job(study: str) -> Job:
    """The job that makes the rows of a study."""
    s = STUDIES[study]
    return Job(make_rows, {"study": study}, s.settings, s.data, s.checkpoints)


def make_rows(study: str, resume_checkpoint: Path) -> Rows:
    """The rows of a study."""
    rows = STUDIES[study].rows
    return rows(resume_checkpoint) if rows is shared_network.shared_network else rows()


def tables(table: str, folder: str | Path = FOLDER) -> dict[str, Rows]:
    """The rows of the studies that stand beside a table; stale ones raise ValueError."""
    made = {arguments["study"]: rows for arguments, rows in read(NAME, job, folder)}
    here = [name for name in STUDIES if (name == "tuning") == (table == "lever_up")]
    return {name: made[name] for name in here if name in made}


@command(OSError, ValueError)
def main(argv: Sequence[str] | None = None) -> int:
    """Make studies that are missing or stale."""
    parser = argparse.ArgumentParser(prog="python -m experiments.studies", description=main.__doc__)
    parser.add_argument("--only", nargs="+", choices=sorted(STUDIES), default=list(STUDIES))
    parser.add_argument("--raw", default=FOLDER, help="the folder of the results")
    options = parser.parse_args(argv)
    run([job(name) for name in options.only], NAME, folder=options.raw)
    return 0


if __name__ == "__main__":
    sys.exit(main())
