"""Lever-ups: baselines, jobs, tables drawn from their results, and what is shipped."""

import math

import numpy as np
import pytest
import torch

from affordlib.interactions import open_interactions
from affordlib.interactions.lever_up import lever_up_tensors
from affordlib.models import load_checkpoint
from affordlib.models.lever_up import (
    LEVER_MODELS,
    PROTOCOLS,
    from_start_errors_m,
    window_errors_m,
)
from affordlib.paths import repo_root
from experiments import lever_up
from experiments.lever_cross_validation import (
    edges_of,
    extrapolate,
    job,
    lever_split,
)
from experiments.runner import run
from experiments.shipped import shipped_lever_model


def test_baselines_are_right_about_what_they_assume():
    steps = torch.arange(26.0)[None, :, None]
    still, steady = torch.ones(1, 26, 4), steps.expand(1, 26, 4)
    for baseline, trajectory in (("persistence", still), ("constant_velocity", steady)):
        mean, truth = extrapolate(baseline, trajectory, "window", 3)
        torch.testing.assert_close(mean, truth)
    mean, truth = extrapolate("persistence", steady, "window", 0)
    assert (truth - mean)[0, :, 0].tolist() == [1, 2, 3, 4, 5]
    mean, truth = extrapolate("constant_velocity", steady, "first_step")
    assert mean.abs().max() == 0
    assert truth.shape[1] == 25


@pytest.mark.slow
def test_folds_test_every_object_at_most_once():
    whole = open_interactions("lever_up")
    splits = [lever_split(whole, fold) for fold in range(5)]
    tests = np.concatenate([s.test for s in splits])
    assert len(set(tests)) == len(tests) == 900
    for split in splits:
        parts = [set(p) for p in (split.train, split.validation, split.test)]
        assert [len(p) for p in parts] == [1440, 180, 180]
        assert len(set.union(*parts)) == 1800
    edges = edges_of(whole)
    split = lever_split(whole, edges_left_out=3)
    assert set(edges[split.test]) == {3}
    assert 3 not in edges[np.concatenate([split.train, split.validation])]


def test_a_job_gives_the_committed_errors_again(tmp_path):
    one = job("persistence")
    (again,) = run([one], "lever_up", folder=tmp_path, progress=False)
    (committed,) = run([one], "lever_up", progress=False)
    assert again["interaction"] == committed["interaction"]
    for name in PROTOCOLS:  # rounded to 1e-4 cm, and the last digit is another processor's
        errors = again[name]["error_cm"], committed[name]["error_cm"]
        assert all(abs(a - b) < 5e-4 for a, b in zip(*map(flattened, errors), strict=True))


def flattened(nested):
    return [x for part in nested for x in flattened(part)] if isinstance(nested, list) else [nested]


def _result(errors_cm, model="cnp_last_pose", trained_for="all", fold=0, left_out=None, **more):
    tests = {p: {"error_cm": [[[e] * 5] * 7 for e in errors_cm]} for p in PROTOCOLS}
    one = job(model, trained_for, fold, left_out, **more)
    return one.arguments, {"interaction": list(range(len(errors_cm)))} | tests


def test_differences_are_paired_by_object():
    ours = _result([0.1, 0.5, 1.0])
    rival = _result([0.2, 0.6, 1.1], "lstm_tuned", "window")
    (row, *_) = lever_up.paired_rows([ours, rival])
    assert row["difference_cm"] == pytest.approx(-0.1)
    assert row["low_cm"] == pytest.approx(row["high_cm"])  # the same for all objects
    assert row["ours_better_percent"] == 100
    seker = _result([0.1, 0.5, 1.0], "lstm_seker2019", "window", fold=1, epochs=100)
    ours_too = _result([0.3, 0.7, 1.2], fold=1)
    rows = lever_up.paired_rows([ours, ours_too, rival, seker])
    apart = {(r["rival"], r["n"]): r["difference_cm"] for r in rows if r["steps"] == 5}
    assert apart == {  # of each rival the folds that it has
        ("lstm_tuned", 3): pytest.approx(-0.1),
        ("lstm_seker2019", 3): pytest.approx(0.2),
    }
    first = lever_up.error_rows([ours])[0]
    assert first["mean_cm"] == pytest.approx(1.6 / 3)
    assert first["sem_cm"] == pytest.approx(np.std([0.1, 0.5, 1.0], ddof=1) / math.sqrt(3))


def test_trainings_of_other_lengths_are_not_pooled():
    results = [
        _result([e], "lstm_seker2019", "window", epochs=n) for n, e in ((20, 2.0), (100, 1.0))
    ]
    rows = lever_up.error_rows(results)
    assert {(r["epochs"], r["n"], r["mean_cm"]) for r in rows} == {(20, 1, 2.0), (100, 1, 1.0)}


def test_shapes_never_seen_stand_beside_the_same_shapes_when_they_are_known():
    known, unseen = _result([0.1, 0.5, 1.0]), _result([0.4, 0.6], left_out=3)
    rows = lever_up.unseen_rows([known, unseen], {0: 3, 1: 4, 2: 3})
    assert {row["edges"] for row in rows} == {3}
    assert (rows[0]["n"], rows[0]["mean_cm"]) == (2, pytest.approx(0.5))
    assert (rows[0]["known_n"], rows[0]["known_mean_cm"]) == (2, pytest.approx(0.55))
    assert {row["n"] for row in lever_up.error_rows([known, unseen])} == {3}  # the folds only


def test_the_shipped_network_stands_for_its_own_training_only():
    whole = open_interactions("lever_up")
    training = "cnp_last_pose", "all", LEVER_MODELS["cnp_last_pose"]
    split = lever_split(whole)
    found = shipped_lever_model(*training, whole, split)
    assert found[1] == {"checkpoint": "lever_up_last_pose_1800"}
    other = whole.assign(effect=2 * whole["effect"])  # the same numbers of interactions
    assert shipped_lever_model(*training, other, split) is None


@pytest.mark.parametrize(
    "name",
    ["lever_up_last_pose_1800", "lever_up_lstm_1800_window", "lever_up_lstm_1800_first_step"],
)
def test_shipped_checkpoints_predict_what_they_have_not_seen(name):
    whole = open_interactions("lever_up")
    model, about = load_checkpoint(name)
    split = lever_split(whole)
    assert not set(about["seen_interactions"]) & set(split.test)
    few = lever_up_tensors(whole, split.test[:60], about["view"])
    if about["trained_for"] != "first_step":
        assert 100 * window_errors_m(model, few).mean() < 0.3
    if about["trained_for"] != "window":
        assert 100 * from_start_errors_m(model, few).mean() < 0.4
    size = (repo_root() / "data" / "checkpoints" / f"{name}.safetensors").stat().st_size
    assert size < 5e6
