"""What is made of answers: errors, calibration, baselines beside them, the rows of tables."""

import math

import numpy as np
import pytest
import torch

from affordlib.evaluation.baselines import constant, gaussian_process, logistic, nearest
from affordlib.evaluation.predictions import (
    calibration,
    final_error,
    network_predictions,
    yaw_error,
)
from affordlib.interactions import (
    InteractionTensors,
)
from experiments.grasps import (
    auc,
    confusion_columns,
    grasp_rows,
    rates,
    threshold_rows,
    wilson,
)
from experiments.inverse import along_effect, executed_record
from experiments.pooled import Errors
from experiments.units import Unit

# Answers


def test_answers_are_those_of_the_model_itself(trained, held_out_pushes):
    some = np.arange(5)
    told = network_predictions(trained, held_out_pushes, some)
    from affordlib.models.training import final_errors_m

    arrays = InteractionTensors.from_dataset(held_out_pushes, some)
    torch.testing.assert_close(
        torch.tensor(final_error(told)).float(), final_errors_m(trained, arrays)
    )
    assert told["interaction"] == some.tolist()
    after, whole = (np.array(told[k]) for k in ("after_contact_error", "trajectory_error"))
    assert (after > whole).all()  # before contact nothing moves, which dilutes the mean


def test_a_turn_is_measured_the_short_way_round():
    told = {"truth": {"yaw": [3.1, 0.2]}, "mean": {"yaw": [-3.1, 0.1]}}
    np.testing.assert_allclose(yaw_error(told), [2 * math.pi - 6.2, 0.1])


def test_calibration_of_a_true_gaussian_is_right():
    truth = np.random.default_rng(0).normal(0, 2.0, 20_000).tolist()
    zeros, twos = [0.0] * 20_000, [2.0] * 20_000
    (row,) = calibration({"truth": {"z": truth}, "mean": {"z": zeros}, "std": {"z": twos}})
    assert row["coverage_50"] == pytest.approx(0.5, abs=0.01)
    assert row["coverage_90"] == pytest.approx(0.9, abs=0.01)
    assert row["nll"] == pytest.approx(math.log(2) + 0.5 * math.log(2 * math.pi * math.e), abs=0.02)


# Baselines


def arrays_of(effect, theta):
    n = len(theta)
    out = torch.stack([theta.cos(), theta.sin()], dim=-1)
    action = torch.stack([-0.2 * out, 0.05 * out], dim=1)
    effect = torch.stack([torch.zeros(n, 2), effect], dim=1)
    phase, image = torch.tensor([0.0, 1.0]), torch.zeros(n, 2, 4, 4)
    return InteractionTensors(image, phase, action, effect, ("x", "y"), ("x", "y"))


def test_baselines_know_the_direction_and_recover_a_law_of_size():
    generator = torch.Generator().manual_seed(0)
    theta, size = (torch.rand(60, generator=generator) for _ in range(2))
    theta = 2 * math.pi * theta
    out = torch.stack([theta.cos(), theta.sin()], dim=-1)
    arrays = arrays_of((0.05 + 0.02 * size[:, None]) * out, theta)
    train, test, at = arrays.select(slice(0, 40)), arrays.select(slice(40, 60)), torch.tensor([1])
    known, asked = 3 * size[:40, None], 3 * size[40:, None]
    off = {}
    for baseline in (constant, nearest, gaussian_process):
        mean, std = baseline(train, test, at, known, asked)
        off[baseline] = float((mean[:, 0] - test.effect[:, 1]).norm(dim=-1).mean())
        assert mean.shape == std.shape == (20, 1, 2)
    length = 0.05 + 0.02 * size
    expected = (length[40:] - length[:40].mean()).abs().mean()
    assert off[constant] == pytest.approx(float(expected), rel=1e-4)
    assert off[nearest] < off[constant] / 5
    assert off[gaussian_process] < off[constant] / 20


def test_logistic_regression_finds_the_boundary():
    rng = np.random.default_rng(0)
    size = rng.uniform(0.03, 0.12, (400, 3))
    fits = size[:, 0] < 0.08
    told = logistic(size[:200], fits[:200], size[200:])
    assert ((told > 0.5) == fits[200:]).mean() > 0.95


def test_the_very_push_brings_its_effect_about(pushes):
    some = np.flatnonzero(pushes["family"].values == 1)[:2]
    right = executed_record(pushes, some, pushes["theta"].values[some])
    assert max(right["final_error"]) < 1e-5  # the same simulation again, stored to a micrometre
    guess = executed_record(pushes, some, along_effect(pushes, some))
    assert max(guess["theta_error"]) < 0.02  # cylinders go where they are pushed


