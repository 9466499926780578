"""Collecting gives bit-identical files after kills and interrupts, and with several workers."""

import errno
import os
import random
import signal
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import psutil
import pytest
import xarray as xr
from dask.distributed import Client
from joblib import parallel_config

import affordlib
from affordlib.interactions import collect
from affordlib.interactions.collect import attributes_for, collect_chunk
from affordlib.interactions.collect import collect as collect_set
from affordlib.interactions.recipes import Recipe
from affordlib.interactions.store import dataset_sha256, open_interactions, stored_sha256
from affordlib.world import Cuboid
from experiments import shipped
from tests.waiting import printed, start, wait_until

SMALL = Recipe(n_interactions=6, seed=11)
CONTINUE = "finished chunks are kept; collect into the same path to continue"
ROOT = Path(affordlib.__file__).parents[1]


@pytest.fixture(autouse=True)
def small_chunks(monkeypatch):
    monkeypatch.setattr(collect, "CHUNK", 2)


@pytest.fixture(scope="session")
def undisturbed(tmp_path_factory):
    """A file that is collected in this process, uninterrupted."""
    path = tmp_path_factory.mktemp("undisturbed") / "set.zarr.zip"
    return collect_set(SMALL, path, progress=False, chunk=2)


@pytest.fixture
def made(monkeypatch):
    """Replace interactions by cheap ones; list the first numbers of the chunks that are made."""
    made = []

    def chunk(recipe, numbers):
        made.append(numbers.start)
        values = [np.random.default_rng(i).random(5000, dtype=np.float32) for i in numbers]
        kinds = ("interaction", np.zeros(len(values), np.int8), {"flag_meanings": "cuboid"})
        found = {"x": (("interaction", "value"), values), "category": kinds}
        return xr.Dataset(found, attrs=attributes_for(recipe))

    monkeypatch.setattr(collect, "collect_chunk", chunk)
    return made


def names_in(folder):
    return [path.name for path in folder.iterdir()]


def no_room(*_):
    raise OSError(errno.ENOSPC, "No space left on device")


@pytest.mark.slow
def test_a_file_holds_what_the_interactions_left(undisturbed):
    expected, path = collect_chunk(SMALL, range(6)), undisturbed
    for read in (open_interactions(path), open_interactions(f"file://{path}")):
        assert read.identical(expected[list(read.data_vars)])
        assert all(read[name].dtype == expected[name].dtype for name in expected.variables)
        assert dataset_sha256(read) == dataset_sha256(expected) == stored_sha256(path)
        assert read.attrs == attributes_for(SMALL)
    assert names_in(path.parent) == [path.name]


