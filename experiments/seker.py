"""Table 1 on the paper's own lever-ups, by Seker, Tekden and Ugur (2019).

    python -m experiments.seker FOLDER

FOLDER holds the files of https://doi.org/10.5281/zenodo.2556671: of lever-up k, images/k.jpg, in
grey, from above and turned to the lever, and trajectories/k.txt, with the object's x, y, z [m] and
three angles [rad] in each step. As in its authors' code, steps without motion are left out, and a
trajectory ends where the object slips: where it sinks, rises by 3 cm in a step, or turns by 0.4 rad
about z. The action is not recorded; its two channels are the share of the steps. Nor is depth: all
objects are seen as 5 cm high. We have tried this on files made in this format, not on theirs.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd
import torch
from PIL import Image

from affordlib.interactions import InteractionTensors, split_interactions
from affordlib.models.lever_up import LEVER_ACTION_CHANNELS, POSE_CHANNELS, window_errors_m
from affordlib.results import write_results
from affordlib.types import IMAGE_PIXELS, check_array, check_count
from experiments.commands import command
from experiments.lever_up import LEVER_MODELS, N_FOLDS, fit_lever_model

MODELS = ("cnp_tuned", "cnp_last_pose", "lstm_tuned")
N_STEPS = 26
MOVED_M, SLIPPED_M, SLIPPED_RAD = 1e-7**0.5, 0.03, 0.4
HEIGHT_M = 0.05


def poses_of(path: Path) -> np.ndarray:
    """Return the steps (n, 6) of a trajectory in which the object moves, until it slips."""
    steps = check_array(f"lines of {path}", np.genfromtxt(path, ndmin=2), 6)
    moves = np.diff(steps[:, :3], axis=0)
    slips = (moves[:, 2] < 0) | (moves[:, 2] > SLIPPED_M) | (abs(steps[1:, 5]) > SLIPPED_RAD)
    moved = np.linalg.norm(moves, axis=1) >= MOVED_M
    kept = moved & ~np.logical_or.accumulate(slips & moved)
    return np.vstack([steps[:1], steps[1:][kept]])


def seen_at(path: Path) -> np.ndarray:
    """Return depth [m] and mask (2, 48, 48) of a grey image: what is unlike its four corners."""
    grey = np.asarray(Image.open(path).convert("L").resize((128, 128))) > 127
    mask = (grey != (grey[::127, ::127].mean() > 0.5)).astype(np.uint8)
    small = Image.fromarray(255 * mask).resize((IMAGE_PIXELS, IMAGE_PIXELS), Image.Resampling.BOX)
    mask = np.asarray(small, dtype=np.float32) / 255
    return np.stack([1 - HEIGHT_M * mask, mask])


def lever_ups_in(folder: Path) -> InteractionTensors:
    """Read the lever-ups of at least `N_STEPS` steps, cut to as many."""
    paths = sorted((folder / "trajectories").glob("*.txt"), key=lambda path: int(path.stem))
    long = [(path.stem, poses) for path in paths if len(poses := poses_of(path)) >= N_STEPS]
    if len(long) < N_FOLDS * 2:
        raise ValueError(
            f"{folder} must hold images/1.jpg, trajectories/1.txt and so on, at least "
            f"{2 * N_FOLDS} of them of {N_STEPS} steps, got {len(long)}, and {len(paths)} in all"
        )
    images = np.stack([seen_at(folder / "images" / f"{name}.jpg") for name, _ in long])
    steps = np.stack([poses[:N_STEPS] for _, poses in long])
    tilt = np.arccos(np.clip(np.cos(steps[..., 3]) * np.cos(steps[..., 4]), -1, 1))
    effect = np.concatenate([steps[..., :3], tilt[..., None]], axis=-1)
    phase = torch.linspace(0, 1, N_STEPS)
    return InteractionTensors(
        image=torch.from_numpy(images),
        phase=phase,
        action=phase[None, :, None].repeat(len(long), 1, 2),
        effect=torch.from_numpy(effect - effect[:, :1]).float(),
        action_channels=LEVER_ACTION_CHANNELS,
        effect_channels=POSE_CHANNELS,
    )


@command(OSError, ValueError)
def main(argv: Sequence[str] | None = None) -> int:
    """Train and test in `--folds` of the five folds, and write seker.json into `--out-dir`."""
    parser = argparse.ArgumentParser(prog="python -m experiments.seker", description=main.__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--folds", type=int, default=N_FOLDS)
    parser.add_argument("--out-dir", default="runs")
    options = parser.parse_args(argv)
    lever_ups, rows = lever_ups_in(options.folder), []
    for fold in range(check_count("--folds", options.folds, 1, N_FOLDS)):
        split = split_interactions(len(lever_ups), 0, 2 * fold, 2 * N_FOLDS)
        rows_of = (split.train, split.validation, split.test)
        parts = [lever_ups.select(torch.from_numpy(part)) for part in rows_of]
        for name in MODELS:
            model, _ = fit_lever_model(LEVER_MODELS[name], *parts[:2], "window")
            error_cm = 100 * window_errors_m(model, parts[2]).mean(dim=(0, 1))
            steps = {f"step_{k}_mean_cm": float(e) for k, e in enumerate(error_cm, 1)}
            rows.append({"model": name, "fold": fold, "n": len(parts[2])} | steps)
            print(pd.DataFrame(rows[-1:]).to_string(index=False), flush=True)
    print(write_results(options.out_dir, "seker", {}, {"lever_up": rows}))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
