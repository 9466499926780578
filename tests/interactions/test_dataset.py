"""Data sets: shipped files, refusal of damaged ones, splits, scaling and sampling."""

import os
import shutil
import zipfile

import numpy as np
import pytest
import torch

from affordlib import interactions, results
from affordlib.interactions.dataset import condition_on_recorded_action, sample_mixed
from affordlib.interactions.recipes import RECIPES, Recipe, interact
from affordlib.interactions.store import dataset_sha256, stored_sha256, write_interactions
from affordlib.models.checkpoint import load_state
from affordlib.results import read_results, repo_root


@pytest.fixture(scope="module", params=list(RECIPES))
def shipped(request):
    return request.param, interactions.open_interactions(request.param)


def test_the_shipped_sets_are_what_their_recipes_say(shipped, world):
    name, data = shipped
    recipe = RECIPES[name]
    assert Recipe.from_json(data.attrs["recipe"]) == recipe
    assert data.attrs["recipe"] == recipe.to_json()
    assert data.sizes["interaction"] == recipe.n_interactions
    assert data.sizes["sample"] == 301
    assert np.isfinite(data["effect"].values).all()
    for index in (0, 77):
        obj, seen = interact(recipe, index, world)
        stored = data.isel(interaction=index)
        # Results are bit-identical on one machine only; other processors round differently.
        gap = np.abs(stored["effect"].values[:, :2] - seen.effect[:, :2]).max()
        assert gap < 0.001
        assert stored["size"].values[2] == pytest.approx(obj.height_m, abs=2e-6)
        assert bool(stored["success"]) == seen.success


def test_few_interactions_are_flagged_and_all_say_why(shipped):
    name, data = shipped
    reasons = (data["tracking_error"] > 0.002) | (data["penetration"] > 0.002)
    np.testing.assert_array_equal(data["fault"].values, reasons.values)
    assert data["fault"].values.mean() < 0.05
    assert not data["effect"].values[~data["reached"].values].any()
    assert data["reached"].values.all() or name == "reach"


def test_the_tool_was_where_the_action_says(shipped):
    """Measured every 150 ms, as in the paper; a guarded hand may have stopped above its target."""
    name, data = shipped
    ok = data["reached"].values & ~data["fault"].values
    commanded = data["action"].values[ok][:, ::12, :3]
    measured = data["tool"].values[ok][:, :, :3]
    if name == "push_varied":  # its gripper moves higher than commanded, by an amount it measures
        commanded, measured = commanded[..., :2], measured[..., :2]
    off = measured - commanded
    if name == "grasp":
        assert off[..., 2].max() > 0.01
        off[..., 2] = np.minimum(off[..., 2], 0)
    # The waypoints of a very short action are further apart than its samples.
    assert np.linalg.norm(off, axis=-1).max() < (0.003 if name == "partial" else 0.002)


def test_shipped_files_are_small_and_complete(pushes):
    data = repo_root() / "data"
    larger = set(data.glob("*_x10.zarr.zip"))  # collected on demand
    sets = set(data.glob("*.zarr.zip")) - larger
    assert {p.name for p in sets} == {f"{n}.zarr.zip" for n in RECIPES}
    assert sum(p.stat().st_size for p in sets) < 40e6
    # With checkpoints and results.
    files = {p for p in data.rglob("*") if p.is_file()} - larger
    assert sum(p.stat().st_size for p in files) < 77e6
    assert not list(data.glob(".*"))
    assert pushes["effect"].attrs["units"] == "m, rad"
    assert "pybullet=" in pushes.attrs["versions"]
    assert stored_sha256("push") == dataset_sha256(pushes)


def test_whatever_is_damaged_or_missing_is_named(tmp_path):
    path, rng = tmp_path / "set.zarr.zip", np.random.default_rng(0)
    write_interactions(interactions.open_interactions("rotate").isel(interaction=slice(2)), path)
    whole, expected = path.read_bytes(), dataset_sha256(interactions.open_interactions(path))
    with zipfile.ZipFile(path) as archive:
        files = {name: archive.read(name) for name in archive.namelist()}
    for name, content in files.items():
        damaged = bytearray(content)
        damaged[rng.integers(len(content))] ^= 1 << int(rng.integers(8))
        for changed in (None, b"{}" if name == "manifest.json" else bytes(damaged)):
            with zipfile.ZipFile(path, "w") as archive:
                for other, stored in (files | {name: changed}).items():
                    if stored is not None:
                        archive.writestr(other, stored)
            with pytest.raises(interactions.CorruptedDataError, match=f"{name}.*again"):
                interactions.open_interactions(path)
    caught = 0
    for position in rng.integers(0, len(whole), 40):
        damaged = bytearray(whole)
        damaged[position] ^= 1 << int(rng.integers(8))
        path.write_bytes(damaged)
        try:  # a flip in the zip's padding or times harms nothing
            assert dataset_sha256(interactions.open_interactions(path)) == expected
        except interactions.CorruptedDataError:
            caught += 1
    assert caught >= 30


