"""Exercises of notebooks 03 to 05: predictions, their σ, and queries."""

from collections.abc import Callable

import numpy as np
import torch

from affordlib import interactions
from affordlib.interactions import InteractionTensors, open_interactions
from affordlib.models import coverage, load_checkpoint, network_predictions
from exercises.checking import answer_of, exercise


@exercise("03.1", 1.38, 0.04, "mm")
def from_observed(mm: float) -> float:
    """Measure how far [mm] the predicted mean is from an effect observed at t = 0.8.

    Give `Observations.of` the pair of phases and effects as `effect`, and no action.
    Compare the predicted x and y at the same phase; average the distances, in mm.
    """
    return mm


def _length_m(paths: np.ndarray) -> float:
    """The mean length of trajectories (N, n, 2)."""
    return np.linalg.norm(np.diff(paths, axis=1), axis=-1).sum(axis=1).mean()


@exercise("03.2", 3.6, 0.3, "times the real length")
@torch.no_grad()
def drawn_length(draw: Callable) -> float:
    """Write draw(mean, sigma, rng): one trajectory, every phase drawn from its own Gaussian.

    The draw has the shape of `mean`.
    rng.normal takes arrays of means and of standard deviations.
    """
    pushes = open_interactions("push")
    held_out = interactions.split_interactions(pushes.sizes["interaction"]).test
    arrays = InteractionTensors.from_dataset(pushes, held_out)
    at = torch.linspace(0, len(arrays.phase) - 1, 61).round().long()
    model, _ = load_checkpoint("cnp_500")
    query = interactions.condition_on_recorded_action(arrays)
    answer = model.predict(model.encode(arrays.image), query, arrays.phases(at))
    mean, sigma = answer.effect_mean.numpy(), answer.effect_std.numpy()
    rng = np.random.default_rng(0)
    drawn = np.stack([answer_of(draw, m, s, rng) for m, s in zip(mean, sigma, strict=True)])
    if drawn.shape != mean.shape:
        raise ValueError(f"a trajectory has the shape {mean.shape[1:]}, got {drawn.shape[1:]}")
    spread = ((drawn - mean) / sigma).std()
    if not 0.8 < spread < 1.2:
        raise ValueError(f"the draws spread by {spread:.2f} σ about the mean, not by 1 σ")
    return _length_m(drawn) / _length_m(arrays.effect[:, at].numpy())


@exercise("04.1", 1.86, 0.05, "mm for the paper's network")
def lopsided_mm(lopsided_m: Callable) -> float:
    """Write lopsided_m(model, arrays): the mean distance between final positions predicted on
    the rotated table, and final positions predicted first and rotated then.

    Both predictions need their own observations: those of the rotated arrays, and the first.
    A quarter turn counter-clockwise takes (x, y) to (-y, x).
    """
    data = open_interactions("push_test")
    for name in ("film_500", "cnp_500"):
        model, _ = load_checkpoint(name)
        channels = model.action_channels, model.effect_channels
        some = InteractionTensors.from_dataset(data, np.arange(200), *channels)
        mm = 1000 * float(answer_of(lopsided_m, model, some))
        if name == "film_500" and abs(mm) > 0.01:
            raise ValueError(
                f"ours rotates with the table, so it should give 0 mm, got {mm:.3g} mm"
            )
    return mm


@exercise("04.2", 50.0, 1.5, "% inside")
def half_inside(factor: float) -> float:
    """Find the factor on σ that puts half of the true ends into the central 50 % interval.

    The 50 % interval reaches to 0.674 of σ on each side.
    Which value of error over σ do half of the errors not exceed?
    """
    data = open_interactions("push_test")
    model, _ = load_checkpoint("film_500")
    answers = network_predictions(model, data, np.arange(data.sizes["interaction"]))
    keys = "truth", "mean", "std"
    truth, mean, std = (torch.tensor([answers[key][c] for c in "xy"]) for key in keys)
    return 100 * coverage(truth, mean, float(factor) * std, 0.5)


@exercise("05.1", 0.277, 0.002, "cm")
def from_two_poses(cm: float) -> float:
    """Measure the conditional network's error [cm] at the fifth step if it sees two poses only.

    The fifth step is the fifth pose after the last one that is shown.
    The last two of fifteen poses begin at `start + 13`.
    """
    return cm


@exercise("05.2", 2.03, 0.1, "times")
def recurrent_over_conditional(times: float) -> float:
    """Measure the recurrent network's error as a multiple of the conditional one's at the fifth
    step, if the observed poses have errors of 1 mm.

    Add the noise to what the networks see, before increments are computed.
    Divide the mean errors at the fifth step; the ground truth stays as it is.
    """
    return times
