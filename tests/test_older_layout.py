"""Lever-ups in the older study's layout: a folder of poses and images."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image

from affordlib.interactions.import_log import read_trajectories, write_trajectories
from affordlib.interactions.lever_up import POSE_CHANNELS
from affordlib.models.lever import fit_lever_model, window_errors_m


@pytest.fixture
def older(tmp_path):
    """Two trajectories of 26 poses and their images."""
    poses, gray = np.zeros((2, 26, 6)), np.full((2, 128, 128), 0.8)
    poses[..., 0], poses[..., 4] = np.linspace(0.3, 0.4, 26), np.linspace(0, 1.0, 26)
    gray[:, 40:80, 64:100] = np.random.default_rng(0).uniform(0.2, 0.4, (2, 40, 36))
    write_trajectories(tmp_path, poses, gray)
    return tmp_path


def test_the_older_layout_is_read(older, short):
    arrays = read_trajectories(older)
    assert arrays.effect_channels == POSE_CHANNELS
    assert arrays.effect.shape == (2, 26, 4)
    torch.testing.assert_close(arrays.effect[0, -1], torch.tensor([0.1, 0.0, 0.0, 1.0]))
    assert arrays.image[:, 1].sum(dim=(1, 2)).tolist() == [40 * 36] * 2
    small = replace(arrays, image=torch.nn.functional.interpolate(arrays.image, (48, 48)))
    model, history = fit_lever_model(short("lstm_tuned"), small, small, "window", progress=False)
    assert len(history) == 2
    assert window_errors_m(model, small).shape == (2, 7, 5)


def test_other_lengths_of_the_older_layout_are_learned_from(tmp_path, short):
    poses, gray = np.zeros((20, 41, 6)), np.full((20, 128, 128), 0.8)
    poses[..., 2] = np.linspace(0.0, 0.2, 41)
    gray[:, 40:80, 64:100] = np.random.default_rng(1).uniform(0.2, 0.4, (20, 40, 36))
    write_trajectories(tmp_path / "long", poses, gray)
    arrays = read_trajectories(tmp_path / "long", view="wide")
    assert arrays.image.shape == (20, 2, 48, 48)
    for name, kind in (("anchored", "all"), ("lstm_tuned", "window")):
        model, _ = fit_lever_model(short(name), arrays, arrays, kind, progress=False)
        assert window_errors_m(model, arrays).shape == (20, 41 - 19, 5)


@pytest.mark.parametrize(
    ("spoil", "reason"),
    [
        (lambda f: (f / "images" / "0001.png").unlink(), "no image 0001.png"),
        (lambda f: (f / "trajectories" / "0001.txt").write_text("1 2 3\n"), "six finite numbers"),
        (
            lambda f: (f / "trajectories" / "0001.txt").write_text("1 2 x 4 5 6\n"),
            "0001.txt: every row",
        ),
        (lambda f: (f / "trajectories" / "0001.txt").write_text("0 0 0 0 0 0\n"), "has 1 rows"),
        (lambda f: [p.unlink() for p in (f / "trajectories").iterdir()], "no file trajectories"),
        (lambda f: Image.new("L", (9, 9)).save(f / "images" / "0001.png"), "must be 128×128"),
    ],
)
def test_what_is_wrong_with_a_folder_is_said(older, spoil, reason):
    spoil(older)
    with pytest.raises((ValueError, FileNotFoundError), match=reason):
        read_trajectories(older)
