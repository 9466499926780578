"""Studies beside the cross-validation: what each part of a network is worth, and what it knows.

    ablation      our network, one thing left out at a time, on pushes
    waterfall     the same, one thing added after another to a training by the paper's letter
    latent        how far r from an action and r from its effect are the same, and what w₁ does
    rollability   whether an object rolls, read from its image alone
    mixed         one network for pushes and drags: which of them is meant, by the decoded action
    varied        a perturbed world: error, and whether σ knows of it
    one_for_all   one network for all primitives, beside one for each
    floor         the same push of an object that stands a millimetre and a degree off
    stopped       actions broken off at t: the state then, and where things come to rest
    reach         where the arm can act, as learned, against its kinematics
    lever_tuning  ours and the recurrent network on lever-ups, with the same budget of settings
    tails         why σ is too wide for most pushes: three readings of what is off, and by how much

    python -m experiments.studies --only latent rollability

Each is written, whole or not at all, to `data/results/studies/` with the hashes of its data and
settings; `tables.py` and `lever_tables.py` put them beside the tables of the units.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import math
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from affordlib.commands import command
from affordlib.evaluation.metrics import refuse_seen
from affordlib.evaluation.predictions import rounded
from affordlib.interactions import InteractionTensors, open_interactions, split_interactions
from affordlib.interactions.dataset import valid_interactions
from affordlib.interactions.store import stored_sha256
from affordlib.models.calibration import calibration_rows
from affordlib.models.checkpoint import checkpoint_sha256, load_checkpoint
from affordlib.models.film import FiLMConfig
from affordlib.models.frame import heading, inverse, turn_observations
from affordlib.models.protocol import observe_final_effect
from affordlib.models.training import final_errors_m, train_model
from affordlib.paths import resolve_out_dir
from affordlib.perception import looks_rollable
from affordlib.results import write_text_atomically
from affordlib.types import Observations
from experiments import ablation, lever_tuning, limits, one_for_all, tails
from experiments.rollability import learn_rollability
from experiments.shipped import CHECKPOINT_SPECS

FOLDER = "data/results/studies"
Rows = list[dict[str, Any]]

TRAINING = replace(CHECKPOINT_SPECS["film_500"].training, steps=1500)
"""Of `mixed` and `varied`; longer for a network that is shipped."""

VARIED_FOLDS = 3

WEIGHTS = (0.25, 0.5, 0.75)
HALF_WAY_M = 0.1
"""A decoded action that starts farther from the object than this is a push, else a drag."""


def cka(a: torch.Tensor, b: torch.Tensor) -> float | None:
    """Linear centred kernel alignment of codes (N, D) and (N, E), 1 for equal up to a turn.

    None where codes are all the same, as those of actions in the frame of the push. Kornblith et
    al., Similarity of neural network representations revisited, ICML 2019.
    """
    if min(v.std(dim=0).norm() / v.mean(dim=0).norm() for v in (a, b)) < 1e-3:
        return None
    a, b = (v - v.mean(dim=0) for v in (a.double(), b.double()))
    return float((a.T @ b).square().sum() / ((a.T @ a).norm() * (b.T @ b).norm()))


def _seen_by(arrays: InteractionTensors, action: bool, effect: bool, weight: float) -> Observations:
    """The action at t = 0 and 1, the effect at t = 0.8 and 1, or both, blended by w₁."""
    last = len(arrays.phase) - 1
    ends, late = torch.tensor([0, last]), torch.tensor([round(0.8 * last), last])
    return Observations.of(
        arrays,
        arrays.action_at(ends) if action else None,
        arrays.effect_at(late) if effect else None,
        torch.full((len(arrays),), weight),
    )


@torch.no_grad()
def latent() -> Rows:
    """Alignment of the codes r of `push_test`, and the errors of what is decoded from them."""
    data = open_interactions("push_test")
    rows = []
    for name in ("cnp_500", "film_500"):
        model, _ = load_checkpoint(name)
        channels = model.action_channels, model.effect_channels
        arrays = InteractionTensors.from_dataset(data, None, *channels)

        def code(observed: Observations, model: Any = model, channels: Any = channels) -> Any:
            if model.config.frame == "push":
                back = inverse(heading(observed, *channels))
                observed = turn_observations(observed, back, *channels)
            return model.represent(observed)

        r_a, r_e = code(_seen_by(arrays, True, False, 1.0)), code(_seen_by(arrays, False, True, 0))
        other = r_e.roll(1, dims=0)
        features, t_target = model.encode(arrays.image), torch.tensor([[0.0, 1.0]])
        for action, effect, weights in (
            (True, False, (1.0,)),
            (False, True, (0.0,)),
            (True, True, WEIGHTS),
        ):
            for weight in weights:
                observed = _seen_by(arrays, action, effect, weight)
                told = model.predict(features, observed, t_target.expand(len(arrays), -1))
                start = (told.action_mean[:, 0, :2] - arrays.action[:, 0, :2]).norm(dim=-1)
                end = (told.effect_mean[:, 1, :2] - arrays.effect[:, -1, :2]).norm(dim=-1)
                r = code(observed)
                rows.append(
                    {
                        "model": name,
                        "observed": "both" if action and effect else "action" * action or "effect",
                        "w_1": weight,
                        "n": len(arrays),
                        "cosine_to_action": float(torch.cosine_similarity(r, r_a).mean()),
                        "cosine_to_effect": float(torch.cosine_similarity(r, r_e).mean()),
                        "cosine_to_other": float(torch.cosine_similarity(r, other).mean()),
                        "cka_action_effect": cka(r_a, r_e),
                        "action_start_mean_m": float(start.mean()),
                        "final_error_mean_m": float(end.mean()),
                    }
                )
    return rows


def rollability() -> Rows:
    """Shares of objects read rightly: learned from 400 images of `mixed`, and by curvature."""
    mixed = open_interactions("mixed")
    split = split_interactions(mixed.sizes["interaction"])
    model = learn_rollability(mixed, split.train)
    rows = []
    for name in ("mixed", "partial", "push_test", "drag", "reach"):
        data = open_interactions(name)
        chosen = split.test if name == "mixed" else np.arange(data.sizes["interaction"])
        images, rolls = data["image"].values[chosen], data["rollable"].values[chosen]
        with torch.no_grad():
            learned = model(torch.from_numpy(images)).numpy() > 0.5
        rule = np.array([looks_rollable(image) for image in images])
        names = np.array(data["family"].attrs["flag_meanings"].split())
        category = names[data["family"].values[chosen]]
        for kind in ("all", *np.unique(category)):
            of = (category == kind) | (kind == "all")
            rows.append(
                {
                    "test": name,
                    "object_class": str(kind),
                    "n": int(of.sum()),
                    "learned_percent": 100 * float((learned == rolls)[of].mean()),
                    "curvature_percent": 100 * float((rule == rolls)[of].mean()),
                }
            )
    return rows


def mixed() -> Rows:
    """The paper's single model of pushes and drags: the wanted effect alone, the behaviour read.

    Objects of `partial` are to be moved in some direction by what drags do in the median, and by
    what pushes do; the model was trained on neither these objects nor a switch.
    """
    data, other = open_interactions("mixed"), open_interactions("partial")
    split = split_interactions(data.sizes["interaction"])
    model, _ = train_model(data, split, TRAINING, FiLMConfig(), progress=False)
    arrays = InteractionTensors.from_dataset(data, split.train)
    rolls = data["rollable"].values[valid_interactions(data, split.train)]
    length = arrays.effect[:, -1].norm(dim=-1)
    usual_m = [float(length[torch.from_numpy(rolls == kind)].median()) for kind in (True, False)]
    test = InteractionTensors.from_dataset(data, split.test)
    errors = final_errors_m(model, test).numpy()
    forward = data["rollable"].values[valid_interactions(data, split.test)]
    asked = InteractionTensors.from_dataset(other)
    rolls = other["rollable"].values[
        valid_interactions(other, np.arange(other.sizes["interaction"]))
    ]
    rows = []
    for wanted_m in usual_m:
        wanted = wanted_m * _unit(len(asked))
        with torch.no_grad():
            told = model.predict(
                model.encode(asked.image),
                observe_final_effect(model, wanted),
                torch.zeros(len(asked), 1),
            )
        radius = told.action_mean[:, 0].norm(dim=-1).numpy()
        for kind in (False, True):
            rows.append(
                {
                    "rollable": kind,
                    "n": int((rolls == kind).sum()),
                    "wanted_mean_m": wanted_m,
                    "behaviour_right_percent": 100
                    * float(((radius > HALF_WAY_M) != kind)[rolls == kind].mean()),
                    "start_radius_median_m": float(np.median(radius[rolls == kind])),
                    "n_forward": int((forward == kind).sum()),
                    "final_error_mean_m": float(errors[forward == kind].mean()),
                }
            )
    return rows


def _unit(n: int) -> torch.Tensor:
    angle = math.tau * torch.rand(n, generator=torch.Generator().manual_seed(0))
    return torch.stack([angle.cos(), angle.sin()], dim=-1)


def varied() -> Rows:
    """Errors and calibration in the varied, noisy world: folds of 500 pushes together, and all of
    these asked of the network that learned from 4,000 others.
    """
    data = open_interactions("push_varied")
    network = CHECKPOINT_SPECS["film_500"].network
    channels = network.action_channels, network.effect_channels
    errors, judged = [], []
    for fold in range(VARIED_FOLDS):
        split = split_interactions(data.sizes["interaction"], 0, fold)
        model, _ = train_model(data, split, TRAINING, network, progress=False)
        test = InteractionTensors.from_dataset(data, split.test, *channels)
        errors.append(final_errors_m(model, test).numpy())
        judged.append(calibration_rows(model, test))
    rows = _varied_rows(500, VARIED_FOLDS, np.concatenate(errors), judged)
    model, about = load_checkpoint("film_5000_perturbed")
    everything = np.arange(data.sizes["interaction"])
    refuse_seen(about, data, everything)
    test = InteractionTensors.from_dataset(data, everything, *channels)
    error = final_errors_m(model, test).numpy()
    return rows + _varied_rows(5000, 1, error, [calibration_rows(model, test)])


def _varied_rows(n_interactions: int, folds: int, error: np.ndarray, judged: list[Rows]) -> Rows:
    about = {"n_interactions": n_interactions, "folds": folds, "n": len(error)}
    about |= {"final_error_mean_m": float(error.mean())}
    about |= {"final_error_median_m": float(np.median(error))}
    rows = []
    for same in zip(*judged, strict=True):
        row = about | {key: same[0][key] for key in ("phase", "channel")}
        for key in ("coverage_50", "coverage_90", "std_mean", "nll"):
            row[key] = float(np.average([r[key] for r in same], weights=[r["n"] for r in same]))
        rows.append(row)
    return rows


def _network_settings(*more: Any) -> Any:
    return replace(TRAINING, device="cpu"), CHECKPOINT_SPECS["film_500"].network, *more


def _ablation_settings(ladder: dict[str, str] | None = None) -> Any:
    whole = replace(CHECKPOINT_SPECS["film_500"].training, device="cpu")
    changes = {
        change: {of: getattr(new, "__name__", new) for of, new in ablation.CHANGES[change].items()}
        for change in (ablation.CHANGES if ladder is None else ladder.values())
    }
    return (
        CHECKPOINT_SPECS["film_500"].network,
        whole,
        ablation.STEPS,
        ablation.SEEDS,
        changes,
        ladder,
    )


@dataclass(frozen=True)
class Study:
    """What makes its rows; the data sets and checkpoints it reads, all else that decides it.

    of: the results that show it as one of their tables.
    """

    rows: Callable[[], Rows]
    sets: tuple[str, ...] = ()
    checkpoints: tuple[str, ...] = ()
    settings: Callable[[], Any] = _network_settings
    of: str = "effect_prediction"


STUDIES = {
    "ablation": Study(
        ablation.ablation,
        ("push", "push_test"),
        settings=_ablation_settings,
    ),
    "waterfall": Study(
        ablation.waterfall,
        ("push", "push_test"),
        settings=lambda: _ablation_settings(ablation.LADDER),
    ),
    "latent": Study(latent, ("push_test",), ("cnp_500", "film_500"), settings=lambda: WEIGHTS),
    "rollability": Study(rollability, ("mixed", "partial", "push_test", "drag", "reach")),
    "mixed": Study(mixed, ("mixed", "partial"), settings=lambda: _network_settings(HALF_WAY_M)),
    "varied": Study(
        varied,
        ("push_varied",),
        ("film_5000_perturbed",),
        settings=lambda: _network_settings(VARIED_FOLDS),
    ),
    "tails": Study(tails.tails, ("push", "drag", "push_test"), tails.CHECKPOINTS),
    "one_for_all": Study(
        one_for_all.one_for_all,
        (*one_for_all.PRIMITIVES, "push_test"),
        settings=one_for_all.settings,
    ),
    "floor": Study(limits.floor, ("push_test",), settings=limits.floor_settings),
    "stopped": Study(limits.stopped, ("partial",), limits.STOPPED, settings=lambda: limits.PHASES),
    "reach": Study(limits.reach, settings=limits.reach_settings),
    "lever_tuning": Study(
        lever_tuning.lever_tuning,
        (lever_tuning.DATA,),
        settings=lever_tuning.settings,
        of="lever_up",
    ),
}


def hashes(name: str) -> dict[str, Any]:
    """What a written study must hold to be that of today's data, checkpoints and settings."""
    study = STUDIES[name]
    return {
        "settings_sha256": hashlib.sha256(repr(study.settings()).encode()).hexdigest(),
        "data_sha256": {s: stored_sha256(s) for s in study.sets},
        "checkpoints_sha256": {c: checkpoint_sha256(c) for c in study.checkpoints},
    }


