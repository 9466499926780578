"""Small sets to collect, some of which cost nothing."""

import numpy as np
import pytest
import xarray as xr

from affordlib.interactions import collect


@pytest.fixture
def small_chunks(monkeypatch):
    monkeypatch.setattr(collect, "CHUNK", 2)


@pytest.fixture(scope="session")
def undisturbed(tmp_path_factory):
    """A function from a recipe to its file, collected in this process without any disturbance."""
    made = {}

    def make(recipe):
        if recipe not in made:
            path = tmp_path_factory.mktemp("undisturbed") / "set.zarr.zip"
            made[recipe] = collect.collect(recipe, path, progress=False)
        return made[recipe]

    return make


@pytest.fixture
def made(monkeypatch):
    """Lets interactions cost nothing; the first numbers of the chunks that are made."""
    made = []

    def attributes(recipe):
        return {"recipe": recipe.to_json()}

    def chunk(recipe, numbers):
        made.append(numbers.start)
        values = [np.random.default_rng(i).random(5000, dtype=np.float32) for i in numbers]
        return xr.Dataset({"x": (("interaction", "value"), values)}, attrs=attributes(recipe))

    monkeypatch.setattr(collect, "attributes_for", attributes)
    monkeypatch.setattr(collect, "collect_chunk", chunk)
    return made
