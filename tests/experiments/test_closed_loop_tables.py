"""Tables of the closed loop: trials by seed, the kinematic oracle, row contents."""

import math
from dataclasses import replace

import numpy as np
import pytest

from affordlib.primitives import Drag, Push
from affordlib.world import Cuboid, WorldConfig
from experiments import closed_loop
from experiments.closed_loop import N_TRIALS, run_trial, sample_trial
from experiments.feasibility import is_feasible, on_the_rim, possible


def test_the_kinematic_oracle_is_the_kinematics(world):
    """Its circles around the base agree with the inverse kinematics of whole actions."""
    rng = np.random.default_rng(11)
    world.place(Cuboid(0.06, 0.05, 0.05), (0.0, 0.0))
    no = 0
    for _ in range(80):
        xy, angle = rng.uniform([-0.45, -0.65], [0.65, 0.65]), rng.uniform(-math.pi, math.pi)
        for kind, half in ((Push, 0.02), (Drag, 0.0)):
            action = kind.towards(angle)
            query = xy[None], np.array([angle]), np.array([action.length + half])
            said, near, far = (possible(kind, half, s)(*query)[0] for s in (0.0, 0.004, -0.004))
            truth = world.can_reach(action, 1.0, tuple(xy))
            assert truth == said or near != far
            no += not truth
    assert no > 10


def test_an_object_cannot_be_pushed_back_from_where_it_can_be_pushed_to():
    outside, middle = (0.555, 0.0), (0.0, 0.0)
    assert is_feasible(Push, 0.03, middle, outside)
    assert not is_feasible(Push, 0.03, outside, middle)
    assert is_feasible(Drag, 0.03, outside, middle)
    assert not is_feasible(Drag, 0.03, middle, (0.68, 0.68))
    assert on_the_rim(Drag, 0.03, middle, (0.566, 0.0))


def test_trials_are_a_function_of_seed_and_number():
    for name in N_TRIALS:
        assert sample_trial(name, 5, 3) == sample_trial(name, 5, 3)
        assert sample_trial(name, 5, 3) != sample_trial(name, 5, 4)
        perturbed = sample_trial(name, 5, 3, "perturbed")
        assert perturbed.config.camera == "kinect"
        assert replace(perturbed, config=WorldConfig()) == sample_trial(name, 5, 3)
    with pytest.raises(ValueError, match="table must be one of"):
        sample_trial("speed", 0)


def test_an_open_loop_trial_measures_what_is_missing(monkeypatch):
    found, trial = run_trial("height", 0, world="open_loop"), sample_trial("height", 0)
    assert max(abs(found["height_error_m"]), found["distance_m"]) < 0.005
    # An empty plan has the whole height as its error, and does not move the object.
    monkeypatch.setattr(closed_loop, "execute_plan", lambda *_: None)
    idle = run_trial("height", 0, world="open_loop")
    assert abs(idle["height_error_m"]) == pytest.approx(trial.goal.height_m, abs=1e-4)
    assert idle["distance_m"] == pytest.approx(np.hypot(*trial.goal.xy_m), abs=1e-4)
