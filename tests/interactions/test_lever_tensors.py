"""Lever-ups as tensors in the frame of the lever, and sampling from them."""

import math

import numpy as np
import pytest
import torch

from affordlib.models.lever_up import N_OBSERVED, N_PREDICTED, lever_up_tensors, n_windows
from experiments.lever_training import sample_from_start, sample_windows


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
    wide, full = lever_up_tensors(levers, view="wide").image, torch.from_numpy(levers.image.values)
    assert full.shape[-1] == 128
    assert levered.image.shape[-1] == wide.shape[-1] == 48
    area = full[:, 1].sum(dim=(1, 2)) / 128**2
    torch.testing.assert_close(4 * levered.image[:, 1].sum(dim=(1, 2)), full[:, 1].sum(dim=(1, 2)))
    torch.testing.assert_close(wide[:, 1].mean(dim=(1, 2)), area, rtol=0.02, atol=0)
    with pytest.raises(ValueError, match="view must be one of"):
        lever_up_tensors(levers, view="far")


def test_windows_are_fifteen_steps_and_the_next_five(levered):
    generator = torch.Generator().manual_seed(0)
    assert n_windows(levered) == 7
    batch = sample_windows(levered, N_PREDICTED, N_OBSERVED, generator)
    seen = (batch.observations.effect_t * 25).round()
    assert (seen.diff(dim=1) == 1).all()
    assert {int(s) for s in seen[:, 0]} == set(range(7))
    torch.testing.assert_close((batch.t_target[:, 0] * 25).round(), seen[:, -1] + 1)
    assert batch.observations.effect_mask.all()
    batches = [sample_from_start(levered, 0, 0, generator) for _ in range(20)]
    assert {bool(b.observations.effect_mask.any()) for b in batches} == {True, False}
