"""Data sets: collecting them, with kills and workers; shipped files, damage, splits, sampling."""

import os
import random
import shutil
import signal
import sys
import threading
import time
import zipfile
from dataclasses import replace

import numpy as np
import psutil
import pytest
import torch
import xarray as xr
from dask.distributed import Client
from joblib import parallel_config

from affordlib import interactions, results
from affordlib.interactions import collect, open_interactions
from affordlib.interactions.dataset import condition_on_recorded_action, sample_mixed
from affordlib.interactions.recipes import RECIPES, Recipe, interact
from affordlib.interactions.store import dataset_sha256, stored_sha256, write_interactions
from affordlib.models.checkpoint import load_state
from affordlib.world import Cuboid
from experiments import shipped
from tests.waiting import flipped, no_room, printed, start, wait_until

SMALL = Recipe(n_interactions=6, seed=11)
CONTINUE = "finished chunks are kept; collect into the same path to continue"


@pytest.fixture(autouse=True)
def small_chunks(monkeypatch):
    monkeypatch.setattr(collect, "CHUNK", 2)


@pytest.fixture(scope="session")
def undisturbed(tmp_path_factory):
    """A file that is collected in this process, uninterrupted."""
    path = tmp_path_factory.mktemp("undisturbed") / "set.zarr.zip"
    return collect.collect(SMALL, path, progress=False, chunk=2)


@pytest.fixture
def made(monkeypatch):
    """Replace interactions by cheap ones; list the first numbers of the chunks that are made."""
    made = []

    def chunk(recipe, numbers):
        made.append(numbers.start)
        values = [np.random.default_rng(i).random(5000, dtype=np.float32) for i in numbers]
        kinds = ("interaction", np.zeros(len(values), np.int8), {"flag_meanings": "cuboid"})
        found = {"x": (("interaction", "value"), values), "category": kinds}
        return xr.Dataset(found, attrs=collect.attributes_for(recipe))

    monkeypatch.setattr(collect, "collect_chunk", chunk)
    return made


def names_in(folder):
    return [path.name for path in folder.iterdir()]


@pytest.mark.slow
def test_a_file_holds_what_the_interactions_left(undisturbed):
    expected, path = collect.collect_chunk(SMALL, range(6)), undisturbed
    for read in (open_interactions(path), open_interactions(f"file://{path}")):
        assert read.identical(expected[list(read.data_vars)])
        assert all(read[name].dtype == expected[name].dtype for name in expected.variables)
        assert dataset_sha256(read) == dataset_sha256(expected) == stored_sha256(path)
        assert read.attrs == collect.attributes_for(SMALL)
    assert names_in(path.parent) == [path.name]


