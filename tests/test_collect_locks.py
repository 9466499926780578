"""One collector at a time: locks of this machine, and leases elsewhere."""

import threading
import time
from pathlib import Path

import numpy as np
import pytest

import affordlib
from affordlib.interactions import CorruptedDataError, collect, locks
from affordlib.interactions.collect import collect as collect_set
from affordlib.interactions.locks import exclusive
from affordlib.interactions.places import Place
from affordlib.interactions.recipes import Recipe
from affordlib.interactions.store import open_interactions

SMALL = Recipe(n_interactions=6, seed=11)
LONGER = Recipe(n_interactions=12, seed=5)
ROOT = Path(affordlib.__file__).parents[1]

pytestmark = pytest.mark.usefixtures("small_chunks")


@pytest.mark.parametrize("name", ["x.zarr", "x.zarr.zip"])
def test_a_second_collector_is_refused(tmp_path, cheap, name):
    with (
        exclusive(Place.of(tmp_path / name)),
        pytest.raises(RuntimeError, match=rf"another process is collecting into .*{name}"),
    ):
        collect_set(SMALL, tmp_path / name, progress=False)
    collect_set(SMALL, tmp_path / name, progress=False)
    assert [p.name for p in tmp_path.iterdir()] == [name]


@pytest.fixture
def lease(monkeypatch):
    monkeypatch.setattr(locks, "LEASE_S", 0.5)
    monkeypatch.setattr(locks, "RENEW_S", 0.05)
    monkeypatch.setattr(locks, "SETTLE_S", 0.1)
    return lambda place: place.sibling(f".{place.name}.lock")


def test_a_lease_that_moves_is_respected_and_then_given_back(lease, cheap):
    place = Place.of("memory://lease/a.zarr")
    with exclusive(place) as still_ours:
        time.sleep(1)  # longer than the lease lasts without renewal
        with pytest.raises(RuntimeError, match=r"collecting into memory://lease/a\.zarr"):
            collect_set(SMALL, place.url, progress=False)
        still_ours()
    assert not lease(place).read(["lease"])
    collect_set(SMALL, place.url, progress=False)
    assert open_interactions(place.url).sizes["interaction"] == 6


def test_a_lease_whose_owner_was_killed_is_taken_over(lease, cheap):
    place = Place.of("memory://lease/b.zarr")
    lease(place).make_folders(["lease"])
    lease(place).write("lease", b'{"owner": "a dead one", "count": 7}')
    began = time.monotonic()
    with exclusive(place):
        assert time.monotonic() - began > 0.5
        assert b"dead" not in lease(place).read(["lease"])["lease"]
    assert not lease(place).read(["lease"])


def test_a_collector_that_lost_its_lease_stops(lease, cheap, monkeypatch):
    place = Place.of("memory://lease/c.zarr")

    def slow(recipe, indices):
        time.sleep(0.1)
        lease(place).write("lease", b'{"owner": "another", "count": 1}')
        time.sleep(0.2)
        return {"x": np.zeros((2, 5000), np.float32)}

    monkeypatch.setattr(collect, "collect_chunk", slow)
    with pytest.raises(RuntimeError, match=r"the lock on .*c\.zarr was lost"):
        collect_set(SMALL, place.url, progress=False)
    assert b"another" in lease(place).read(["lease"])["lease"]
    with pytest.raises(CorruptedDataError, match="not finished"):
        open_interactions(place.url)


def test_of_many_that_come_at_once_one_holds_the_lease(lease, monkeypatch):
    place, outcomes, barrier = Place.of("memory://lease/d.zarr"), [], threading.Barrier(6)
    # All have seen that there is no lease before the first one writes its own.
    monkeypatch.setattr(Place, "make_folders", lambda *_: barrier.wait())

    def take():
        try:
            with exclusive(place):
                time.sleep(1)
                outcomes.append("held")
        except RuntimeError:
            outcomes.append("refused")

    threads = [threading.Thread(target=take) for _ in range(6)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(outcomes) == ["held"] + ["refused"] * 5
