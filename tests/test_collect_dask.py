"""Collecting on a cluster: the same file, whatever becomes of its workers."""

import math
import os
import random
import signal
import subprocess
import sys
import threading
import time
from contextlib import contextmanager
from pathlib import Path

import pytest

import affordlib
from affordlib.interactions import CorruptedDataError, collect
from affordlib.interactions.collect import collect as collect_set
from affordlib.interactions.places import Place
from affordlib.interactions.recipes import Recipe
from affordlib.interactions.store import dataset_sha256, open_interactions, stored_sha256
from experiments import make_data

SMALL = Recipe(n_interactions=6, seed=11)
LONGER = Recipe(n_interactions=12, seed=5)
ROOT = Path(affordlib.__file__).parents[1]

pytestmark = pytest.mark.usefixtures("small_chunks")


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
            from affordlib.interactions import collect, records

            def deadly(recipe, indices):
                if indices.start == 6:
                    with open(log, "a") as file:
                        file.write("x")
                    os._exit(9) if how == "kill" else math.sqrt(-1)
                return records.collect_chunk(recipe, indices)

            collect.collect_chunk = deadly

        def teardown(self, worker):
            from affordlib.interactions import collect, records

            collect.collect_chunk = records.collect_chunk

    client.register_plugin(Poison())
    try:
        yield
    finally:
        client.wait_for_workers(2, timeout=60)
        client.unregister_worker_plugin("poison")


@pytest.mark.slow
def test_a_cluster_leaves_the_same_file(both, undisturbed, tmp_path, monkeypatch):
    assert set(both.run(lambda: __import__("affordlib").__file__).values()) == {affordlib.__file__}
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
    assert [p.name for p in tmp_path.iterdir()] == ["relative.zarr.zip"]


@pytest.mark.slow
@pytest.mark.parametrize("suffix", [".zarr", ".zarr.zip"])
def test_a_cluster_writes_where_all_can(both, undisturbed, tmp_path, suffix):
    folder = str(tmp_path)

    def register():
        """Make known a file system that all processes see and that is not local to affordlib."""
        import fsspec
        from fsspec.implementations.dirfs import DirFileSystem
        from fsspec.implementations.local import LocalFileSystem

        class Shared(DirFileSystem):
            protocol, cachable = "shared", False

            def __init__(self, **_):
                super().__init__(folder, LocalFileSystem())

        fsspec.register_implementation("shared", Shared, clobber=True)

    register()
    both.run(register)
    url = f"shared://set{suffix}"
    assert not Place.of(url).is_local
    assert collect_set(SMALL, url, both, progress=False) == url
    assert dataset_sha256(open_interactions(url)) == stored_sha256(undisturbed(SMALL))
    assert [p.name for p in tmp_path.iterdir()] == [f"set{suffix}"]
    if suffix == ".zarr.zip":
        whole = undisturbed(SMALL).read_bytes()
        assert (tmp_path / "set.zarr.zip").read_bytes() == whole
        (tmp_path / "set.zarr.zip").write_bytes(whole[:1000])
    else:
        (tmp_path / "set.zarr" / "size" / "c.1.0").unlink()
    with pytest.raises(CorruptedDataError, match=r"size/c\.1\.0 is missing|directory is damaged"):
        open_interactions(url)


def kill_a_worker(client):
    pids = list(client.run(os.getpid).values())
    os.kill(random.choice(pids), signal.SIGKILL)


@pytest.mark.slow
def test_a_killed_worker_is_no_loss(both, undisturbed, tmp_path):
    path, killed = tmp_path / "set.zarr.zip", []

    def kill():
        while not list(tmp_path.glob(".set*.chunks/tasks/*.json")):
            time.sleep(0.005)
        kill_a_worker(both)
        killed.append(len(list(tmp_path.glob(".set*.chunks/tasks/*.json"))))

    thread = threading.Thread(target=kill)
    thread.start()
    collect_set(LONGER, path, both, progress=False)
    thread.join()
    assert killed[0] < 6
    assert path.read_bytes() == undisturbed(LONGER).read_bytes()


@pytest.mark.slow
def test_a_chunk_that_cannot_be_made_is_named(both, undisturbed, tmp_path):
    path, log = tmp_path / "set.zarr.zip", tmp_path / "log"
    reason = r"interactions 6 to 7 could not be collected: ValueError: math domain error"
    with poisoned(both, log, "raise"), pytest.raises(RuntimeError, match=reason):
        collect_set(LONGER, path, both, progress=False)
    assert len(log.read_text()) == 1
    assert not path.exists()
    assert list(tmp_path.glob(".set*.chunks/tasks/*.json"))
    collect_set(LONGER, path, both, progress=False)
    assert path.read_bytes() == undisturbed(LONGER).read_bytes()


@pytest.mark.slow
def test_a_chunk_that_kills_its_workers_is_named(both, tmp_path):
    def allow(failures, dask_scheduler):
        dask_scheduler.allowed_failures, before = failures, dask_scheduler.allowed_failures
        return before

    path, log = tmp_path / "set.zarr", tmp_path / "log"
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
    with pytest.raises(CorruptedDataError, match="not finished"):
        open_interactions(path)
    made = {p.stem for p in (path / "tasks").iterdir()}
    assert made >= {f"{k:08d}" for k in range(3)}  # though they died with its workers
    assert f"{3:08d}" not in made


@pytest.mark.slow
def test_make_data_collects_with_a_scheduler(both, undisturbed, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(make_data, "RECIPES", {"push": SMALL})
    address = ["--scheduler", both.scheduler.address]
    assert make_data.main(["--only", "push", "--to", str(tmp_path), *address]) == 1
    assert "not the same: 6 interactions, formerly 500" in capsys.readouterr().out
    assert (tmp_path / "push.zarr.zip").read_bytes() == undisturbed(SMALL).read_bytes()


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(10))
def test_workers_killed_at_any_moment_are_no_loss(both, undisturbed, tmp_path, seed):
    path = tmp_path / "set.zarr.zip"
    timer = threading.Timer(random.Random(seed).uniform(0, 0.6), kill_a_worker, [both])
    timer.start()
    collect_set(LONGER, path, both, progress=False)
    timer.join()
    assert path.read_bytes() == undisturbed(LONGER).read_bytes()
