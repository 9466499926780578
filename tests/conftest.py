"""Shared fixtures, and the order of the test files."""

import shutil
from collections import Counter

import numpy as np
import pytest
import torch
from xdist.scheduler import LoadScopeScheduling

from affordlib.interactions import InteractionTensors, open_interactions
from affordlib.interactions.dataset import Scaler
from affordlib.models import AffordanceCNP, CNPConfig, load_checkpoint
from affordlib.models.lever_up import lever_up_tensors
from affordlib.planning import Skills
from affordlib.world import Cuboid, Tabletop, WorldConfig


def pytest_collection_modifyitems(items):
    """Start with the files of many slow tests, so that none of them runs last on one core."""
    slow = Counter(item.path for item in items if item.get_closest_marker("slow"))
    items.sort(key=lambda item: -slow[item.path])


class _ByFile(LoadScopeScheduling):
    """A file's tests run on one worker; only the pages of the book are shared by all."""

    def _split_scope(self, nodeid):
        return nodeid if "::test_run[" in nodeid else nodeid.split("::")[0]


def pytest_xdist_make_scheduler(config, log):
    return _ByFile(config, log) if config.getvalue("dist") == "loadfile" else None


once = pytest.fixture(scope="session")


@once
def one_world():
    with Tabletop() as tabletop:
        yield tabletop


@pytest.fixture
def world(one_world):
    """The session's world, with frictions and perception reset before each test."""
    one_world.config, one_world.on_step = WorldConfig(), None
    one_world.reset()
    return one_world


pushes = once(lambda: open_interactions("push"))
held_out_pushes = once(lambda: open_interactions("push_test"))
levers = once(lambda: open_interactions("lever_up").isel(interaction=slice(0, 48)).load())
levered = once(lambda levers: lever_up_tensors(levers))
trained = once(lambda: load_checkpoint("cnp_500")[0])
film = once(lambda: load_checkpoint("film_500")[0])
skills = once(lambda: Skills.load())


@pytest.fixture(scope="module")
def browser():
    """Headless Chromium."""
    from playwright.sync_api import sync_playwright

    flags = ["--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage"]
    if (path := shutil.which("chromium")) is None:
        pytest.skip("no Chromium: apt-get install chromium")
    with sync_playwright() as playwright:
        yield playwright.chromium.launch(executable_path=path, args=flags)


@pytest.fixture
def untrained():
    torch.manual_seed(0)
    scaler = Scaler((0.1, 0.1), (0.03, 0.03), (0.99, 0.13), (0.02, 0.33))
    return AffordanceCNP(CNPConfig(), scaler).eval()


@once
def cuboid_image(one_world):
    one_world.place(Cuboid(0.06, 0.05, 0.05), (0.0, 0.0), 0.3, config=WorldConfig())
    return np.array(one_world.depth_image())


@once
def some(pushes):
    """Forty pushes with the yaw of action and effect."""
    channels = ("x", "y", "yaw")
    return InteractionTensors.from_dataset(pushes, np.arange(40), channels, channels)
