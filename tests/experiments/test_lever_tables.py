"""Lever-ups: shipped checkpoints."""

import pytest

from affordlib.interactions import open_interactions
from affordlib.models import load_checkpoint
from affordlib.models.lever_up import lever_up_tensors, window_errors_m
from experiments.lever_training import LEVER_CHECKPOINTS, from_start_errors_m
from experiments.lever_up import lever_split


@pytest.mark.parametrize("name", LEVER_CHECKPOINTS)
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
