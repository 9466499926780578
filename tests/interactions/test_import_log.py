"""Import of a user's own interactions, from a folder with a table and images."""

import re

import numpy as np
import pandas as pd
import pytest
import torch
from PIL import Image

from affordlib.interactions import InteractionTensors
from affordlib.interactions.import_log import TABLE, read_folder, write_folder
from affordlib.models.training import final_errors_m

CHANNELS = ("x", "y"), ("x", "y", "yaw")


@pytest.fixture
def some(pushes):
    return InteractionTensors.from_dataset(pushes, np.arange(3), *CHANNELS)


@pytest.fixture
def folder(some, tmp_path):
    return write_folder(tmp_path / "mine", some)


def test_what_was_written_is_read_again(some, folder):
    back = read_folder(folder, n_samples=301)
    assert (back.action_channels, back.effect_channels) == CHANNELS
    torch.testing.assert_close(back.effect, some.effect, atol=1e-6, rtol=0)
    torch.testing.assert_close(back.action, some.action, atol=1e-6, rtol=0)
    torch.testing.assert_close(back.image[:, 0], some.image[:, 0], atol=0.6e-4, rtol=0)
    torch.testing.assert_close(back.image[:, 1], some.image[:, 1], atol=0.003, rtol=0)


def test_a_network_predicts_the_same_from_the_folder(film, some, folder):
    """The order of columns does not matter."""
    table = pd.read_csv(folder / TABLE, dtype={"interaction": str})
    table[sorted(table, reverse=True)].to_csv(folder / TABLE, index=False)
    ours, theirs = (final_errors_m(film, a) for a in (some, read_folder(folder, 301)))
    torch.testing.assert_close(ours, theirs, atol=2e-4, rtol=0)


def test_trajectories_of_any_length_are_brought_to_the_same_phases(folder):
    rows = (folder / TABLE).read_text().splitlines()
    thinned = rows[:1] + [r for k, r in enumerate(rows[1:]) if k % 301 in (0, 150, 300)]
    (folder / TABLE).write_text("\n".join(thinned))
    assert read_folder(folder, n_samples=21).effect.shape == (3, 21, 3)


def test_without_a_mask_what_is_high_is_the_object(some, folder):
    for path in (folder / "images").glob("*_mask.png"):
        path.unlink()
    mask = read_folder(folder).image[:, 1]
    assert ((mask > 0.5) == (some.image[:, 1] > 0.5)).float().mean() > 0.98


def _replace(folder, old, new):
    text = (folder / TABLE).read_text()
    assert old in text
    (folder / TABLE).write_text(text.replace(old, new, 1))


@pytest.mark.parametrize(
    ("spoil", "says"),
    [
        (lambda f: (f / TABLE).unlink(), r"there is no .*trajectories\.csv; write a"),
        (lambda f: (f / "images" / "0001.png").unlink(), r"no image .*0001\.png"),
        (
            lambda f: _replace(f, "action_x", "action_q"),
            r"action are \['action_q', 'action_y'\]; choose from",
        ),
        (lambda f: _replace(f, "interaction", "object"), r"column 'interaction' is missing"),
        (lambda f: _replace(f, "0001,0.0,", "0001,0.5,"), r"t of interaction '0001' must increase"),
        (lambda f: _replace(f, "0000,0.0,", "0000,zero,"), r"\.csv: .* 't' .* line 2 has 'zero'"),
        (lambda f: _replace(f, "0001,0.0,", "0001,,"), r"column 't' .* line 303 has 'nan'"),
        (lambda f: _replace(f, "0001,0.0,", "0001,0.0,0,"), r"\.csv is not a table .* line 303,"),
        (lambda f: (f / TABLE).write_text(""), r"\.csv is not a table"),
        (lambda f: (f / "images/0001.png").write_bytes(b"\x89PNG"), r"0001\.png is damaged"),
        (
            lambda f: Image.fromarray(np.zeros((48, 48), np.uint8)).save(f / "images" / "0002.png"),
            r"0002\.png must hold depth in 16 bits",
        ),
        (
            lambda f: Image.fromarray(np.ones((48, 48), np.uint8)).save(f / "images/0001_mask.png"),
            r"0001_mask\.png must .* white .* at most 1$",
        ),
        (
            lambda f: Image.fromarray(np.ones((48, 48), bool)).save(f / "images/0001_mask.png"),
            r"0001_mask\.png must .*bool",
        ),
    ],
)
def test_errors_say_what_and_where(folder, spoil, says):
    spoil(folder)
    with pytest.raises((ValueError, FileNotFoundError), match=says):
        read_folder(folder)


def test_names_are_names_and_angles_go_around(some, folder):
    text = (folder / TABLE).read_text()
    (folder / TABLE).write_text(re.sub("^0001,", "NA,", text, flags=re.MULTILINE))
    for kind in ("", "_mask"):
        (folder / "images" / f"0001{kind}.png").rename(folder / "images" / f"NA{kind}.png")
    assert len(read_folder(folder)) == 3
    table = pd.read_csv(folder / TABLE, keep_default_na=False)
    turned = table["effect_yaw"] + np.pi - 0.01  # beyond ±π, as from atan2
    table["effect_yaw"] = np.arctan2(np.sin(turned), np.cos(turned))
    table.to_csv(folder / TABLE, index=False)
    yaw = read_folder(folder, n_samples=301).effect[..., 2]
    expected = some.effect[..., 2] + np.pi - 0.01
    torch.testing.assert_close(yaw, expected, atol=1e-5, rtol=0)
