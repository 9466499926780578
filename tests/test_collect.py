"""Collecting at scale: the same bits whatever is killed, cut off or shared."""

import errno
import itertools
import json
import random
import shutil
import signal
import subprocess
import sys
import time
import tracemalloc
import zipfile
from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
import xarray as xr
import zarr
from dask.distributed import Client

import affordlib
from affordlib.interactions import CorruptedDataError, collect
from affordlib.interactions.collect import collect as collect_set
from affordlib.interactions.recipes import Recipe
from affordlib.interactions.records import collect_chunk, describe
from affordlib.interactions.store import dataset_sha256, open_interactions, stored_sha256
from experiments import make_data

SMALL = Recipe(n_interactions=6, seed=11)
LONGER = Recipe(n_interactions=12, seed=5)
ROOT = Path(affordlib.__file__).parents[1]

pytestmark = pytest.mark.usefixtures("small_chunks")


@pytest.fixture(scope="module")
def arrays():
    """What the interactions left, before anything is stored."""
    return collect_chunk(SMALL, range(6))


@pytest.fixture
def folder_set(undisturbed, tmp_path):
    with zipfile.ZipFile(undisturbed(SMALL)) as archive:
        archive.extractall(tmp_path / "set.zarr")
    return tmp_path / "set.zarr"


def files_of(folder):
    return {p.relative_to(folder).as_posix(): p for p in folder.rglob("*") if p.is_file()}


# The store


@pytest.mark.slow
@pytest.mark.parametrize(
    "path",
    ["a.zarr.zip", "a.zarr", "file://{}/a.zarr", "memory://{}/a.zarr", "memory://m.zarr.zip"],
)
def test_wherever_it_lies_it_holds_what_the_interactions_left(tmp_path, monkeypatch, arrays, path):
    monkeypatch.chdir(tmp_path)
    path = collect_set(SMALL, path.format(tmp_path), progress=False)
    read = open_interactions(path)
    assert sorted(read.variables) == sorted(arrays)
    for name, array in arrays.items():
        np.testing.assert_array_equal(read[name].values, array)
        assert read[name].dtype == array.dtype
    straight = xr.Dataset({n: ([f"{n}{k}" for k in range(a.ndim)], a) for n, a in arrays.items()})
    assert dataset_sha256(read) == dataset_sha256(straight) == stored_sha256(path)
    if "memory" not in str(path):
        assert [p.name for p in tmp_path.iterdir()] == [Path(path).name]


def test_each_file_is_written_by_one_task_with_the_promised_codecs(folder_set, arrays):
    records = [json.loads(p.read_text()) for p in sorted((folder_set / "tasks").iterdir())]
    assert [r["interactions"] for r in records] == [[0, 2], [2, 4], [4, 6]]
    written = list(itertools.chain.from_iterable(r["sha256"] for r in records))
    assert len(set(written)) == len(written)
    there = {name for name in files_of(folder_set) if "/c" in name}
    assert set(written) == there
    manifest = json.loads((folder_set / "manifest.json").read_text())
    assert manifest["files"].keys() == files_of(folder_set).keys() - {"manifest.json", "done"}
    image = zarr.open_group(folder_set, mode="r")["image"]
    blosc, crc = image.compressors
    assert (blosc.cname.value, blosc.clevel, blosc.shuffle.value) == ("zstd", 7, "shuffle")
    assert type(crc).__name__ == "Crc32cCodec"
    np.testing.assert_array_equal(image[2:4], arrays["image"][2:4])


def test_whatever_is_damaged_is_named(folder_set):
    rng = np.random.default_rng(0)
    for name, file in files_of(folder_set).items():
        whole = file.read_bytes()
        damaged = bytearray(whole)
        damaged[rng.integers(len(whole))] ^= 1 << int(rng.integers(8))
        file.write_bytes(damaged)
        with pytest.raises(CorruptedDataError, match=f"{name}.*again"):
            open_interactions(folder_set)
        file.unlink()
        with pytest.raises(CorruptedDataError, match=f"{name}.*again"):
            open_interactions(folder_set)
        file.write_bytes(whole)
    metadata = folder_set / "zarr.json"
    metadata.write_text(metadata.read_text().replace("depth mask", "mask depth"))
    with pytest.raises(CorruptedDataError, match=r"zarr\.json is not what was stored"):
        open_interactions(folder_set)


