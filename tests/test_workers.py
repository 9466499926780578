"""Processes of this machine: who can reach them, and how what they do ends, well or not."""

import os
import signal
import subprocess
import sys
import time

import psutil
import pytest

from affordlib.interactions.recipes import Recipe
from affordlib.workers import dask_client

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("small_chunks")]

SCRIPT = """
import sys
from affordlib.interactions import collect
from affordlib.interactions.recipes import Recipe

print("started", flush=True)
collect.CHUNK = 2
recipe = Recipe(n_interactions=int(sys.argv[2]), seed=11)
collect.collect(recipe, sys.argv[1], workers=2, progress=False)
"""
LIMITED = """
import resource, signal
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (12000, resource.RLIM_INFINITY))
"""


def start(*arguments, **options):
    """Start Python so that Ctrl-C reaches it, though jobs in the background ignore that."""

    def heed():
        os.setsid()
        signal.signal(signal.SIGINT, signal.default_int_handler)

    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    return subprocess.Popen([sys.executable, *arguments], preexec_fn=heed, **pipes, **options)


def wait_for(what, process):
    deadline = time.monotonic() + 120
    while not what():
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < deadline
        time.sleep(0.05)


def test_nobody_outside_reaches_a_scheduler_or_its_workers():
    with dask_client(2) as client:
        client.wait_for_workers(2, timeout=60)
        here = psutil.Process()
        family = [here, *here.children(recursive=True)]
        listening = [
            connection.laddr.ip
            for process in family
            for connection in process.net_connections("inet")
            if connection.status == psutil.CONN_LISTEN
        ]
        assert len(listening) >= 5  # the scheduler's, and at least two of each worker
        assert set(listening) == {"127.0.0.1"}


def test_a_script_needs_no_guard(undisturbed, tmp_path):
    script = tmp_path / "script.py"
    script.write_text(SCRIPT)
    with script.open() as text:
        processes = {
            "a.zarr.zip": start(script, tmp_path / "a.zarr.zip", "6", stdin=subprocess.DEVNULL),
            "b.zarr.zip": start("-", tmp_path / "b.zarr.zip", "6", stdin=text),
        }
        for name, process in processes.items():
            out, err = process.communicate(timeout=120)
            assert (process.returncode, out, err) == (0, "started\n", "")
            whole = undisturbed(Recipe(n_interactions=6, seed=11)).read_bytes()
            assert (tmp_path / name).read_bytes() == whole
    assert {p.name for p in tmp_path.iterdir()} == {"script.py", *processes}


def test_a_full_disk_ends_collecting_with_one_error(tmp_path):
    path = tmp_path / "set.zarr.zip"
    process = start("-c", LIMITED + SCRIPT, path, "6", stdin=subprocess.DEVNULL)
    out, err = process.communicate(timeout=120)
    assert process.returncode == 1
    assert out == "started\n"
    failed, kept = err.splitlines()[-2:]
    assert failed.startswith("OSError:")
    assert "File too large" in failed
    assert kept == "finished chunks are kept; collect into the same path to go on"
    assert err.count("Traceback") == 1
    for noise in ("distributed", "leaked", "still alive"):
        assert noise not in err.replace("/distributed/", "")
    assert not path.exists()


def test_ctrl_c_ends_collecting_with_one_error(tmp_path):
    process = start("-c", SCRIPT, tmp_path / "set.zarr.zip", "100", stdin=subprocess.DEVNULL)
    wait_for(lambda: list(tmp_path.glob(".set*.parts/*.npz")), process)
    os.killpg(process.pid, signal.SIGINT)  # as a terminal does
    _, err = process.communicate(timeout=60)
    assert process.returncode == -signal.SIGINT
    assert err.count("Traceback") == 1
    assert err.splitlines()[-2:] == [
        "KeyboardInterrupt",
        "finished chunks are kept; collect into the same path to go on",
    ]


def test_make_data_is_ended_with_one_line(tmp_path):
    arguments = ["data", "--only", "push", "--to", tmp_path, "--workers", "2"]
    process = start("-m", "experiments.shipped", *arguments)
    family = []

    def at_work():
        family[:] = psutil.Process(process.pid).children(recursive=True)
        return (tmp_path / ".push.zarr.zip.lock").exists() and len(family) >= 4

    wait_for(at_work, process)
    time.sleep(2)
    process.terminate()
    _, err = process.communicate(timeout=60)
    assert process.returncode == 128 + signal.SIGTERM
    assert err.splitlines()[-1] == (
        "shipped: interrupted; what is finished is kept, the same command goes on"
    )
    assert "Traceback" not in err
    assert "distributed" not in err
    assert not psutil.wait_procs(family, timeout=20)[1]
    assert not (tmp_path / "push.zarr.zip").exists()


def test_a_killed_collector_leaves_no_workers(tmp_path):
    process = start("-c", SCRIPT, tmp_path / "set.zarr.zip", "100", stdin=subprocess.DEVNULL)
    wait_for(lambda: list(tmp_path.glob(".set*.parts/*.npz")), process)
    family = psutil.Process(process.pid).children(recursive=True)
    process.kill()
    assert not psutil.wait_procs(family, timeout=60)[1]
    process.communicate()
