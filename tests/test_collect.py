"""Collecting: the same bits whatever is killed, cut off or shared."""

import errno
import math
import os
import random
import shutil
import signal
import subprocess
import sys
import threading
import time
import zipfile
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

import affordlib
from affordlib.interactions import CorruptedDataError, collect
from affordlib.interactions.collect import collect as collect_set
from affordlib.interactions.recipes import Recipe
from affordlib.interactions.schema import collect_chunk, schema_for
from affordlib.interactions.store import dataset_sha256, open_interactions, stored_sha256
from experiments import shipped

SMALL = Recipe(n_interactions=6, seed=11)
LONGER = Recipe(n_interactions=12, seed=5)
ROOT = Path(affordlib.__file__).parents[1]

pytestmark = pytest.mark.usefixtures("small_chunks")


def names_in(folder):
    return [path.name for path in folder.iterdir()]


@pytest.fixture
def made(cheap, monkeypatch):
    """The first interactions of the chunks that are made."""
    made, real = [], collect.collect_chunk

    def counted(recipe, indices):
        made.append(indices.start)
        return real(recipe, indices)

    monkeypatch.setattr(collect, "collect_chunk", counted)
    return made


# The file


@pytest.mark.slow
def test_it_holds_what_the_interactions_left(undisturbed):
    arrays, path = collect_chunk(SMALL, range(6)), undisturbed(SMALL)
    read = open_interactions(path)
    assert sorted(read.variables) == sorted(arrays)
    for name, array in arrays.items():
        np.testing.assert_array_equal(read[name].values, array)
        assert read[name].dtype == array.dtype
    straight = xr.Dataset({n: ([f"{n}{k}" for k in range(a.ndim)], a) for n, a in arrays.items()})
    assert dataset_sha256(read) == dataset_sha256(straight) == stored_sha256(path)
    assert read.attrs == schema_for(SMALL).attrs
    assert names_in(path.parent) == [path.name]
    assert dataset_sha256(open_interactions(f"file://{path}")) == dataset_sha256(read)


def test_whatever_is_damaged_is_named(undisturbed, tmp_path):
    with zipfile.ZipFile(undisturbed(SMALL)) as archive:
        files = {name: archive.read(name) for name in archive.namelist()}

    def stored(**changed):
        path = tmp_path / "set.zarr.zip"
        with zipfile.ZipFile(path, "w") as archive:
            for name, content in (files | changed).items():
                if content is not None:
                    archive.writestr(name, content)
        return path

    rng = np.random.default_rng(0)
    for name, content in files.items():
        damaged = bytearray(content)
        damaged[rng.integers(len(content))] ^= 1 << int(rng.integers(8))
        for what in (None, bytes(damaged)):
            if name == "manifest.json" and what is not None:
                what = b"{}"
            with pytest.raises(CorruptedDataError, match=f"{name}.*again"):
                open_interactions(stored(**{name: what}))