# Tables


@pytest.mark.parametrize(
    ("k", "n", "low", "high"),
    [(8, 10, 0.4902, 0.9433), (0, 10, 0.0, 0.2775), (50, 100, 0.4038, 0.5962)],
)
def test_wilson_intervals_are_the_published_ones(k, n, low, high):
    assert wilson(k, n) == pytest.approx((low, high), abs=1e-4)


def test_all_weighs_classes_equally_and_seeds_are_no_further_objects():
    errors = Errors([1, 1, 1, 3, 5], [0, 1, 2, 3, 3], ["a", "a", "a", "b", "b"])
    assert errors.mean_sem("all") == (2.5, 0.0)
    assert (errors.count("all"), errors.count("b")) == (4, 1)
    spread = Errors([0, 2, 0, 4], range(4), ["a", "a", "b", "b"])
    assert spread.mean_sem("all") == (1.5, pytest.approx(math.hypot(1, 2) / 2))


def test_auc_counts_pairs_in_order_within_folds():
    truth, one = np.array([True, False, True, False]), np.zeros(4)
    score = np.array([0.9, 0.1, 0.4, 0.4])
    assert auc(score, truth, one) == (3 + 0.5) / 4
    assert auc(score, truth, np.array([0, 0, 1, 1])) == (1 + 0.5) / 2
    assert auc(score, truth, np.arange(4)) is None


def test_true_and_false_shares_are_of_the_true_classes():
    truth = np.array([True] * 4 + [False] * 2)
    row = confusion_columns(np.array([True, True, True, False, False, True]), truth)
    assert [row[f"{k}_percent"] for k in ("tp", "fn", "tn", "fp")] == [75, 25, 50, 50]
    none = confusion_columns(np.array([True]), np.array([True]))
    assert none["tn_percent"] is none["tn_low_percent"] is None


def test_grasps_by_the_rule_of_a_tenth_of_a_metre():
    told = {
        "rollable": [False, False, True],
        "family": [0] * 3,
        "interaction": [0, 1, 2],
        "truth": {"z": [0.25, 0.0, 0.25]},
        "mean": {"z": [0.12, 0.11, 0.05]},
        "std": {"z": [0.1, 0.1, 0.1]},
    }
    stands, rolls = grasp_rows([(Unit("film", "grasp"), {"n": 100, "fold_test": told})])
    assert (stands["tp_percent"], stands["fp_percent"], rolls["fn_percent"]) == (100, 100, 100)
    assert stands["error_mean_m"] == pytest.approx((0.13 + 0.11) / 2)
    assert stands["auc"] == 1.0


def _folds_of_grasps(scores, lifted):
    parts = []
    for fold, (score, up) in enumerate(zip(scores, lifted, strict=True)):
        told = {
            "rollable": [False] * len(up) + [True] * len(up),
            "truth": {"z": [0.25 * v for v in (*up, *up)]},
            "probability": [*score, *score],
        }
        parts.append((Unit("logistic", "grasp", fold=fold), {"n": 100, "fold_test": told}))
    return parts


def test_a_folds_own_grasps_never_decide_its_threshold():
    # Folds 0 and 1 part near 0.8, fold 2 at 0.2: by its own all right, by theirs all lost.
    scores = [[0.9, 0.85, 0.7, 0.6], [0.95, 0.82, 0.78, 0.1], [0.4, 0.3, 0.1, 0.05]]
    parts = _folds_of_grasps(scores, [[1, 1, 0, 0]] * 3)
    stands, _ = threshold_rows(parts)
    assert (stands["n_success"], stands["n_failure"], stands["folds"]) == (6, 6, 3)
    assert stands["tp_percent"] < 100  # fold 2
    same, _ = threshold_rows(_folds_of_grasps([scores[0]] * 3, [[1, 1, 0, 0]] * 3))
    assert (same["tp_percent"], same["tn_percent"]) == (100, 100)
    assert same["threshold_median"] == pytest.approx(0.775)


def test_rates_at_the_ends_are_all_and_nothing():
    score, lifted = np.array([0.1, 0.4, 0.6, 0.9]), np.array([False, True, False, True])
    tp, tn = rates(score, lifted, np.array([-np.inf, 0.5, 0.9]))
    assert (tp.tolist(), tn.tolist()) == ([1, 0.5, 0], [0, 0.5, 1])
