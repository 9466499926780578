"""Cross-validation trains the models of its jobs, and tables agree with their results."""

from dataclasses import replace

import numpy as np
import pytest

from experiments import cross_validation
from experiments import effect_prediction as tables
from experiments.cross_validation import job, network_and_training
from experiments.effect_prediction import confusion_columns


def test_what_decides_a_training_decides_whether_its_result_is_stale(monkeypatch):
    network, training = network_and_training("film", "push")
    others = (replace(network, blocks=5), training), (network, replace(training, ema=0.5))
    made_of = [job("film", "push").made_of()]
    for now in (*others, (network, replace(training, device="cpu"))):
        monkeypatch.setattr(cross_validation, "network_and_training", lambda *_, now=now: now)
        made_of.append(job("film", "push").made_of())
    assert [one == made_of[0] for one in made_of] == [True, False, False, True]


def test_shipped_networks_are_those_of_the_tables():
    names = ("film_500", "film_5000", "drag_film_500", "grasp_film_1000", "rotate_film_1000")
    for spec in map(cross_validation.CHECKPOINT_SPECS.get, names):
        assert network_and_training("film", spec.data) == (spec.network, spec.training)
        assert (cross_validation.task_of(spec.data).symmetries or ()) == spec.symmetries


def test_a_fold_may_lack_a_category():
    def result(fold, categories):
        errors = [0.001 * (k + 1) for k in range(len(categories))]
        names = ("final_error", "trajectory_error")
        columns = {"interaction": range(len(errors)), "category": list(categories)}
        about = {"model": "film", "data": "drag", "n": 100, "fold": fold, "seed": 0}
        return about, {"n_interactions": 100, "fixed_test": columns | dict.fromkeys(names, errors)}

    folds = [result(k, categories) for k, categories in enumerate(("aab", "aab", "aa"))]
    rows = tables.error_rows(tables.predictions_of(folds, "drag", "fixed_test"), "drag")
    means = [row["final_error_mean_m"] for row in rows]
    assert means == pytest.approx([0.00225, 0.0015, 0.003])


def test_shares_are_of_the_true_successes_and_failures():
    lifted = np.array([True] * 4 + [False] * 2)
    row = confusion_columns(np.array([True, True, True, False, False, True]), lifted)
    assert [row[f"{k}_percent"] for k in ("tp", "tn")] == [75, 50]
    eight = confusion_columns(np.arange(10) < 8, np.ones(10, bool))
    ends = [eight[f"tp_{end}_percent"] for end in ("low", "high")]
    assert ends == pytest.approx([49.02, 94.33], abs=0.01)  # Wilson's, of eight of ten
    none = confusion_columns(np.array([True]), np.array([True]))
    assert none["tn_percent"] is none["tn_low_percent"] is None