def test_a_set_is_made_once_and_no_other_recipe_takes_its_place(tmp_path, made):
    path = tmp_path / "x.zarr.zip"
    assert collect_set(SMALL, path, progress=False) == path
    assert made == [0, 2, 4]
    before = path.read_bytes()
    collect_set(SMALL, path, progress=False)
    assert made == [0, 2, 4]
    with pytest.raises(ValueError, match=r"x\.zarr\.zip holds a set of another recipe"):
        collect_set(replace(SMALL, seed=12), path, progress=False)
    for foreign in (before[: len(before) // 2], b"notes"):
        path.write_bytes(foreign)
        with pytest.raises(ValueError, match=r"is no whole set of interactions.*replace=True"):
            collect_set(SMALL, path, progress=False)
        assert path.read_bytes() == foreign
    assert made == [0, 2, 4]
    collect_set(SMALL, path, progress=False, replace=True)
    assert path.read_bytes() == before
    assert names_in(tmp_path) == [path.name]


def test_nothing_foreign_is_replaced_and_no_interaction_is_made(tmp_path, made):
    (tmp_path / "f.zarr.zip").mkdir()
    (tmp_path / "l.zarr.zip").symlink_to(tmp_path / "nowhere")
    before = sorted(tmp_path.rglob("*"))
    for name in ("f.zarr.zip", "l.zarr.zip"):
        with pytest.raises(ValueError, match=rf"path .*{name}.* (choose|delete)"):
            collect_set(SMALL, tmp_path / name, progress=False)
    assert sorted(tmp_path.rglob("*")) == before
    assert made == []


def test_what_is_missing_or_damaged_is_made_again(tmp_path, made, monkeypatch):
    path = tmp_path / "x.zarr.zip"
    with monkeypatch.context() as full:
        full.setattr(collect, "write_interactions", no_room)
        with pytest.raises(OSError, match="No space left"):
            collect_set(SMALL, path, progress=False)
    first, second, _ = sorted(tmp_path.glob(".x*.parts/*.npz"))
    first.unlink()
    damaged = bytearray(second.read_bytes())
    damaged[len(damaged) // 2] ^= 1
    second.write_bytes(damaged)
    collect_set(SMALL, path, progress=False)
    assert made == [0, 2, 4, 0, 2]
    whole = collect_set(SMALL, tmp_path / "y.zarr.zip", progress=False)
    assert path.read_bytes() == whole.read_bytes()


def no_room(*_):
    raise OSError(errno.ENOSPC, "No space left on device")


def test_a_full_disk_leaves_nothing_that_is_read(tmp_path, cheap, monkeypatch):
    path, real, room = tmp_path / "full.zarr.zip", os.fsync, []

    def fsync(handle):
        if not room:
            no_room()
        real(handle)
        room.pop()

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", fsync)
        for files in (0, 1, 0, 1):  # then two of the three chunks are there
            room[:] = [True] * files
            with pytest.raises(OSError, match="No space left"):
                collect_set(SMALL, path, progress=False)
            with pytest.raises(FileNotFoundError, match="no file"):
                open_interactions(path)
    assert len(list(tmp_path.rglob("*.npz"))) == 2
    assert not list(tmp_path.rglob("*.tmp"))
    collect_set(SMALL, path, progress=False)
    assert names_in(tmp_path) == [path.name]


def test_paths_and_workers_that_cannot_be_are_named(tmp_path):
    for path in (tmp_path / "x.zip", tmp_path / "x.zarr"):
        with pytest.raises(ValueError, match=r"path must end in .*got .*x\."):
            collect_set(SMALL, path)
    with pytest.raises(ValueError, match=r"workers must be a whole number .* 0"):
        collect_set(SMALL, tmp_path / "x.zarr.zip", workers=0)
    with pytest.raises(FileNotFoundError, match=r"there is no file .*x\.zarr\.zip; .*'push'"):
        open_interactions(tmp_path / "x.zarr.zip")


def test_a_worker_with_other_packages_is_refused(tmp_path, cheap, monkeypatch):
    numpys = iter(("2.4.6", "1.0"))
    schema = collect.schema_for(SMALL)
    monkeypatch.setattr(
        collect, "schema_for", lambda _: replace(schema, attrs={"numpy": next(numpys)})
    )
    with pytest.raises(RuntimeError, match=r"another set .*1\.0.*, not .*2\.4\.6"):
        collect_set(SMALL, tmp_path / "x.zarr.zip", progress=False)


# Kills

_DRIVER = """
import sys
from affordlib.interactions import collect
from affordlib.interactions.recipes import Recipe
collect.CHUNK = 2
recipe = Recipe(n_interactions=6, seed=11)
collect.collect(recipe, sys.argv[1], workers=int(sys.argv[2]), progress=False)
"""


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(10))
def test_a_driver_killed_at_any_moment_is_no_loss(undisturbed, tmp_path, seed):
    path = tmp_path / "set.zarr.zip"
    command = [sys.executable, "-c", _DRIVER, str(path), str(1 + seed % 2)]
    process = subprocess.Popen(command, cwd=ROOT, stderr=subprocess.DEVNULL)
    deadline = time.monotonic() + 60
    while not list(tmp_path.glob(".set*.parts")) and time.monotonic() < deadline:
        time.sleep(0.002)
    time.sleep(random.Random(seed).uniform(0, 0.7))
    process.kill()
    process.wait()
    collect_set(SMALL, path, progress=False)
    assert path.read_bytes() == undisturbed(SMALL).read_bytes()
    assert names_in(tmp_path) == [path.name]


def test_a_second_collector_is_refused_until_the_first_is_gone(tmp_path, cheap):
    path = tmp_path / "x.zarr.zip"
    hold = "import sys, time; from pathlib import Path; from affordlib.interactions import collect"
    hold += "\nwith collect._alone(Path(sys.argv[1])): print('held', flush=True); time.sleep(60)"
    holder = subprocess.Popen([sys.executable, "-c", hold, str(path)], stdout=subprocess.PIPE)
    assert holder.stdout.readline() == b"held\n"
    with pytest.raises(RuntimeError, match=r"another process is collecting into .*x\.zarr\.zip"):
        collect_set(SMALL, path, progress=False)
    os.kill(holder.pid, signal.SIGKILL)
    holder.communicate()
    collect_set(SMALL, path, progress=False)
    assert names_in(tmp_path) == [path.name]


# A cluster


@pytest.fixture(scope="module")
def client(tmp_path_factory):
    """A client of a scheduler and two workers that the `dask` command has started."""
    from dask.distributed import Client

    folder = tmp_path_factory.mktemp("dask")
    file = folder / "scheduler.json"
    worker = ["worker", "--scheduler-file", str(file), "--nthreads", "1", "--no-dashboard"]
    worker += ["--local-directory", str(folder)]
    host = ["--host", "127.0.0.1", "--port", "0", "--no-dashboard"]
    commands = [["scheduler", *host, "--scheduler-file", str(file)], worker, worker]
    processes = [
        subprocess.Popen(
            [sys.executable, "-m", "dask", *command],
            cwd=ROOT,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )
        for command in commands
    ]
    try:
        with Client(scheduler_file=str(file), timeout=60) as client:
            client.wait_for_workers(2, timeout=60)
            yield client
    finally:
        for process in processes:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()


@pytest.fixture
def both(client):
    """The client while both workers are there."""
    client.wait_for_workers(2, timeout=60)
    yield client
    client.wait_for_workers(2, timeout=60)


@contextmanager
def poisoned(client, log, how):
    """Make all workers, also those started later, fail in the chunk that begins with 6.

    log: a file that gets a letter for each time that they do.
    """
    from dask.distributed import WorkerPlugin

    class Poison(WorkerPlugin):
        name = "poison"

        def setup(self, worker):
            from affordlib.interactions import collect, schema

            def deadly(recipe, indices):
                if indices.start == 6:
                    with open(log, "a") as file:
                        file.write("x")
                    os._exit(9) if how == "kill" else math.sqrt(-1)
                return schema.collect_chunk(recipe, indices)

            collect.collect_chunk = deadly

        def teardown(self, worker):
            from affordlib.interactions import collect, schema

            collect.collect_chunk = schema.collect_chunk

    client.register_plugin(Poison())
    try:
        yield
    finally:
        client.wait_for_workers(2, timeout=60)
        client.unregister_worker_plugin("poison")


@pytest.mark.slow
def test_a_cluster_leaves_the_same_file(both, undisturbed, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(collect, "WINDOW", 2)
    submit, most = both.submit, 0

    def counting(*arguments, **options):
        nonlocal most
        future = submit(*arguments, **options)
        most = max(most, sum(f.status == "pending" for f in both.futures.values()))
        return future

    monkeypatch.setattr(both, "submit", counting)
    path = collect_set(LONGER, "relative.zarr.zip", both, progress=False)
    assert Path(path).read_bytes() == undisturbed(LONGER).read_bytes()
    assert most == 4
    assert names_in(tmp_path) == ["relative.zarr.zip"]


@pytest.mark.slow
def test_a_chunk_that_cannot_be_made_is_named(both, undisturbed, tmp_path):
    path, log = tmp_path / "set.zarr.zip", tmp_path / "log"
    reason = r"interactions 6 to 7 could not be collected: ValueError: math domain error"
    with poisoned(both, log, "raise"), pytest.raises(RuntimeError, match=reason):
        collect_set(LONGER, path, both, progress=False)
    assert len(log.read_text()) == 1
    assert not path.exists()
    assert list(tmp_path.glob(".set*.parts/*.npz"))
    collect_set(LONGER, path, both, progress=False)
    assert path.read_bytes() == undisturbed(LONGER).read_bytes()


@pytest.mark.slow
def test_a_chunk_that_kills_its_workers_is_named(both, tmp_path):
    def allow(failures, dask_scheduler):
        dask_scheduler.allowed_failures, before = failures, dask_scheduler.allowed_failures
        return before

    path, log = tmp_path / "set.zarr.zip", tmp_path / "log"
    usual = both.run_on_scheduler(allow, 0)
    try:
        with (
            poisoned(both, log, "kill"),
            pytest.raises(RuntimeError, match=r"interactions 6 to 7 .*KilledWorker"),
        ):
            collect_set(LONGER, path, both, progress=False)
    finally:
        both.run_on_scheduler(allow, usual)
    assert len(log.read_text()) == 2  # among others, and alone
    made = {p.stem for p in tmp_path.glob(".set*.parts/*.npz")}
    assert made >= {f"{k:08d}" for k in (0, 2, 4)}  # though they died with its workers
    assert f"{6:08d}" not in made


@pytest.mark.slow
def test_make_data_collects_with_a_scheduler(both, undisturbed, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(shipped, "RECIPES", {"push": SMALL})
    address = ["--scheduler", both.scheduler.address]
    assert shipped.main(["data", "--only", "push", "--to", str(tmp_path), *address]) == 1
    assert "not the same: 6 interactions, formerly 500" in capsys.readouterr().out
    assert (tmp_path / "push.zarr.zip").read_bytes() == undisturbed(SMALL).read_bytes()


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(10))
def test_workers_killed_at_any_moment_are_no_loss(both, undisturbed, tmp_path, seed):
    path, pids = tmp_path / "set.zarr.zip", list(both.run(os.getpid).values())
    kill = threading.Timer(
        random.Random(seed).uniform(0, 0.6), os.kill, [pids[seed % 2], signal.SIGKILL]
    )
    kill.start()
    collect_set(LONGER, path, both, progress=False)
    kill.join()
    assert path.read_bytes() == undisturbed(LONGER).read_bytes()


# Comparing


def test_make_data_says_how_far_apart_two_sets_are(undisturbed):
    old = open_interactions(undisturbed(SMALL))
    assert shipped.compare(old, old) == (True, "the same, bit for bit")
    for gap_m, agree in ((0.00004, True), (0.00006, False)):
        new = old.copy(deep=True)
        new["rest_effect"][:, 1] += gap_m
        same, sentence = shipped.compare(old, new)
        assert same is agree
        assert f"{gap_m * 1000:.3f} mm in the median (tolerance 0.05 mm)" in sentence
    one = old.copy(deep=True)
    one["rest_effect"][0, 0] += 0.05  # one object that tipped over the other way
    assert shipped.compare(old, one)[0]
    assert not shipped.compare(old, old.isel(interaction=slice(3)))[0]


@pytest.mark.slow
def test_make_data_ends_with_status_1_when_the_sets_differ(
    undisturbed, tmp_path, monkeypatch, capsys
):
    monkeypatch.setattr(shipped, "RECIPES", {"push": SMALL, "turned": LONGER})
    arguments = ["data", "--only", "push", "--to", str(tmp_path), "--workers", "1"]
    shutil.copy(undisturbed(SMALL), tmp_path / "former.zarr.zip")
    former = {"push": tmp_path / "former.zarr.zip"}
    monkeypatch.setattr(
        shipped, "open_interactions", lambda name: open_interactions(former.get(name, name))
    )
    assert shipped.main(arguments) == 0
    assert "push: the same, bit for bit" in capsys.readouterr().out
    former["push"] = undisturbed(LONGER)
    assert shipped.main(arguments) == 1
    assert "not the same: 6 interactions, formerly 12" in capsys.readouterr().out
