"""Lever-ups: baselines, units and their parts, tables, and what is shipped."""

import json
import math
from dataclasses import asdict

import numpy as np
import pytest
import torch

from affordlib.interactions import open_interactions
from affordlib.interactions.lever_up import lever_up_tensors
from affordlib.models import load_checkpoint
from affordlib.models.lever import (
    LEVER_MODELS,
    PROTOCOLS,
    TRAINING,
    beginning_errors_m,
    window_errors_m,
)
from affordlib.paths import repo_root
from experiments import lever_tables, lever_up
from experiments.lever_tuning import SETTINGS, TRAINED, changed
from experiments.lever_up import LeverUnit, guess, run_unit, split_of
from experiments.shipped import shipped_lever_model


def test_baselines_are_right_about_what_they_assume():
    steps = torch.arange(26.0)[None, :, None]
    still, steady = torch.ones(1, 26, 4), steps.expand(1, 26, 4)
    for baseline, course in (("persistence", still), ("constant_velocity", steady)):
        mean, truth = guess(baseline, course, "window", 3)
        torch.testing.assert_close(mean, truth)
    mean, truth = guess("persistence", steady, "window", 0)
    assert (truth - mean)[0, :, 0].tolist() == [1, 2, 3, 4, 5]
    mean, truth = guess("constant_velocity", steady, "first_step")
    assert mean.abs().max() == 0
    assert truth.shape[1] == 25


@pytest.mark.parametrize(
    ("fields", "reason"),
    [
        ({"model": "gru"}, "model must be one of"),
        ({"model": "anchored", "fold": 5}, r"fold must lie in \[0, 4\], got 5"),
        ({"model": "lstm_tuned"}, "trained for one protocol each"),
        ({"model": "anchored_single"}, "trained for one protocol each"),
        ({"model": "anchored", "trained_for": "window"}, "the others for all"),
        ({"model": "anchored", "no_edges": 9}, r"no_edges must lie in \[3, 8\]"),
        ({"model": "anchored", "epochs": 2}, "epochs belong to 'lstm_published'"),
    ],
)
def test_units_that_cannot_be_are_refused(fields, reason):
    with pytest.raises(ValueError, match=reason):
        LeverUnit(**fields)


@pytest.mark.slow
def test_folds_test_every_object_at_most_once():
    whole = open_interactions("lever_up")
    splits = [split_of(LeverUnit("persistence", fold=k), whole) for k in range(5)]
    tests = np.concatenate([s.test for s in splits])
    assert len(set(tests)) == len(tests) == 900
    for split in splits:
        parts = [set(p) for p in (split.train, split.validation, split.test)]
        assert [len(p) for p in parts] == [1440, 180, 180]
        assert len(set.union(*parts)) == 1800
    edges = lever_up.edges_of(whole)
    split = split_of(LeverUnit("persistence", no_edges=3), whole)
    assert set(edges[split.test]) == {3}
    assert 3 not in edges[np.concatenate([split.train, split.validation])]


def test_units_leave_parts_that_are_not_made_again(tmp_path):
    unit = LeverUnit("constant_velocity")
    assert run_unit(unit, tmp_path)
    assert not run_unit(unit, tmp_path)
    path = tmp_path / unit.file
    part = json.loads(path.read_text())
    path.write_text(json.dumps(part | {"data_sha256": "of another set"}))
    with pytest.raises(ValueError, match=r"has another data_sha256.*run the unit again"):
        lever_tables.read_parts(tmp_path)
    assert run_unit(unit, tmp_path)
    assert json.loads(path.read_text()) == part


def _part(errors_cm):
    return {
        "interaction": list(range(len(errors_cm))),
        "tests": {p: {"error_cm": [[[e] * 5] * 7 for e in errors_cm]} for p in PROTOCOLS},
    }


