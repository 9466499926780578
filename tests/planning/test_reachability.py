"""Learned reachability compared with the arm's kinematics, which it does not use."""

import math

import numpy as np
import pytest

from affordlib import primitives
from affordlib.interactions import open_interactions
from affordlib.planning.skills import Reachability
from affordlib.primitives import Drag, Grasp, Push, Rotate
from experiments.shipped import learn_reachability

KINDS = {"push": Push.towards, "drag": Drag.towards}
KINDS |= {"grasp": lambda _: Grasp(), "rotate": lambda _: Rotate()}


@pytest.fixture(scope="module")
def learned():
    return learn_reachability(open_interactions("reach"))


def test_it_agrees_with_kinematics_on_places_it_has_not_seen(learned, world):
    rng = np.random.default_rng(5)
    right = {True: [], False: []}
    for name, make in KINDS.items():
        for _ in range(250):
            xy, angle = rng.uniform([-0.42, -0.62], [0.62, 0.62]), rng.uniform(-math.pi, math.pi)
            truth = world.can_reach(make(angle), 1.0, xy)
            direction = angle if name in ("push", "drag") else None
            said = learned.probability(name, xy, direction)[0] > 0.5
            right[truth].append(said == truth)
    assert np.mean(right[True] + right[False]) >= 0.97
    assert 1 - np.mean(right[False]) < 0.15  # false 'reachable'
    assert len(right[False]) > 60


def test_the_shipped_one_was_learned_so(learned, tmp_path):
    """Rounding differs between processors, without consequences."""
    shipped = Reachability.load()
    rng = np.random.default_rng(6)
    places = rng.uniform([-0.42, -0.62], [0.62, 0.62], (4000, 2))
    angles = rng.uniform(-math.pi, math.pi, 4000)
    for name in KINDS:
        turn = angles if name in ("push", "drag") else None
        old, new = (m.probability(name, places, turn) for m in (shipped, learned))
        assert np.mean((old > 0.2) == (new > 0.2)) > 0.99
    learned.save(tmp_path / "mine.safetensors")
    mine = Reachability.load(tmp_path / "mine.safetensors").probability("push", places, angles)
    np.testing.assert_array_equal(mine, learned.probability("push", places, angles))
    assert [path.name for path in tmp_path.iterdir()] == ["mine.safetensors"]


def test_a_primitive_that_was_not_learned_is_left_to_the_kinematics(monkeypatch):
    monkeypatch.setitem(primitives.PRIMITIVES, "tap", type("Tap", (Push,), {"name": "tap"}))
    assert (Reachability.load().probability("tap", np.zeros((2, 2))) == 1.0).all()


def test_an_unknown_primitive_and_other_shapes_are_told(learned):
    with pytest.raises(ValueError, match=r"primitive must be one of .*, got 'kick'"):
        learned.probability("kick", np.zeros((1, 2)))
    with pytest.raises(ValueError, match=r"xy_m must be finite numbers of shape"):
        learned.probability("push", np.zeros((2, 3)), 0.0)
    with pytest.raises(ValueError, match=r"direction_rad must be finite numbers of shape"):
        learned.probability("push", np.zeros((2, 2)), np.zeros(3))
