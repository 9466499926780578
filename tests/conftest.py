"""Shared fixtures."""

import numpy as np
import pytest
import torch

from affordlib.interactions import open_interactions
from affordlib.interactions.batches import Normaliser
from affordlib.models import AffordanceCNP, CNPConfig, load_checkpoint
from affordlib.world import Cuboid, Tabletop


@pytest.fixture(scope="session")
def world():
    with Tabletop() as tabletop:
        yield tabletop


@pytest.fixture(scope="session")
def pushes():
    return open_interactions("push")


@pytest.fixture
def untrained():
    torch.manual_seed(0)
    normaliser = Normaliser((0.1, 0.1), (0.03, 0.03), (0.99, 0.13), (0.02, 0.33))
    return AffordanceCNP(CNPConfig(), normaliser).eval()


@pytest.fixture(scope="session")
def trained():
    return load_checkpoint("push_cnp")[0]


@pytest.fixture(scope="session")
def film():
    return load_checkpoint("push_film")[0]


@pytest.fixture(scope="session")
def cuboid_image(world):
    world.place(Cuboid(0.06, 0.05, 0.05), (0.0, 0.0), 0.3)
    return np.array(world.look())


@pytest.fixture(scope="session")
def held_out_pushes():
    return open_interactions("push_test")