def test_a_set_is_made_once_and_nothing_else_is_replaced(tmp_path, made):
    path = tmp_path / "x.zarr.zip"
    for _ in range(2):
        assert collect_set(SMALL, path, progress=False) == path
        assert made == [0, 2, 4]
    before = path.read_bytes()
    with pytest.raises(ValueError, match=r"x\.zarr\.zip is a set of another recipe"):
        collect_set(replace(SMALL, seed=12), path, progress=False)
    (tmp_path / "folder.zarr.zip").mkdir()
    (tmp_path / "link.zarr.zip").symlink_to(tmp_path / "nowhere")
    (tmp_path / "half.zarr.zip").write_bytes(before[: len(before) // 2])
    there = sorted(tmp_path.rglob("*"))
    for name in ("folder", "link", "half"):
        with pytest.raises(ValueError, match=rf"path .*{name}.* (choose|delete)"):
            collect_set(SMALL, tmp_path / f"{name}.zarr.zip", progress=False)
    assert sorted(tmp_path.rglob("*")) == there
    assert (path.read_bytes(), made) == (before, [0, 2, 4])
    collect_set(SMALL, tmp_path / "half.zarr.zip", progress=False, replace=True)
    assert (tmp_path / "half.zarr.zip").read_bytes() == before


def test_what_a_full_disk_has_left_out_or_damaged_is_made_again(tmp_path, made, monkeypatch):
    path, real, room = tmp_path / "x.zarr.zip", os.fsync, [True] * 3
    with monkeypatch.context() as full:
        full.setattr(os, "fsync", lambda handle: real(handle) if room and room.pop() else no_room())
        with pytest.raises(OSError, match="No space left") as failure:
            collect_set(SMALL, path, progress=False)
    assert failure.value.__notes__ == [CONTINUE]
    with pytest.raises(FileNotFoundError, match="no file"):
        open_interactions(path)
    assert not list(tmp_path.rglob("*.tmp"))
    first, second, _ = sorted(tmp_path.glob(".x*.parts/*.zip"))
    first.unlink()
    damaged = bytearray(second.read_bytes())
    damaged[len(damaged) // 2] ^= 1
    second.write_bytes(damaged)
    collect_set(SMALL, path, progress=False)
    assert made == [0, 2, 4, 0, 2]
    whole = collect_set(SMALL, tmp_path / "y.zarr.zip", progress=False, chunk=4)
    assert path.read_bytes() == whole.read_bytes()
    assert sorted(names_in(tmp_path)) == ["x.zarr.zip", "y.zarr.zip"]


def test_paths_and_workers_that_cannot_be_are_named(tmp_path):
    for path in (tmp_path / "x.zip", tmp_path / "x.zarr"):
        with pytest.raises(ValueError, match=r"path must end in .*got .*x\."):
            collect_set(SMALL, path)
    for workers in (0, 10**6):
        with pytest.raises(ValueError, match=rf"workers must be a whole number .* {workers}$"):
            collect_set(SMALL, tmp_path / "x.zarr.zip", workers=workers)


SCRIPT = """
import sys
from affordlib.interactions import collect
from affordlib.interactions.recipes import Recipe

collect.CHUNK = 2
recipe = Recipe(n_interactions=int(sys.argv[2]), seed=11)
collect.collect(recipe, sys.argv[1], workers=2, progress=False)
"""


def start_collector(path, n_interactions):
    """Collect with two workers in another process."""
    return start([sys.executable, "-c", SCRIPT, str(path), str(n_interactions)], cwd=ROOT)


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
    collect_set(SMALL, path, progress=False)
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
            collect_set(SMALL, path, progress=False)
        assert not path.exists()
        monkeypatch.setattr(collect, "collect_chunk", make)
        with parallel_config("dask"):
            collect_set(SMALL, path, progress=False)
    assert names_in(tmp_path) == [path.name]


def test_where_no_processes_can_be_had_there_is_one(tmp_path, made, monkeypatch):
    monkeypatch.setattr("affordlib.workers.mp", None)  # joblib's, where /dev/shm is read-only
    collect_set(SMALL, tmp_path / "set.zarr.zip", workers=2, progress=False)
    assert made == [0, 2, 4]


@pytest.mark.slow
def test_a_worker_that_dies_says_so(undisturbed, tmp_path):
    path, here = tmp_path / "set.zarr.zip", os.getpid()

    class Deadly(Recipe):
        def to_json(self):
            return super().to_json() if os.getpid() == here else os._exit(9)

    with pytest.raises(RuntimeError, match="unexpectedly terminated"):
        collect_set(Deadly(**vars(SMALL)), path, 2, progress=False)
    collect_set(SMALL, path, 2, progress=False)
    assert path.read_bytes() == undisturbed.read_bytes()


@pytest.mark.slow
def test_workers_get_the_classes_of_a_user(tmp_path, monkeypatch):
    brick = type("Brick", (Cuboid,), {"category": "brick"})
    monkeypatch.setitem(collect.CATEGORIES, "brick", brick)
    own = replace(SMALL, categories=("brick",))
    one, two = (collect_set(own, tmp_path / f"{n}.zarr.zip", n, False) for n in (1, 2))
    assert one.read_bytes() == two.read_bytes()


@pytest.mark.slow
def test_make_data_compares_with_what_was_there(undisturbed, tmp_path, monkeypatch, capsys):
    """The exit status says whether the sets agree."""
    monkeypatch.setattr(shipped, "RECIPES", {"push": SMALL})
    where = ["--to", str(tmp_path), "--workers", "2"]
    arguments = ["data", "--only", "push", *where]
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
