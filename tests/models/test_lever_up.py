"""Lever-ups: tensors in the frame of the lever, sampling, what models see, shipped checkpoints."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from affordlib.interactions import Scaler, open_interactions
from affordlib.interactions.dataset import condition_on_poses
from affordlib.models import build, lever_up, load_checkpoint
from experiments import lever_up as experiment


def made(name, levered):
    torch.manual_seed(0)
    model = build(experiment.LEVER_MODELS[name].network, Scaler.fit(levered)).eval()
    model.prepare(levered)
    return model


@pytest.mark.parametrize("name", ["cnp_last_pose", "lstm_tuned", "cnp"])
def test_no_model_sees_what_it_has_to_foresee(name, levered):
    untrained = made(name, levered)
    for protocol, last in zip(lever_up.PROTOCOLS, (lever_up.N_OBSERVED - 1, 0, 0), strict=True):
        later = levered.effect.clone()
        later[:, last + 1 :] += 0.05
        found, _ = lever_up.predict_steps(untrained, levered, protocol)
        again, truth = lever_up.predict_steps(untrained, replace(levered, effect=later), protocol)
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
    lever = experiment.LEVER_MODELS[name]
    lever = replace(lever, training=replace(lever.training, **few))
    model, history = experiment.fit_lever_model(lever, levered, levered, kind)
    moves = levered.effect[:, 1:, :3].norm(dim=-1).mean()
    assert experiment.from_start_errors_m(model, levered).mean() < moves / 3
    assert len(history) == 2


def test_arrays_are_in_the_frame_of_the_lever(levers, levered):
    assert levered.effect.shape == (len(levered), 26, 4)
    assert levered.effect[:, 0].abs().max() == 0
    # Rotation preserves lengths, and objects move in the direction of the lever.
    kept = ~levers["fault"].values
    raw = levers["effect"].values[kept][:, ::12]
    moved_m = np.hypot(raw[..., 0], raw[..., 1])
    np.testing.assert_allclose(levered.effect[..., :2].norm(dim=-1), moved_m, atol=1e-6)
    assert levered.effect[:, -1, 0].min() > 0.02
    # The blade comes from behind the contact, slides 12 mm under, and never leaves its plane.
    assert levered.action[:, 0, 0].numpy() == pytest.approx(-0.03, abs=1e-5)
    assert levered.action[:, 7, 0].numpy() == pytest.approx(0.012, abs=1e-4)
    assert (levered.action[:, -1, 1] > 0.1 * math.sin(math.radians(65))).any()


def test_no_view_cuts_an_object_off(levers, levered):
    wide = lever_up.lever_up_tensors(levers, view="wide").image
    full = torch.from_numpy(levers.image.values)
    assert full.shape[-1] == 128
    assert levered.image.shape[-1] == wide.shape[-1] == 48
    area = full[:, 1].sum(dim=(1, 2)) / 128**2
    torch.testing.assert_close(4 * levered.image[:, 1].sum(dim=(1, 2)), full[:, 1].sum(dim=(1, 2)))
    torch.testing.assert_close(wide[:, 1].mean(dim=(1, 2)), area, rtol=0.02, atol=0)
    with pytest.raises(ValueError, match="view must be one of"):
        lever_up.lever_up_tensors(levers, view="far")


def test_windows_are_fifteen_steps_and_the_next_five(levered):
    generator = torch.Generator().manual_seed(0)
    assert lever_up.n_windows(levered) == 7
    lengths = lever_up.N_PREDICTED, lever_up.N_OBSERVED
    batch = experiment.sample_windows(levered, *lengths, generator)
    seen = (batch.observations.effect_t * 25).round()
    assert (seen.diff(dim=1) == 1).all()
    assert {int(s) for s in seen[:, 0]} == set(range(7))
    torch.testing.assert_close((batch.t_target[:, 0] * 25).round(), seen[:, -1] + 1)
    assert batch.observations.effect_mask.all()
    batches = [experiment.sample_from_start(levered, 0, 0, generator) for _ in range(20)]
    assert {bool(b.observations.effect_mask.any()) for b in batches} == {True, False}


@pytest.mark.parametrize("name", experiment.LEVER_CHECKPOINTS)
def test_shipped_checkpoints_predict_what_they_have_not_seen(name):
    whole = open_interactions("lever_up")
    model, about = load_checkpoint(name)
    split = experiment.lever_split(whole)
    assert not set(about["seen_interactions"]) & set(split.test)
    few = lever_up.lever_up_tensors(whole, split.test[:60], about["view"])
    if about["trained_for"] != "first_step":
        assert 100 * lever_up.window_errors_m(model, few).mean() < 0.3
    if about["trained_for"] != "window":
        assert 100 * experiment.from_start_errors_m(model, few).mean() < 0.4