def read_study(name: str, folder: str | Path = FOLDER) -> Rows | None:
    """The rows of a study; None when there are none, ValueError when they are of other data."""
    path = resolve_out_dir(folder) / f"{name}.json"
    if not path.is_file():
        return None
    told = json.loads(path.read_text())
    for key, expected in hashes(name).items():
        if told.get(key) != expected:
            raise ValueError(
                f"study {path.name} has another {key} than it would have now; run "
                f"`python -m experiments.studies --only {name}` again"
            )
    return told["rows"]


@command(OSError, ValueError)
def main(argv: Sequence[str] | None = None) -> int:
    """Make studies anew and write them."""
    parser = argparse.ArgumentParser(prog="python -m experiments.studies", description=main.__doc__)
    parser.add_argument("--only", nargs="+", choices=sorted(STUDIES), default=list(STUDIES))
    parser.add_argument("--out", default=FOLDER)
    options = parser.parse_args(argv)
    for name in options.only:
        told = hashes(name) | {"rows": rounded(STUDIES[name].rows())}
        path = resolve_out_dir(options.out) / f"{name}.json"
        write_text_atomically(path, json.dumps(told, indent=1, allow_nan=False) + "\n")
        print(path)
    return 0


if __name__ == "__main__":
    sys.exit(main())
