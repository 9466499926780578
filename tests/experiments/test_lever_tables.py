"""Lever-ups: baselines, jobs, tables made from their results, and shipped files."""

import pytest
import torch

from affordlib.interactions import open_interactions
from affordlib.models import load_checkpoint
from affordlib.models.lever_up import lever_up_tensors, window_errors_m
from affordlib.results import repo_root
from experiments.lever_training import from_start_errors_m
from experiments.lever_up import extrapolate, lever_split


def test_baselines_are_right_about_what_they_assume():
    steps = torch.arange(26.0)[None, :, None]
    still, steady = torch.ones(1, 26, 4), steps.expand(1, 26, 4)
    for baseline, trajectory in (("persistence", still), ("constant_velocity", steady)):
        mean, truth = extrapolate(baseline, trajectory, "window", 3)
        torch.testing.assert_close(mean, truth)
    mean, truth = extrapolate("persistence", steady, "window", 0)
    assert (truth - mean)[0, :, 0].tolist() == [1, 2, 3, 4, 5]
    mean, truth = extrapolate("constant_velocity", steady, "first_step")
    assert mean.abs().max() == 0
    assert truth.shape[1] == 25


@pytest.mark.parametrize(
    "name",
    ["lever_up_last_pose_1800", "lever_up_lstm_1800_window", "lever_up_lstm_1800_first_step"],
)
def test_shipped_checkpoints_predict_what_they_have_not_seen(name):
    whole = open_interactions("lever_up")
    model, about = load_checkpoint(name)
    split = lever_split(whole)
    assert not set(about["seen_interactions"]) & set(split.test)
    few = lever_up_tensors(whole, split.test[:60], about["view"])
    if about["trained_for"] != "first_step":
        assert 100 * window_errors_m(model, few).mean() < 0.3
    if about["trained_for"] != "window":
        assert 100 * from_start_errors_m(model, few).mean() < 0.4
    size = (repo_root() / "data" / "checkpoints" / f"{name}.safetensors").stat().st_size
    assert size < 5e6
