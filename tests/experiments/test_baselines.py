"""Evaluation of predictions: errors, calibration, baselines, table rows."""

import math

import numpy as np
import pandas as pd
import pytest
import torch

from affordlib.interactions import InteractionTensors
from affordlib.models import final_error, final_errors_m, network_predictions
from experiments.baselines import constant, gaussian_process, nearest, network_record
from experiments.cross_validation import add_errors


def test_answers_are_those_of_the_model_itself(trained, held_out_pushes):
    some = np.arange(5)
    found = network_record(trained, held_out_pushes, some)
    arrays = InteractionTensors.from_dataset(held_out_pushes, some)
    expected = final_errors_m(trained, arrays)
    torch.testing.assert_close(torch.tensor(final_error(found)).float(), expected)
    short = network_predictions(trained, held_out_pushes, some)
    np.testing.assert_allclose(final_error(short), final_error(found), atol=1e-7)
    one = {part: {"x": short[part]["x"]} for part in ("mean", "truth")}
    assert final_error(one) == pytest.approx(np.abs(np.subtract(*[v["x"] for v in one.values()])))
    assert found["interaction"] == some.tolist()
    assert (np.array(found["trajectory_error"]) < final_error(found)).mean() > 0.5


def test_a_turn_is_measured_the_short_way_round():
    found = pd.DataFrame({"truth_yaw": [3.1, 0.2], "mean_yaw": [-3.1, 0.1]})
    add_errors(found, "rotate")
    np.testing.assert_allclose(found["yaw_error"], [2 * math.pi - 6.2, 0.1])


def test_baselines_know_the_direction_and_recover_a_law_of_size():
    generator = torch.Generator().manual_seed(0)
    theta, size = (torch.rand(60, generator=generator) for _ in range(2))
    theta = 2 * math.pi * theta
    out = torch.stack([theta.cos(), theta.sin()], dim=-1)
    action = torch.stack([-0.2 * out, 0.05 * out], dim=1)
    effect = torch.stack([0 * out, (0.05 + 0.02 * size[:, None]) * out], dim=1)
    phase, image = torch.tensor([0.0, 1.0]), torch.zeros(60, 2, 4, 4)
    arrays = InteractionTensors(image, phase, action, effect, ("x", "y"), ("x", "y"))
    train, test, at = arrays.select(slice(0, 40)), arrays.select(slice(40, 60)), torch.tensor([1])
    known, queried = 3 * size[:40, None], 3 * size[40:, None]
    off = {}
    for baseline in (constant, nearest, gaussian_process):
        mean, std = baseline(train, test, at, known, queried)
        off[baseline] = float((mean[:, 0] - test.effect[:, 1]).norm(dim=-1).mean())
        assert mean.shape == std.shape == (20, 1, 2)
    length = 0.05 + 0.02 * size
    expected = (length[40:] - length[:40].mean()).abs().mean()
    assert off[constant] == pytest.approx(float(expected), rel=1e-4)
    assert off[nearest] < off[constant] / 5
    assert off[gaussian_process] < off[constant] / 20
