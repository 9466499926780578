"""Recurrent networks: for pushes, and the earlier study's as published."""

import numpy as np
import pytest
import torch

from affordlib.interactions import InteractionTensors, Scaler
from affordlib.interactions.sampling import condition_on_poses
from affordlib.models import build
from affordlib.models.lever_up import N_OBSERVED, from_start_errors_m, window_errors_m
from experiments.lstm import LSTMConfig
from experiments.lstm_seker2019 import SekerConfig, SekerLSTM, train_seker


def test_the_published_network_is_the_published_one(levered):
    config = SekerConfig(levered.action_channels, levered.effect_channels)
    torch.manual_seed(0)
    model = SekerLSTM(config, Scaler.fit(levered))
    total = sum(p.numel() for p in model.parameters())
    assert 71e6 < total < 73e6
    assert [m.out_channels for m in model.cnn if hasattr(m, "out_channels")] == [32, 64, 128, 256]


@pytest.fixture
def small_published(levered, monkeypatch):
    from experiments import lstm_seker2019

    monkeypatch.setattr(lstm_seker2019, "CONVOLUTION_WIDTHS", (2, 2, 2, 2))
    monkeypatch.setattr(lstm_seker2019, "LEVER_IMAGE_PIXELS", 48)
    monkeypatch.setattr(lstm_seker2019, "DENSE", 8)

    def make():
        torch.manual_seed(0)
        config = SekerConfig(levered.action_channels, levered.effect_channels)
        return SekerLSTM(config, Scaler.fit(levered))

    return make


def test_its_recurrence_is_that_of_features_repeated_and_concatenated(levered, small_published):
    model, start = small_published().eval(), torch.zeros(len(levered), dtype=torch.long)
    lstm = torch.nn.LSTM(model.lstm.input_size, model.lstm.hidden_size, batch_first=True)
    lstm.load_state_dict({f"{k}_l0": v for k, v in model.lstm.state_dict().items()})
    pose = (levered.effect / model.effect_scale)[:, : N_OBSERVED + 1]
    ends = (levered.action[:, [0, -1]] / model.action_scale).flatten(1)
    again = [model.encode(levered.image), pose[:, 0], ends]
    told = torch.cat([x[:, None].expand(-1, N_OBSERVED, -1) for x in again], dim=-1)
    told[:, :, 8 : -ends.shape[1]] = pose[:, :-1]
    phase = (torch.arange(N_OBSERVED) / model.config.steps).expand(len(levered), -1)[..., None]
    out, _ = lstm(torch.cat([told, phase], dim=-1))
    expected = torch.nn.functional.mse_loss(model.next_pose(out), pose[:, 1:])
    torch.testing.assert_close(model.next_step_loss(levered, start, N_OBSERVED), expected)


@torch.no_grad()
def test_a_row_alone_is_predicted_as_beside_one_that_has_observed_less(levered, small_published):
    model, two = small_published().eval(), levered.select(torch.arange(2))
    seen = condition_on_poses(two, torch.tensor([3, 0]), N_OBSERVED)
    seen.effect_mask[1, 1:] = False
    t_target = torch.tensor([[0.4, 0.72, 1.0]]).expand(2, -1)
    features = model.encode(two.image)
    together = model.predict(features, seen, t_target).effect_mean
    for row, n in ((0, N_OBSERVED), (1, 1)):
        one = condition_on_poses(two.select(torch.tensor([row])), torch.tensor([3 - 3 * row]), n)
        alone = model.predict(features[[row]], one, t_target[:1]).effect_mean
        torch.testing.assert_close(together[[row]], alone, atol=1e-6, rtol=1e-5)


def test_a_published_training_goes_on_where_it_was_broken_off(tmp_path, levered, small_published):
    def train(epochs, file):
        model = small_published()
        told = train_seker(model, levered, levered, "window", epochs, checkpoint=file)
        return model, told

    whole, told = train(3, None)
    train(2, tmp_path / "half.pt")
    again, resumed = train(3, tmp_path / "half.pt")
    assert told["validation_error"] == resumed["validation_error"]
    for a, b in zip(whole.parameters(), again.parameters(), strict=True):
        torch.testing.assert_close(a, b, atol=0, rtol=0)
    assert window_errors_m(whole, levered).shape == (len(levered), 7, 5)
    assert from_start_errors_m(whole, levered).shape == (len(levered), 25)


def test_the_course_of_pushes_is_that_seen_from_behind(pushes):
    few = InteractionTensors.from_dataset(pushes, np.arange(60), ("x", "y"), ("x", "y", "yaw"))
    config = LSTMConfig(effect_channels=("x", "y", "yaw"), frame="push", width=16)
    model = build(config, Scaler.fit(few))
    model.prepare(few)
    mean = model.mean_trajectory.values * model.effect_scale
    assert mean.shape == (26, 3)
    torch.testing.assert_close(mean[:, 1:], torch.zeros(26, 2), atol=1e-6, rtol=0)
    length = float(few.effect[:, -1, :2].norm(dim=-1).mean())
    assert float(mean[-1, 0]) == pytest.approx(length, rel=0.2)
