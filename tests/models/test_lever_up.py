"""Lever-ups: tensors in the frame of the lever, information available to models."""

from dataclasses import replace

import pytest
import torch

from affordlib.interactions import Scaler
from affordlib.interactions.dataset import condition_on_poses
from affordlib.models import build
from affordlib.models.lever_up import N_OBSERVED, PROTOCOLS, predict_steps
from experiments.lever_training import LEVER_MODELS, fit_lever_model, from_start_errors_m


def made(name, levered):
    torch.manual_seed(0)
    model = build(LEVER_MODELS[name].network, Scaler.fit(levered)).eval()
    model.prepare(levered)
    return model


@pytest.mark.parametrize("name", ["cnp_last_pose", "lstm_tuned", "cnp"])
def test_no_model_sees_what_it_has_to_foresee(name, levered):
    """Changes after the observed steps do not affect predictions."""
    untrained = made(name, levered)
    for protocol, last in zip(PROTOCOLS, (N_OBSERVED - 1, 0, 0), strict=True):
        later = levered.effect.clone()
        later[:, last + 1 :] += 0.05
        found, _ = predict_steps(untrained, levered, protocol)
        again, truth = predict_steps(untrained, replace(levered, effect=later), protocol)
        torch.testing.assert_close(found.effect_mean, again.effect_mean)
        assert truth.shape == found.effect_mean.shape == found.effect_std.shape


def test_an_anchored_network_begins_where_the_object_is(levered):
    model = made("cnp_last_pose", levered)
    seen = condition_on_poses(levered, torch.zeros(len(levered), dtype=torch.long), 10)
    t = levered.phase[[9]].expand(len(levered), -1)
    with torch.no_grad():
        found = model.predict(model.encode(levered.image), seen, t)
    torch.testing.assert_close(found.effect_mean[:, 0], levered.effect[:, 9], atol=1e-5, rtol=0)


def test_a_rollout_does_not_depend_on_how_far_it_is_asked(levered):
    model = made("lstm_tuned", levered)
    torch.nn.init.normal_(model.last[-1].weight, std=0.02)
    seen = condition_on_poses(levered, torch.zeros(len(levered), dtype=torch.long), 5)
    ask = levered.phase[[5, 12, 25]].expand(len(levered), -1)
    with torch.no_grad():
        features, step = model.encode(levered.image), levered.phase[5]
        at = ask, ask[:, :1], 0 * ask[:, :1] + step + 0.02, 0 * ask[:, :1] + 6 / 25
        whole, near, between, next_one = (model.predict(features, seen, t) for t in at)
    torch.testing.assert_close(whole.effect_mean[:, :1], near.effect_mean)
    middle = (near.effect_mean + next_one.effect_mean) / 2
    torch.testing.assert_close(between.effect_mean, middle, atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize(("name", "kind"), [("cnp_last_pose", "all"), ("lstm_tuned", "first_step")])
def test_training_learns(levered, name, kind):
    few = {"steps": 60, "batch_size": 16, "validate_every": 30, "ema": 0.0}
    lever = LEVER_MODELS[name]
    lever = replace(lever, training=replace(lever.training, **few))
    model, history = fit_lever_model(lever, levered, levered, kind)
    moves = levered.effect[:, 1:, :3].norm(dim=-1).mean()
    assert from_start_errors_m(model, levered).mean() < moves / 3
    assert len(history) == 2
