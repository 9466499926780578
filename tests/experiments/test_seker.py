"""Tests of the reader of the paper's own lever-ups, on files made in their format."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image, ImageDraw

from experiments import seker

N = 40


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Polygons that are tilted about y, as high as they are long; every tenth one slips."""
    root, rng = tmp_path_factory.mktemp("lever_ups"), np.random.default_rng(0)
    for name in ("images", "trajectories"):
        (root / name).mkdir()
    for k in range(1, N + 1):
        length = rng.uniform(0.1, 0.2)
        picture = Image.new("L", (160, 160), 230)
        half = int(300 * length)
        ImageDraw.Draw(picture).rectangle((80 - half, 60, 80 + half, 100), fill=20)
        picture.save(root / "images" / f"{k}.jpg")
        tilt = np.concatenate([np.zeros(5), np.linspace(0, 0.8, 70)])  # at first nothing moves
        x, z = -length / 2 * (1 - np.cos(tilt)), length / 2 * np.sin(tilt)
        steps = np.column_stack([x, 0 * x, 0.02 + z, 0 * x, tilt, 0 * x])
        if k % 10 == 0:
            steps[15:, 2] -= 0.01
        np.savetxt(root / "trajectories" / f"{k}.txt", steps)
    return root


def test_steps_without_motion_and_after_a_slip_are_left_out(folder):
    kept, slipped = (seker.poses_of(folder / "trajectories" / f"{k}.txt") for k in (1, 10))
    assert (len(kept), len(slipped)) == (70, 10)
    assert (np.diff(kept[:, 2]) > 0).all()


def test_they_become_tensors_of_the_book(folder):
    tensors = seker.lever_ups_in(folder)
    assert len(tensors) == N - 4
    assert tensors.effect.shape == (N - 4, 26, 4)
    dark = tensors.image[:, 1].mean(dim=(1, 2))
    long_m = tensors.effect[:, -1, 2] / np.sin(0.8 * 25 / 69) * 2
    np.testing.assert_allclose(dark * 160 * 160 / 41 / 600, long_m, atol=0.006)
    assert (tensors.image[:, 0] - (1 - 0.05 * tensors.image[:, 1])).abs().max() < 1e-6
    torch.testing.assert_close(tensors.effect[:, -1, 3], torch.full((N - 4,), 0.8 * 25 / 69))


def test_the_networks_of_table_1_are_compared(folder, tmp_path, monkeypatch, capsys):
    for name in seker.MODELS:
        lever = seker.LEVER_MODELS[name]
        few = replace(lever, training=replace(lever.training, steps=4, validate_every=2))
        monkeypatch.setitem(seker.LEVER_MODELS, name, few)
    assert seker.main([str(folder), "--folds", "1", "--out-dir", str(tmp_path)]) == 0
    assert len(json.loads((tmp_path / "seker.json").read_text())["tables"]["lever_up"]) == 3
    printed = capsys.readouterr().out
    assert all(name in printed for name in seker.MODELS)


@pytest.mark.parametrize("text", ["1 2 3\n", "1 2 3 4 5 nan\n", "a b\n"])
def test_a_trajectory_in_another_format_is_refused(text, tmp_path):
    (tmp_path / "7.txt").write_text(text)
    with pytest.raises(ValueError, match="must hold six"):
        seker.poses_of(tmp_path / "7.txt")


def test_a_folder_without_them_is_named(tmp_path, capsys):
    assert seker.main([str(tmp_path)]) == 1
    assert "images/1.jpg" in capsys.readouterr().err
