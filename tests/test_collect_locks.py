"""One collector at a time on one machine."""

import os
import signal
import subprocess
import sys

import pytest

from affordlib.interactions.collect import collect as collect_set
from affordlib.interactions.places import Place
from affordlib.interactions.recipes import Recipe
from affordlib.interactions.store import open_interactions

SMALL = Recipe(n_interactions=6, seed=11)

pytestmark = pytest.mark.usefixtures("small_chunks")

_HOLDER = """
import sys, time
from affordlib.interactions.places import Place

with Place.of(sys.argv[1]).locked():
    print("held", flush=True)
    time.sleep(60)
"""


@pytest.mark.parametrize("name", ["x.zarr", "x.zarr.zip"])
def test_a_second_collector_is_refused(tmp_path, cheap, name):
    with (
        Place.of(tmp_path / name).locked(),
        pytest.raises(RuntimeError, match=rf"another process is collecting into .*{name}"),
    ):
        collect_set(SMALL, tmp_path / name, progress=False)
    collect_set(SMALL, tmp_path / name, progress=False)
    assert [p.name for p in tmp_path.iterdir()] == [name]


def test_a_collector_that_was_killed_holds_nothing(tmp_path, cheap):
    path = tmp_path / "x.zarr.zip"
    holder = subprocess.Popen([sys.executable, "-c", _HOLDER, str(path)], stdout=subprocess.PIPE)
    assert holder.stdout.readline() == b"held\n"
    with pytest.raises(RuntimeError, match="another process is collecting"):
        collect_set(SMALL, path, progress=False)
    os.kill(holder.pid, signal.SIGKILL)
    holder.communicate()
    assert (tmp_path / ".x.zarr.zip.lock").exists()
    collect_set(SMALL, path, progress=False)
    assert [p.name for p in tmp_path.iterdir()] == ["x.zarr.zip"]


def test_where_nothing_can_be_locked_all_write_the_same_bits(cheap):
    place = Place.of("memory://both/a.zarr")
    with place.locked():
        collect_set(SMALL, place.url, progress=False)
    assert open_interactions(place.url).sizes["interaction"] == 6