def test_a_mended_set_is_the_same_again(folder_set, monkeypatch):
    before = {name: file.read_bytes() for name, file in files_of(folder_set).items()}
    files_of(folder_set)["effect/c.1.0.0"].unlink()
    files_of(folder_set)["tasks/00000002.json"].write_text("{}")
    with files_of(folder_set)["image/c.0.0.0.0"].open("r+b") as file:
        file.truncate(100)
    (folder_set / "effect" / ".killed.partial").write_text("what a killed worker left")
    made = []

    def counted(recipe, indices):
        assert not (folder_set / "done").exists()
        made.append(indices.start)
        return collect_chunk(recipe, indices)

    monkeypatch.setattr(collect, "collect_chunk", counted)
    collect_set(SMALL, folder_set, progress=False)
    assert made == [0, 2, 4]
    assert {name: file.read_bytes() for name, file in files_of(folder_set).items()} == before
    collect_set(SMALL, folder_set, progress=False)
    assert made == [0, 2, 4]


def test_a_folder_of_another_recipe_is_left_alone(folder_set):
    before = {name: file.read_bytes() for name, file in files_of(folder_set).items()}
    with pytest.raises(ValueError, match=r"set\.zarr holds a set of another recipe"):
        collect_set(Recipe(n_interactions=6, seed=12), folder_set, progress=False)
    assert {name: file.read_bytes() for name, file in files_of(folder_set).items()} == before