def test_a_set_is_made_once_and_nothing_else_is_replaced(tmp_path, made):
    path = tmp_path / "x.zarr.zip"
    for _ in range(2):
        assert collect.collect(SMALL, path, progress=False) == path
        assert made == [0, 2, 4]
    before = path.read_bytes()
    with pytest.raises(ValueError, match=r"x\.zarr\.zip is a set of another recipe"):
        collect.collect(replace(SMALL, seed=12), path, progress=False)
    (tmp_path / "folder.zarr.zip").mkdir()
    (tmp_path / "link.zarr.zip").symlink_to(tmp_path / "nowhere")
    (tmp_path / "half.zarr.zip").write_bytes(before[: len(before) // 2])
    there = sorted(tmp_path.rglob("*"))
    for name in ("folder", "link", "half"):
        with pytest.raises(ValueError, match=rf"path .*{name}.* (choose|delete)"):
            collect.collect(SMALL, tmp_path / f"{name}.zarr.zip", progress=False)
    assert sorted(tmp_path.rglob("*")) == there
    assert (path.read_bytes(), made) == (before, [0, 2, 4])
    collect.collect(SMALL, tmp_path / "half.zarr.zip", progress=False, replace=True)
    assert (tmp_path / "half.zarr.zip").read_bytes() == before


def test_what_a_full_disk_has_left_out_or_damaged_is_made_again(tmp_path, made, monkeypatch):
    path, real, room = tmp_path / "x.zarr.zip", os.fsync, [True] * 3
    with monkeypatch.context() as full:
        full.setattr(os, "fsync", lambda handle: real(handle) if room and room.pop() else no_room())
        with pytest.raises(OSError, match="No space left") as failure:
            collect.collect(SMALL, path, progress=False)
    assert failure.value.__notes__ == [CONTINUE]
    with pytest.raises(FileNotFoundError, match="no file"):
        open_interactions(path)
    assert not list(tmp_path.rglob("*.tmp"))
    first, second, _ = sorted(tmp_path.glob(".x*.parts/*.zip"))
    first.unlink()
    second.write_bytes(flipped(second.read_bytes(), second.stat().st_size // 2))
    collect.collect(SMALL, path, progress=False)
    assert made == [0, 2, 4, 0, 2]
    whole = collect.collect(SMALL, tmp_path / "y.zarr.zip", progress=False, chunk=4)
    assert path.read_bytes() == whole.read_bytes()
    assert sorted(names_in(tmp_path)) == ["x.zarr.zip", "y.zarr.zip"]


def test_paths_and_workers_that_cannot_be_are_named(tmp_path):
    for path in (tmp_path / "x.zip", tmp_path / "x.zarr"):
        with pytest.raises(ValueError, match=r"path must end in .*got .*x\."):
            collect.collect(SMALL, path)
    for workers in (0, 10**6):
        with pytest.raises(ValueError, match=rf"workers must be a whole number .* {workers}$"):
            collect.collect(SMALL, tmp_path / "x.zarr.zip", workers=workers)


SCRIPT = """
import sys
from affordlib.interactions import collect
from affordlib.interactions.recipes import Recipe

collect.CHUNK = 2
recipe = Recipe(n_interactions=int(sys.argv[2]), seed=11)
collect.collect(recipe, sys.argv[1], workers=2, progress=False)
"""


def start_collector(path, n_interactions):
    return start(
        [sys.executable, "-c", SCRIPT, str(path), str(n_interactions)], cwd=results.repo_root()
    )


@pytest.mark.slow
def test_a_collector_killed_at_any_moment_is_no_loss(undisturbed, tmp_path):
    path = tmp_path / "set.zarr.zip"
    process = start_collector(path, 6)
    wait_until(lambda: list(tmp_path.glob(".set*.parts")) or process.poll() is not None, 120)
    time.sleep(random.uniform(0, 3))
    family = psutil.Process(process.pid).children(recursive=True)
    process.kill()
    process.communicate(timeout=180)  # its workers write to the same pipes
    assert not psutil.wait_procs(family, timeout=5)[1]  # it leaves no workers
    collect.collect(SMALL, path, progress=False)
    assert path.read_bytes() == undisturbed.read_bytes()
    assert names_in(tmp_path) == [path.name]


@pytest.mark.slow
def test_ctrl_c_ends_collecting_with_one_error(tmp_path):
    """Until then its workers have no open port."""
    process = start_collector(tmp_path / "set.zarr.zip", 100)
    wait_until(lambda: list(tmp_path.glob(".set*.parts/*.zip")), 120, process)
    family = psutil.Process(process.pid).children(recursive=True)
    assert not [port for one in family for port in one.net_connections("inet")]
    os.killpg(process.pid, signal.SIGINT)  # as a terminal does
    said, _ = process.communicate(timeout=60)
    assert process.returncode == -signal.SIGINT
    assert said.count("Traceback") == 1
    assert said.splitlines()[-2:] == ["KeyboardInterrupt", CONTINUE]


def test_a_chunk_that_cannot_be_made_on_a_cluster_is_named(tmp_path, made, monkeypatch):
    make = collect.collect_chunk

    def fails(recipe, numbers):
        assert threading.current_thread() is not threading.main_thread()  # but on the cluster
        return [].pop() if numbers.start == 4 else make(recipe, numbers)

    monkeypatch.setattr(collect, "collect_chunk", fails)
    path = tmp_path / "set.zarr.zip"
    wrong = pytest.raises(RuntimeError, match="interactions 4 to 5 failed: IndexError: pop")
    with Client(processes=False, n_workers=2, threads_per_worker=1, dashboard_address=None):
        with parallel_config("dask"), wrong:
            collect.collect(SMALL, path, progress=False)
        assert not path.exists()
        monkeypatch.setattr(collect, "collect_chunk", make)
        with parallel_config("dask"):
            collect.collect(SMALL, path, progress=False)
    assert names_in(tmp_path) == [path.name]


def test_where_no_processes_can_be_had_there_is_one(tmp_path, made, monkeypatch):
    monkeypatch.setattr("affordlib.workers.mp", None)  # joblib's, where /dev/shm is read-only
    collect.collect(SMALL, tmp_path / "set.zarr.zip", workers=2, progress=False)
    assert made == [0, 2, 4]


@pytest.mark.slow
def test_a_worker_that_dies_says_so(undisturbed, tmp_path):
    path, here = tmp_path / "set.zarr.zip", os.getpid()

    class Deadly(Recipe):
        def to_json(self):
            return super().to_json() if os.getpid() == here else os._exit(9)

    with pytest.raises(RuntimeError, match="unexpectedly terminated"):
        collect.collect(Deadly(**vars(SMALL)), path, 2, progress=False)
    collect.collect(SMALL, path, 2, progress=False)
    assert path.read_bytes() == undisturbed.read_bytes()


@pytest.mark.slow
def test_workers_get_the_classes_of_a_user(tmp_path, monkeypatch):
    brick = type("Brick", (Cuboid,), {"category": "brick"})
    monkeypatch.setitem(collect.CATEGORIES, "brick", brick)
    own = replace(SMALL, categories=("brick",))
    one, two = (collect.collect(own, tmp_path / f"{n}.zarr.zip", n, False) for n in (1, 2))
    assert one.read_bytes() == two.read_bytes()


@pytest.mark.slow
def test_make_data_compares_with_what_was_there(undisturbed, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(shipped, "RECIPES", {"push": SMALL})
    arguments = ["data", "--only", "push", "--to", str(tmp_path), "--workers", "2"]
    assert shipped.main(arguments) == 1
    assert "not the same: 6 interactions, formerly 500" in capsys.readouterr().out
    assert (tmp_path / "push.zarr.zip").read_bytes() == undisturbed.read_bytes()
    real = shipped.open_interactions
    there = {"push": undisturbed}
    monkeypatch.setattr(shipped, "open_interactions", lambda name: real(there.get(name, name)))
    assert shipped.main(arguments) == 0
    assert "push: the same, bit for bit" in capsys.readouterr().out


def test_how_far_apart_two_sets_are_is_said(undisturbed):
    old = open_interactions(undisturbed)
    for gap_m, agree in ((0.00004, True), (0.00006, False)):
        new = old.copy(deep=True)
        new["rest_effect"][:, 1] += gap_m
        same, sentence = shipped.compare(old, new)
        assert same is agree
        assert f"{gap_m * 1000:.3f} mm in the median (tolerance 0.05 mm)" in sentence
    assert not shipped.compare(old, old.isel(interaction=slice(3)))[0]
    one = old.copy(deep=True)
    one["rest_effect"][0, 0] += 0.05  # one object that tipped over in the other direction
    assert shipped.compare(old, one)[0]


def test_a_worker_watches_its_parent_before_it_imports_what_is_large():
    code = "import sys, affordlib.workers; print({'torch', 'xarray', 'pybullet'} & {*sys.modules})"
    assert printed(code) == "set()\n"


@pytest.mark.parametrize(("name", "recipe"), RECIPES.items())
def test_the_shipped_sets_are_what_their_recipes_say(name, recipe, world):
    data = open_interactions(name)
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
    # Few interactions are flagged, and all say why.
    reasons = (data["tracking_error"] > 0.002) | (data["penetration"] > 0.002)
    np.testing.assert_array_equal(data["fault"].values, reasons.values)
    assert data["fault"].values.mean() < 0.05
    assert not data["effect"].values[~data["reached"].values].any()
    assert data["reached"].values.all() or name == "reach"
    # The tool was where the action says, measured every 150 ms, as in the paper.
    ok = data["reached"].values & ~data["fault"].values
    commanded = data["action"].values[ok][:, ::12, :3]
    measured = data["tool"].values[ok][:, :, :3]
    if name == "push_varied":  # its gripper moves higher than commanded, by an amount it measures
        commanded, measured = commanded[..., :2], measured[..., :2]
    off = measured - commanded
    if name == "grasp":  # a guarded hand may have stopped above its target
        assert off[..., 2].max() > 0.01
        off[..., 2] = np.minimum(off[..., 2], 0)
    # The waypoints of a very short action are further apart than its samples.
    assert np.linalg.norm(off, axis=-1).max() < (0.003 if name == "partial" else 0.002)


def test_shipped_files_are_small_and_complete(pushes):
    data = results.repo_root() / "data"
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
    write_interactions(open_interactions("rotate").isel(interaction=slice(2)), path)
    whole, expected = path.read_bytes(), dataset_sha256(open_interactions(path))
    with zipfile.ZipFile(path) as archive:
        files = {name: archive.read(name) for name in archive.namelist()}
    for name, content in files.items():
        damaged = flipped(content, rng.integers(len(content)), rng.integers(8))
        for changed in (None, b"{}" if name == "manifest.json" else damaged):
            with zipfile.ZipFile(path, "w") as archive:
                for other, stored in (files | {name: changed}).items():
                    if stored is not None:
                        archive.writestr(other, stored)
            with pytest.raises(interactions.CorruptedDataError, match=f"{name}.*again"):
                open_interactions(path)
    caught = 0
    for position in rng.integers(0, len(whole), 40):
        path.write_bytes(flipped(whole, position, rng.integers(8)))
        try:  # a flip in the zip's padding or times harms nothing
            assert dataset_sha256(open_interactions(path)) == expected
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
    undamaged = results.repo_root() / "data" / "rotate.zarr.zip"
    with zipfile.ZipFile(undamaged) as whole, zipfile.ZipFile(bomb, "w") as archive:
        for name in whole.namelist():
            archive.writestr(name, whole.read(name))
        archive.writestr("extra", bytes(10**7), zipfile.ZIP_DEFLATED)  # in no manifest: not read
    assert open_interactions(bomb).equals(open_interactions(undamaged))
    with zipfile.ZipFile(bomb, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("manifest.json", bytes(10**7))
    larger = r"manifest\.json .* larger than the file"
    with pytest.raises(interactions.CorruptedDataError, match=larger):
        open_interactions(bomb)
    os.mkfifo(pipe)
    for read in (open_interactions, stored_sha256, load_state, results.read_results):
        with pytest.raises(FileNotFoundError, match=r"no file .*pipe\.zarr\.zip"):
            read(pipe)


def test_a_set_under_the_name_of_another_is_refused(tmp_path, monkeypatch):
    (tmp_path / "data").mkdir()
    shutil.copy(results.repo_root() / "data/grasp.zarr.zip", tmp_path / "data/rotate.zarr.zip")
    monkeypatch.setattr(results, "repo_root", lambda: tmp_path)
    with pytest.raises(interactions.CorruptedDataError, match="its recipe is not that of 'rotate'"):
        open_interactions("rotate")
