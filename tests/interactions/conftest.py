"""Small sets to collect, some of which need no simulation."""

import numpy as np
import pytest
import xarray as xr

from affordlib.interactions import collect


@pytest.fixture
def small_chunks(monkeypatch):
    monkeypatch.setattr(collect, "CHUNK", 2)


@pytest.fixture(scope="session")
def undisturbed(tmp_path_factory):
    """A function that collects a recipe in this process, uninterrupted, and returns its file."""
    made = {}

    def make(recipe):
        if recipe not in made:
            path = tmp_path_factory.mktemp("undisturbed") / "set.zarr.zip"
            made[recipe] = collect.collect(recipe, path, progress=False)
        return made[recipe]

    return make


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
