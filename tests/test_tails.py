"""Readings of residuals: what they were drawn from is what is read."""

import numpy as np
import pytest
from scipy import integrate, stats

from affordlib.paths import repo_root
from affordlib.results import read_results
from experiments.tails import Reading, crps, judge, readings


@pytest.mark.parametrize("z", [-2.0, 0.0, 0.7])
def test_the_score_is_its_integral(z):
    def squared(x):
        return (stats.norm.cdf(x) - (x >= z)) ** 2

    expected = sum(integrate.quad(squared, *ends)[0] for ends in ((-12, z), (z, 12)))
    assert crps(np.array(z)) == pytest.approx(expected, abs=1e-8)


def test_gaussian_residuals_read_the_same_in_all_ways():
    residual = np.random.default_rng(0).normal(0, 2.5, 4000)
    likely, scored, student = readings(residual, np.ones(4000))
    assert likely.scale == pytest.approx(2.5, rel=0.05)
    assert scored.scale == pytest.approx(2.5, rel=0.05)
    assert student.freedom > 20
    assert student.scale == pytest.approx(2.5, rel=0.05)


def test_heavy_tails_are_told_by_their_degrees_of_freedom():
    rng = np.random.default_rng(1)
    seen, new = (0.5 * rng.standard_t(1.5, 4000) for _ in range(2))
    likely, scored, student = readings(seen, np.ones(4000))
    assert student.freedom == pytest.approx(1.5, rel=0.1)
    assert student.scale == pytest.approx(0.5, rel=0.1)
    assert student.scale < scored.scale < likely.scale
    told = judge(student, new, np.ones(4000), "m")
    assert told["coverage_50"] == pytest.approx(0.5, abs=0.03)
    assert told["coverage_90"] == pytest.approx(0.9, abs=0.03)
    assert told["nll"] < judge(likely, new, np.ones(4000), "m")["nll"]


def test_intervals_of_a_standard_gaussian():
    told = judge(Reading("N", 2.0), np.array([1.3, 1.4, -3.2, 3.4]), np.full(4, 0.1), "rad")
    assert told["coverage_50"] == 0.25
    assert told["coverage_90"] == 0.75
    assert told["half_width_90_mean_rad"] == pytest.approx(1.644854 * 0.2)
    assert told["half_width_90_mean_m"] is None


def test_the_committed_tails_are_heavy():
    rows = read_results(repo_root() / "data" / "results" / "effect_prediction.json")["tables"]
    tests = [r for r in rows["tails"] if r["test"] == "test" and not r["model"].startswith("drag")]
    wide, _, student = (tests[k::3] for k in range(3))
    assert len(student) == 3
    for before, after in zip(wide, student, strict=True):
        assert after["degrees_of_freedom"] < 2
        assert abs(after["coverage_50"] - 0.5) < abs(before["coverage_50"] - 0.5) / 2
        assert after["nll"] < before["nll"] - 0.2