def test_a_zip_is_made_once_and_no_other_recipe_takes_its_place(tmp_path, cheap, monkeypatch):
    path, made = tmp_path / "x.zarr.zip", []
    collect_set(SMALL, path, progress=False)
    before = path.read_bytes()
    real = collect.collect_chunk

    def counted(recipe, indices):
        made.append(indices.start)
        return real(recipe, indices)

    monkeypatch.setattr(collect, "collect_chunk", counted)
    assert collect_set(SMALL, path, progress=False) == path
    assert made == []
    with monkeypatch.context() as other:
        layout = replace(collect.describe(SMALL, 2), attrs={"recipe": "another"})
        other.setattr(collect, "describe", lambda *_: layout)
        with pytest.raises(ValueError, match=r"x\.zarr\.zip holds a set of another recipe"):
            collect_set(SMALL, path, progress=False)
    assert made == []
    assert path.read_bytes() == before
    collect_set(SMALL, path, progress=False, replace=True)
    assert made == [0, 2, 4]
    for foreign in (before[: len(before) // 2], b"notes"):
        path.write_bytes(foreign)
        with pytest.raises(ValueError, match=r"is no whole set of interactions.*replace=True"):
            collect_set(SMALL, path, progress=False)
        assert path.read_bytes() == foreign
    collect_set(SMALL, path, progress=False, replace=True)
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


def test_nothing_foreign_is_replaced_and_no_interaction_is_made(tmp_path, cheap, monkeypatch):
    monkeypatch.setattr(collect, "collect_chunk", lambda *_: pytest.fail("it collects"))
    (tmp_path / "f.zarr.zip").mkdir()
    (tmp_path / "l.zarr.zip").symlink_to(tmp_path / "nowhere")
    (tmp_path / "d.zarr").mkdir()
    (tmp_path / "d.zarr" / "notes").write_text("mine")
    (tmp_path / "n.zarr").write_text("mine")
    before = sorted(tmp_path.rglob("*"))
    for name in ("f.zarr.zip", "l.zarr.zip", "d.zarr", "n.zarr"):
        with pytest.raises(ValueError, match=rf"path .*{name}.* (choose|delete)"):
            collect_set(SMALL, tmp_path / name, progress=False)
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.parametrize("spoil", [{"x": np.zeros(2)}, {"x": np.zeros((3, 2), "f4")}, {}])
def test_a_chunk_that_is_not_what_was_described_is_refused(tmp_path, cheap, spoil, monkeypatch):
    monkeypatch.setattr(collect, "collect_chunk", lambda *_: spoil)
    with pytest.raises(RuntimeError, match=r"interactions 0 to 1 .*'x'"):
        collect_set(SMALL, tmp_path / "x.zarr", progress=False)


def test_a_worker_with_other_packages_is_refused(tmp_path, monkeypatch):
    numpys = iter(("2.4.6", "1.0"))
    layouts = (replace(describe(SMALL, 2), attrs={"versions": f"numpy={n}"}) for n in numpys)
    monkeypatch.setattr(collect, "describe", lambda *_: next(layouts))
    with pytest.raises(RuntimeError, match=r"another set .*numpy=1\.0.*, not .*numpy=2\.4\.6"):
        collect_set(SMALL, tmp_path / "x.zarr", progress=False)


def test_paths_and_workers_that_cannot_be_are_named(tmp_path):
    with pytest.raises(ValueError, match=r"path must end in .*'\.zarr', got .*x\.zip"):
        collect_set(SMALL, tmp_path / "x.zip")
    with pytest.raises(ValueError, match=r"workers must be a whole number .* 0"):
        collect_set(SMALL, tmp_path / "x.zarr", workers=0)
    with pytest.raises(ValueError, match=r"memory of one process.*workers=1"):
        collect_set(SMALL, "memory://x.zarr", workers=2)
    with pytest.raises(ValueError, match=r"memory of one process.*workers=1"):
        collect_set(SMALL, "memory://x.zarr", client=Mock(spec=Client))
    with pytest.raises(FileNotFoundError, match=r"there is no file .*x\.zarr; .*'push'"):
        open_interactions(tmp_path / "x.zarr")


# Memory


@pytest.mark.slow
def test_memory_does_not_grow_with_the_set(tmp_path, cheap, monkeypatch):
    monkeypatch.setattr(collect, "CHUNK", 50)

    def peak(n):
        tracemalloc.start()
        collect_set(Recipe(n_interactions=n), tmp_path / f"{n}.zarr.zip", progress=False)
        found = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return found

    peak(50)  # what is imported and cached once
    few, many = peak(200), peak(2000)
    # The whole of 2,000 would be 40 MB; names and hashes of the files are all that grows.
    assert few > 1_000_000
    assert many < few + 4_000_000
    assert (tmp_path / "2000.zarr.zip").stat().st_size > 30_000_000


# Kills in one process

_DRIVER = """
import os, signal, sys
from affordlib.interactions import collect, places, store
from affordlib.interactions.recipes import Recipe

collect.CHUNK = 2
part, name, count, workers = sys.argv[2], sys.argv[3], int(sys.argv[4]), int(sys.argv[5])
owner = {"write": places.Place, "writestr": store.zipfile.ZipFile, "rmtree": places.shutil}[part]
whole = getattr(owner, part)

def deadly(*arguments, **options):
    global count
    count -= name in str(arguments[0] if part == "rmtree" else arguments[1])
    if count < 0:
        os.kill(os.getpid(), signal.SIGKILL)
    return whole(*arguments, **options)

setattr(owner, part, deadly)
recipe = Recipe(n_interactions=6, seed=11)
if __name__ == "__main__":
    collect.collect(recipe, sys.argv[1], workers=workers, progress=False)
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("part", "name", "count", "chunks_done"),
    [
        ("write", "effect/c", 0, 0),  # in the first chunk
        ("write", "effect/c.1", 0, 1),  # before the second
        ("writestr", "", 9, 3),  # while packing
        # The manifest is there and its hash is not; packed and not yet tidied up.
        ("write", "done", 0, 3),
        ("rmtree", ".chunks", 0, 3),
    ],
)
def test_killed_and_run_again_it_is_the_same_file(
    undisturbed, tmp_path, part, name, count, chunks_done
):
    path = tmp_path / "killed.zarr.zip"
    arguments = [sys.executable, "-c", _DRIVER, str(path), part, name, str(count), "1"]
    ended = subprocess.run(arguments, cwd=ROOT, capture_output=True, text=True)
    assert ended.returncode == -signal.SIGKILL, ended.stderr
    (work,) = tmp_path.glob(".killed*.chunks")
    assert len(list(work.glob("tasks/*.json"))) == chunks_done
    if part == "rmtree":
        assert path.read_bytes() == undisturbed(SMALL).read_bytes()
    else:
        assert not path.exists()
    collect_set(SMALL, path, progress=False)
    assert path.read_bytes() == undisturbed(SMALL).read_bytes()
    assert [p.name for p in tmp_path.iterdir()] == ["killed.zarr.zip"]


@pytest.mark.slow
@pytest.mark.parametrize("suffix", [".zarr", ".zarr.zip"])
def test_a_full_disk_leaves_nothing_that_is_read(undisturbed, tmp_path, monkeypatch, suffix):
    path = tmp_path / f"full{suffix}"
    room = 0

    def write(self, content):
        nonlocal room
        room -= 1
        with open(self, "wb") as file:
            file.write(content if room >= 0 else content[: len(content) // 2])
        if room < 0:
            raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(Path, "write_bytes", write)
        for files in (3, 14, 10, 16, 13, 1, 14):  # from the metadata to the last file, `done`
            room = files
            with pytest.raises((OSError, RuntimeError), match="No space left"):
                collect_set(SMALL, path, progress=False)
            with pytest.raises((FileNotFoundError, CorruptedDataError), match="no file"):
                open_interactions(path)
    with monkeypatch.context() as patch:
        patch.setattr(zipfile.ZipFile, "writestr", write_nothing)
        if suffix == ".zarr.zip":
            with pytest.raises(OSError, match="No space left"):
                collect_set(SMALL, path, progress=False)
            assert not path.exists()
    collect_set(SMALL, path, progress=False)
    expected = open_interactions(undisturbed(SMALL))
    assert dataset_sha256(open_interactions(path)) == dataset_sha256(expected)
    assert [p.name for p in tmp_path.iterdir()] == [path.name]
    assert not list(tmp_path.rglob("*.partial"))


def write_nothing(*_):
    raise OSError(errno.ENOSPC, "No space left on device")


# Comparing, and killed by chance


def test_make_data_says_how_far_apart_two_sets_are(undisturbed):
    old = open_interactions(undisturbed(SMALL))
    assert make_data.compare(old, old) == (True, "the same, bit for bit")
    for gap_m, agree in ((0.00004, True), (0.00006, False)):
        new = old.copy(deep=True)
        new["rest_effect"][:, 1] += gap_m
        same, sentence = make_data.compare(old, new)
        assert same is agree
        assert f"{gap_m * 1000:.3f} mm in the median (tolerance 0.05 mm)" in sentence
    one = old.copy(deep=True)
    one["rest_effect"][0, 0] += 0.05  # one object that tipped over the other way
    assert make_data.compare(old, one)[0]
    assert not make_data.compare(old, old.isel(interaction=slice(3)))[0]


@pytest.mark.slow
def test_make_data_ends_with_status_1_when_the_sets_differ(
    undisturbed, tmp_path, monkeypatch, capsys
):
    monkeypatch.setattr(make_data, "RECIPES", {"push": SMALL, "turned": LONGER})
    arguments = ["--only", "push", "--to", str(tmp_path), "--workers", "1"]
    shutil.copy(undisturbed(SMALL), tmp_path / "former.zarr.zip")
    former = {"push": tmp_path / "former.zarr.zip"}
    monkeypatch.setattr(
        make_data, "open_interactions", lambda name: open_interactions(former.get(name, name))
    )
    assert make_data.main(arguments) == 0
    assert "push: the same, bit for bit" in capsys.readouterr().out
    former["push"] = undisturbed(LONGER)
    assert make_data.main(arguments) == 1
    assert "not the same: 6 interactions, formerly 12" in capsys.readouterr().out


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(10))
def test_a_driver_killed_at_any_moment_is_no_loss(undisturbed, tmp_path, seed):
    path = tmp_path / "set.zarr.zip"
    never, workers = ["write", "no such name", "1"], str(1 + seed % 2)
    process = subprocess.Popen(
        [sys.executable, "-c", _DRIVER, str(path), *never, workers],
        cwd=ROOT,
        stderr=subprocess.DEVNULL,
    )
    deadline = time.monotonic() + 60
    while not list(tmp_path.glob(".set*.chunks")) and time.monotonic() < deadline:
        time.sleep(0.002)
    time.sleep(random.Random(seed).uniform(0, 0.7))
    process.kill()
    process.wait()
    collect_set(SMALL, path, progress=False)
    assert path.read_bytes() == undisturbed(SMALL).read_bytes()
    assert [p.name for p in tmp_path.iterdir()] == ["set.zarr.zip"]