def test_differences_are_paired_by_object():
    ours = (LeverUnit("anchored"), _part([0.1, 0.5, 1.0]))
    rival = (LeverUnit("lstm_tuned", "window"), _part([0.2, 0.6, 1.1]))
    (row, *_) = lever_tables.paired_rows([ours, rival])
    assert row["difference_cm"] == pytest.approx(-0.1)
    assert row["low_cm"] == pytest.approx(row["high_cm"])  # the same for all objects
    assert row["ours_better_percent"] == 100
    older = (LeverUnit("lstm_published", "window", fold=1, epochs=100), _part([0.1, 0.5, 1.0]))
    ours_too = (LeverUnit("anchored", fold=1), _part([0.3, 0.7, 1.2]))
    rows = lever_tables.paired_rows([ours, ours_too, rival, older])
    apart = {(r["rival"], r["n"]): r["difference_cm"] for r in rows if r["steps"] == 5}
    assert apart == {  # of each rival the folds that it has
        ("lstm_tuned", 3): pytest.approx(-0.1),
        ("lstm_published", 3): pytest.approx(0.2),
    }
    still = (LeverUnit("persistence"), _part([1.0, 0.1, 1.0]))
    rows = lever_tables.motion_rows([still, ours])
    moving, resting = (
        next(r for r in rows if (r["model"], r["windows"]) == ("anchored", kind))
        for kind in ("moving", "resting")
    )
    assert (moving["n_windows"], resting["n_windows"]) == (14, 7)
    assert moving["mean_cm"] == pytest.approx(0.55)
    first = lever_tables.error_rows([ours])[0]
    assert first["mean_cm"] == pytest.approx(1.6 / 3)
    assert first["sem_cm"] == pytest.approx(np.std([0.1, 0.5, 1.0], ddof=1) / math.sqrt(3))


def test_two_trainings_of_one_fold_are_not_pooled(tmp_path, monkeypatch):
    monkeypatch.setattr(lever_tables, "checked_part", lambda *asked: {})
    for epochs in (20, 100):
        unit = LeverUnit("lstm_published", "window", epochs=epochs)
        (tmp_path / unit.file).write_text(json.dumps({"unit": asdict(unit)}))
        if epochs == 20:
            assert len(lever_tables.read_parts(tmp_path)) == 1
    with pytest.raises(ValueError, match=r"20epochs.* 100|100epochs.*delete one"):
        lever_tables.read_parts(tmp_path)


def test_shapes_never_seen_stand_beside_the_same_shapes_when_they_are_known():
    known = (LeverUnit("anchored"), _part([0.1, 0.5, 1.0]))
    strange = (LeverUnit("anchored", no_edges=3), _part([0.4, 0.6]))
    rows = lever_tables.unseen_rows([known, strange], {0: 3, 1: 4, 2: 3})
    assert {row["edges"] for row in rows} == {3}
    assert (rows[0]["n"], rows[0]["mean_cm"]) == (2, pytest.approx(0.5))
    assert (rows[0]["known_n"], rows[0]["known_mean_cm"]) == (2, pytest.approx(0.55))
    assert {row["n"] for row in lever_tables.error_rows([known, strange])} == {3}  # the folds only


def test_a_setting_changes_what_it_says():
    for name, _ in TRAINED:
        ours = LEVER_MODELS[name]
        first, *others = [changed(ours, setting) for setting in SETTINGS]
        assert (first.network, first.training) == (ours.network, TRAINING)
        assert changed(ours, "rate 0.001, half the width").network.width == ours.network.width // 2
        assert changed(ours, "rate 0.004").training.learning_rate == 4e-3
        assert all(a != b for k, a in enumerate(others) for b in [first, *others[:k]])
        assert ours in others


def test_the_shipped_network_stands_for_its_own_training_only():
    whole = open_interactions("lever_up")
    asked = "anchored", "all", LEVER_MODELS["anchored"]
    split = split_of(LeverUnit("anchored"), whole)
    assert shipped_lever_model(*asked, whole, split)[1] == {"checkpoint": "lever_up_last_pose_1800"}
    other = whole.assign(effect=2 * whole["effect"])  # the same numbers of interactions
    assert shipped_lever_model(*asked, other, split) is None


@pytest.mark.parametrize(
    "name",
    ["lever_up_last_pose_1800", "lever_up_lstm_1800_window", "lever_up_lstm_1800_first_step"],
)
def test_shipped_checkpoints_foresee_what_they_have_not_seen(name):
    whole = open_interactions("lever_up")
    model, about = load_checkpoint(name)
    split = split_of(LeverUnit("persistence"), whole)
    assert not set(about["seen_interactions"]) & set(split.test)
    few = lever_up_tensors(whole, split.test[:60], about["view"])
    if about["trained_for"] != "first_step":
        assert 100 * window_errors_m(model, few).mean() < 0.3
    if about["trained_for"] != "window":
        assert 100 * beginning_errors_m(model, few).mean() < 0.4
    size = (repo_root() / "data" / "checkpoints" / f"{name}.safetensors").stat().st_size
    assert size < 5e6