def test_splits_and_folds():
    folds = [interactions.split_interactions(500, seed=3, fold=k) for k in range(10)]
    assert sorted(np.concatenate([f.test for f in folds])) == list(range(500))
    for split in folds:
        parts = [split.train, split.validation, split.test]
        assert [len(p) for p in parts] == [400, 50, 50]
        assert len(np.unique(np.concatenate(parts))) == 500
    assert not np.array_equal(folds[0].test, interactions.split_interactions(500, seed=4).test)


@pytest.mark.parametrize(("quarters", "mirror"), [(1, False), (2, False), (1, True), (3, True)])
def test_image_action_and_effect_rotate_alike(pushes, quarters, mirror):
    """A mark drawn at the object's final position keeps its place in the rotated image."""
    arrays = interactions.InteractionTensors.from_dataset(pushes, np.arange(4))
    arrays.image.zero_()
    arrays.effect[:, -1] = torch.tensor([0.05, 0.02])
    pixel_m = 0.16 / 48
    row, column = round(23.5 - 0.02 / pixel_m), round(23.5 + 0.05 / pixel_m)
    arrays.image[:, 1, row, column] = 1
    turned = arrays.rotated_and_mirrored(quarters, mirror)
    _, row, column = turned.image[:, 1].nonzero().T
    seen = torch.stack([column - 23.5, 23.5 - row], dim=1) * pixel_m
    torch.testing.assert_close(seen, turned.effect[:, -1], atol=pixel_m, rtol=0)
    assert not torch.allclose(turned.effect[:, -1], arrays.effect[:, -1])
    torch.testing.assert_close(turned.action[:, 0].norm(dim=1), arrays.action[:, 0].norm(dim=1))
    back = turned.rotated_and_mirrored(-quarters).rotated_and_mirrored(0, mirror)
    for name in ("image", "action", "effect"):
        torch.testing.assert_close(getattr(back, name), getattr(arrays, name))


def test_batches_hold_what_the_trajectories_hold(pushes):
    arrays = interactions.InteractionTensors.from_dataset(pushes, np.arange(8))
    batch = sample_mixed(arrays, 5, 10, torch.Generator().manual_seed(0))
    at = (batch.t_target * 300).round().long()
    assert torch.equal(batch.effect, arrays.effect[torch.arange(8)[:, None], at])
    assert (batch.t_target[:, 0] == 1).all()
    seen = batch.observations
    nothing = ~(seen.action_mask.any(1) | seen.effect_mask.any(1))
    assert not nothing.any()
    assert (seen.weight[~seen.effect_mask.any(1)] == 1).all()
    assert (seen.weight[~seen.action_mask.any(1)] == 0).all()
    ends = condition_on_recorded_action(arrays)
    assert ends.action_t.unique().tolist() == [0.0, 1.0]


def test_a_file_that_would_fill_the_memory_or_never_end_is_refused(tmp_path):
    bomb, pipe = tmp_path / "bomb.zarr.zip", tmp_path / "pipe.zarr.zip"
    undamaged = repo_root() / "data" / "rotate.zarr.zip"
    with zipfile.ZipFile(undamaged) as whole, zipfile.ZipFile(bomb, "w") as archive:
        for name in whole.namelist():
            archive.writestr(name, whole.read(name))
        archive.writestr("extra", bytes(10**7), zipfile.ZIP_DEFLATED)  # in no manifest: not read
    assert interactions.open_interactions(bomb).equals(interactions.open_interactions(undamaged))
    with zipfile.ZipFile(bomb, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("manifest.json", bytes(10**7))
    larger = r"manifest\.json .* larger than the file"
    with pytest.raises(interactions.CorruptedDataError, match=larger):
        interactions.open_interactions(bomb)
    os.mkfifo(pipe)
    for read in (interactions.open_interactions, stored_sha256, load_state, read_results):
        with pytest.raises(FileNotFoundError, match=r"no file .*pipe\.zarr\.zip"):
            read(pipe)


def test_a_set_under_the_name_of_another_is_refused(tmp_path, monkeypatch):
    (tmp_path / "data").mkdir()
    shutil.copy(repo_root() / "data" / "grasp.zarr.zip", tmp_path / "data" / "rotate.zarr.zip")
    monkeypatch.setattr(results, "repo_root", lambda: tmp_path)
    with pytest.raises(interactions.CorruptedDataError, match="its recipe is not that of 'rotate'"):
        interactions.open_interactions("rotate")
