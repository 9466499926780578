"""Studies in addition to the cross-validation: ablations, novelty, partial actions.

    python -m experiments.studies --only study=novelty_judged

computes missing or stale results in `data/results/raw/studies.jsonl.gz`. The tables are written by
`experiments.effect_prediction`.
"""

from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch

from affordlib.interactions import open_interactions
from affordlib.models import condition_on_primitives, load_checkpoint
from affordlib.primitives import Drag, Push
from experiments import ablation, novelty, runner
from experiments.runner import FOLDER, Job, Rows, read

NAME = "studies"
WHOLE_ACTION_MODELS = ("film_500", "film_5000", "drag_film_500")
PHASES = (0.0, 0.55, 0.65, 0.75, 1.0)
"""Edges of the phase bins; the gripper touches nothing before 0.5."""


@torch.no_grad()
def partial_execution() -> Rows:
    """Measure the errors on actions that stop at phase t of networks trained only on full actions.

    The truth is the state of the full action at t, or the object's rest position.
    """
    data, rows = open_interactions("partial"), []
    names = data["primitive"].attrs["flag_meanings"].split()
    kinds, phase = np.array(names)[data["primitive"].values], data["stop_phase"].values
    whole, rest = (data[name].values for name in ("full_effect", "rest_effect"))
    slid = np.hypot(*(rest - whole)[:, :2].T)
    for name in WHOLE_ACTION_MODELS:
        model, _ = load_checkpoint(name)
        kind = Drag if name.startswith("drag") else Push
        mine = np.flatnonzero((kinds == kind.name) & ~data["fault"].values)
        actions = [kind(float(theta)) for theta in data["theta"].values[mine]]
        features = model.encode(torch.from_numpy(data["image"].values[mine]))
        at = torch.from_numpy(phase[mine]).float()[:, None]
        predicted = model.predict(features, condition_on_primitives(model, actions), at)
        columns = [model.effect_channels.index(c) for c in "xy"]
        mean = predicted.effect_mean[:, 0, columns].numpy()
        errors = [np.hypot(*(mean - truth[mine, :2]).T) for truth in (whole, rest)]
        for low, high in pairwise(PHASES):
            of = (phase[mine] > low) & (phase[mine] <= high)
            row = {"model": name, "from_phase": low, "to_phase": high, "n": int(of.sum())}
            for what, error in zip(("whole", "rest"), errors, strict=True):
                row[f"{what}_mean_m"] = float(error[of].mean())
                row[f"{what}_median_m"] = float(np.median(error[of]))
            rows.append(row | {"slid_mean_m": float(slid[mine][of].mean())})
    return rows


_LADDER = ablation.ABOUT, [*ablation.LADDER.values()]
_GROWN = *novelty.SETTINGS, novelty.NOVELTY_GAIN
STUDIES: dict[Callable[[], Rows], tuple[Any, ...]] = {
    ablation.incremental_ablation: (_LADDER, ("push",), (), 2),
    novelty.novelty_gain: (novelty.SETTINGS, ("push",), novelty.MODELS[:3]),
    novelty.novelty_judged: (_GROWN, ("push_test",), novelty.MODELS),
    partial_execution: (PHASES, ("partial",), WHOLE_ACTION_MODELS),
}
"""Functions that return the rows of a study; settings, data, checkpoints and version of its job."""

BY_NAME = {study.__name__: study for study in STUDIES}


def job(study: str) -> Job:
    """Return the job that makes the rows of a study."""
    return Job(make_rows, {"study": study}, *STUDIES[BY_NAME[study]])


def make_rows(study: str) -> Rows:
    """Make the rows of a study."""
    return BY_NAME[study]()


def tables(folder: str | Path = FOLDER) -> dict[str, Rows]:
    """Return the rows of all finished studies; raises ValueError for stale ones."""
    made = {arguments["study"]: rows for arguments, rows in read(NAME, job, folder)}
    return {name: made[name] for name in BY_NAME if name in made}


main = runner.command_of(NAME, __doc__, lambda: [job(name) for name in BY_NAME])

if __name__ == "__main__":
    raise SystemExit(main())
