"""Exercises of notebooks 03 to 05: predictions, their σ, and queries."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import numpy as np
import torch

from affordlib.interactions import (
    InteractionTensors,
    condition_on_recorded_action,
    open_interactions,
    split_interactions,
)
from affordlib.models import coverage, load_checkpoint, network_predictions
from exercises.checking import Exercise, answer_of

# 03 The affordance network

N_PHASES = 61


@cache
@torch.no_grad()
def _marginals() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mean, σ and ground truth (50, 61, 2) [m] of the held-out pushes, given image and action."""
    pushes = open_interactions("push")
    held_out = split_interactions(pushes.sizes["interaction"]).test
    arrays = InteractionTensors.from_dataset(pushes, held_out)
    at = torch.linspace(0, len(arrays.phase) - 1, N_PHASES).round().long()
    model, _ = load_checkpoint("cnp_500")
    t_target = arrays.phases(at)
    query = condition_on_recorded_action(arrays)
    answer = model.predict(model.encode(arrays.image), query, t_target)
    return answer.effect_mean.numpy(), answer.effect_std.numpy(), arrays.effect[:, at].numpy()


def _length_m(paths: np.ndarray) -> np.ndarray:
    """Lengths (N,) of trajectories (N, n, 2)."""
    return np.hypot(*np.moveaxis(np.diff(paths, axis=1), -1, 0)).sum(axis=1)


def _drawn_length(
    draw: Callable[[np.ndarray, np.ndarray, np.random.Generator], np.ndarray],
) -> float:
    """How many times as long as the real trajectories those are that the reader draws."""
    mean, sigma, truth = _marginals()
    rng = np.random.default_rng(0)
    drawn = np.stack([answer_of(draw, m, s, rng) for m, s in zip(mean, sigma, strict=True)])
    if drawn.shape != mean.shape:
        raise ValueError(f"a trajectory has the shape {mean.shape[1:]}, got {drawn.shape[1:]}")
    spread = float(((drawn - mean) / sigma).std())
    if not 0.8 < spread < 1.2:
        raise ValueError(f"the draws spread by {spread:.2f} σ about the mean, not by 1 σ")
    return float(_length_m(drawn).mean() / _length_m(truth).mean())


# 04 Effect prediction


def _lopsided_mm(lopsided_m: Callable[..., float]) -> float:
    """By how much [mm] the paper's network fails to rotate with the table."""

    def by(name: str) -> float:
        model, _ = load_checkpoint(name)
        channels = model.action_channels, model.effect_channels
        some = InteractionTensors.from_dataset(
            open_interactions("push_test"), np.arange(200), *channels
        )
        return 1000 * float(answer_of(lopsided_m, model, some))

    ours = by("film_500")
    if abs(ours) > 0.01:
        raise ValueError(f"ours rotates with the table, so it should give 0 mm, got {ours:.3g} mm")
    return by("cnp_500")


@cache
def _predicted_ends() -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Ground truth, mean and σ (2, 1000) [m] of the final positions of `push_test`."""
    data = open_interactions("push_test")
    model, _ = load_checkpoint("film_500")
    answers = network_predictions(model, data, np.arange(data.sizes["interaction"]))
    truth, mean, std = (
        torch.tensor([answers[k][c] for c in "xy"]) for k in ("truth", "mean", "std")
    )
    return truth, mean, std


def _half_inside_percent(factor: float) -> float:
    truth, mean, std = _predicted_ends()
    return 100 * coverage(truth, mean, float(factor) * std, 0.5)


MODELS: dict[str, Exercise] = {
    "03.1": Exercise(
        "Measure how far [mm] the predicted mean is from an effect observed at t = 0.8.",
        lambda mine: mine,
        expected=1.38,
        within=0.04,
        unit="mm",
    ),
    "03.2": Exercise(
        "Write draw(mean, sigma, rng): one trajectory, every phase drawn from its own Gaussian.",
        _drawn_length,
        expected=3.6,
        within=0.3,
        unit="times the real length",
    ),
    "04.1": Exercise(
        "Write lopsided_m(model, arrays): the mean distance between final positions predicted on "
        "the rotated table, and final positions predicted first and rotated then.",
        _lopsided_mm,
        expected=1.86,
        within=0.05,
        unit="mm for the paper's network",
    ),
    "04.2": Exercise(
        "Find the factor on σ that puts half of the true ends into the central 50 % interval.",
        _half_inside_percent,
        expected=50.0,
        within=1.5,
        unit="% inside",
    ),
    "05.1": Exercise(
        "Measure the conditional network's error [cm] at the fifth step if it sees two poses only.",
        lambda mine: mine,
        expected=0.277,
        within=0.002,
        unit="cm",
    ),
    "05.2": Exercise(
        "Measure the recurrent network's error as a multiple of the conditional one's at the fifth "
        "step, if the observed poses have errors of 1 mm.",
        lambda mine: mine,
        expected=2.03,
        within=0.1,
        unit="times",
    ),
}
