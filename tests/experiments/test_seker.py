"""Tests of the reader of the paper's own lever-ups, on files made in their format."""

import json
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image, ImageDraw

from experiments import seker

N, TILT_RAD = 40, np.concatenate([np.zeros(5), np.linspace(0, 0.8, 70)])  # at first nothing moves


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Bars that are tilted about y, seen in pixels of 1 mm; every tenth one slips after 10."""
    root, rng = tmp_path_factory.mktemp("lever_ups"), np.random.default_rng(0)
    for name in ("images", "trajectories"):
        (root / name).mkdir()
    for k in range(1, N + 1):
        half_mm = int(rng.integers(35, 75))
        picture = Image.new("L", (256, 256), 230)
        ImageDraw.Draw(picture).rectangle((128 - half_mm, 100, 127 + half_mm, 139), fill=20)
        picture.save(root / "images" / f"{k}.jpg")
        x, z = half_mm / 1000 * np.array([np.cos(TILT_RAD) - 1, np.sin(TILT_RAD)])
        steps = np.column_stack([x, 0 * x, 0.02 + z, 0 * x, TILT_RAD, 0 * x])
        steps[15 if k % 10 == 0 else 75 :, 2] -= 0.01
        np.savetxt(root / "trajectories" / f"{k}.txt", steps)
    return root


def test_motion_until_a_slip_becomes_tensors_of_the_book(folder):
    kept, slipped = (seker.poses_of(folder / "trajectories" / f"{k}.txt") for k in (1, 10))
    assert (len(kept), len(slipped)) == (70, 10)
    tensors = seker.lever_ups_in(folder)
    assert tensors.effect.shape == (N - 4, 26, 4)
    pixels = 256**2 * tensors.image[:, 1].mean(dim=(1, 2))
    last = TILT_RAD[30]
    half_mm = 1000 * tensors.effect[:, -1, 2] / np.sin(last)
    np.testing.assert_allclose(pixels / 80, half_mm, rtol=0.07)  # a pixel more on each side
    np.testing.assert_allclose(tensors.image[:, 0], 1 - 0.05 * tensors.image[:, 1], atol=1e-6)
    np.testing.assert_allclose(tensors.effect[:, -1, 3], last, rtol=1e-5)


def test_the_networks_of_table_1_are_compared(folder, tmp_path, monkeypatch):
    for name in seker.MODELS:
        lever = seker.LEVER_MODELS[name]
        few = replace(lever, training=replace(lever.training, steps=4, validate_every=2))
        monkeypatch.setitem(seker.LEVER_MODELS, name, few)
    assert seker.main([str(folder), "--folds", "1", "--out-dir", str(tmp_path)]) == 0
    rows = json.loads((tmp_path / "seker.json").read_text())["tables"]["lever_up"]
    assert [row["model"] for row in rows] == [*seker.MODELS]


def test_files_in_another_format_are_named(tmp_path, capsys):
    assert seker.main([str(tmp_path)]) == 1
    assert "images/1.jpg" in capsys.readouterr().err
    for text in ("1 2 3\n", "1 2 3 4 5 nan\n", "a b\n"):
        (tmp_path / "7.txt").write_text(text)
        with pytest.raises(ValueError, match=r"7\.txt must be finite numbers of shape"):
            seker.poses_of(tmp_path / "7.txt")
