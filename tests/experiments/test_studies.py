"""Studies: ablations, residuals, and limits of prediction."""

import dataclasses
import lzma
import subprocess
import sys

import numpy as np
import pytest
import torch
from scipy import integrate, stats

from affordlib.interactions import InteractionTensors
from affordlib.interactions.sampling import sample_mixed
from affordlib.results import repo_root
from experiments import ablation, limits, studies
from experiments.ablation import actions_only, half_blend, random_contexts
from experiments.real_pushes import pushes_of
from experiments.representation import cka
from experiments.uncertainty import Fit, coverage_columns, crps, fits


def test_alignment_of_codes():
    generator = torch.Generator().manual_seed(0)
    a, b = (torch.randn(2000, 6, generator=generator) for _ in range(2))
    turn, _ = torch.linalg.qr(torch.randn(6, 6, generator=generator))
    assert cka(a, 3 * a @ turn + 1) == pytest.approx(1, abs=1e-5)
    assert cka(a, b) < 0.02
    assert cka(a, torch.ones(2000, 3)) is None


def test_draws_leave_out_one_thing_each(pushes):
    arrays = InteractionTensors.from_dataset(pushes, np.arange(80))
    rows = torch.arange(80)

    def drawn(draw):
        return draw(arrays, 4, 6, torch.Generator().manual_seed(0))

    plain, blended = drawn(sample_mixed), drawn(half_blend)
    both = (plain.observations.weight > 0) & (plain.observations.weight < 1)
    assert both.sum() > 10
    assert (blended.observations.weight[both] == 0.5).all()
    same = dataclasses.replace(blended.observations, weight=plain.observations.weight)
    for field in dataclasses.fields(same):
        assert torch.equal(getattr(same, field.name), getattr(plain.observations, field.name))
    seen = drawn(actions_only).observations
    assert not seen.effect_mask.any()
    assert seen.action_mask.any(dim=1).all()
    assert torch.equal(
        seen.action_mask[plain.observations.weight == 1],
        plain.observations.action_mask[plain.observations.weight == 1],
    )
    loose = drawn(random_contexts).observations
    firsts = [(o.action_t[:, 0] == 0).float().mean() for o in (plain.observations, loose)]
    assert firsts[0] > 0.3
    assert firsts[1] < 0.1
    at = (loose.action_t * (len(arrays.phase) - 1)).round().long()
    assert torch.equal(loose.action, arrays.action[rows[:, None], at])


def test_changes_of_an_ablation_add_up(monkeypatch):
    made = []

    def remember(model, training, validation, config, sampler):
        made.append((model, config, sampler))

    monkeypatch.setattr(ablation, "train", remember)
    ablation.ablated(tuple(ablation.LADDER.values()), 10)
    ablation.ablated(("random contexts only",), 10)
    (bare, config, draw), (ours, usual, loose) = made
    assert draw is ablation.one_at_a_time  # which draws at random moments, too
    assert (config.augment, config.beta, config.ema) == (False, 0.0, 0.0)
    assert (bare.config.frame, bare.scaler.action_scale) == ("table", (1.0, 1.0))
    assert not any(p.requires_grad for b in bare.blocks for p in b.modulation.parameters())
    assert loose is random_contexts
    assert usual.augment
    assert (usual.beta, ours.config.frame) == (0.5, "push")
    assert ours.scaler.action_scale < (0.5, 0.5)
    first = [next(m for m in net.image_encoder if hasattr(m, "weight")) for net in (bare, ours)]
    assert not torch.equal(first[0].weight, first[1].weight)


# Residuals


@pytest.mark.parametrize("z", [-2.0, 0.0, 0.7])
def test_the_score_is_its_integral(z):
    def squared(x):
        return (stats.norm.cdf(x) - (x >= z)) ** 2

    expected = sum(integrate.quad(squared, *ends)[0] for ends in ((-12, z), (z, 12)))
    assert crps(np.array(z)) == pytest.approx(expected, abs=1e-8)


def test_all_fits_to_gaussian_residuals_agree():
    residual = np.random.default_rng(0).normal(0, 2.5, 4000)
    found = fits(residual, np.ones(4000))
    assert [fit.scale for fit in found] == pytest.approx([2.5] * 3, rel=0.05)
    assert found[-1].freedom > 20


def test_heavy_tails_show_in_their_degrees_of_freedom():
    rng = np.random.default_rng(1)
    seen, new = (0.5 * rng.standard_t(1.5, 4000) for _ in range(2))
    likely, scored, student = fits(seen, np.ones(4000))
    assert student.freedom == pytest.approx(1.5, rel=0.1)
    assert student.scale == pytest.approx(0.5, rel=0.1)
    assert student.scale < scored.scale < likely.scale
    row = coverage_columns(student, new, np.ones(4000))
    assert row["coverage_50"] == pytest.approx(0.5, abs=0.03)
    assert row["coverage_90"] == pytest.approx(0.9, abs=0.03)
    assert row["nll"] < coverage_columns(likely, new, np.ones(4000))["nll"]


def test_intervals_of_a_standard_gaussian():
    residual, std = np.array([1.3, 1.4, -3.2, 3.4]), np.full(4, 0.1)
    row = coverage_columns(Fit("N", 2.0), residual, std)
    assert (row["coverage_50"], row["coverage_90"]) == (0.25, 0.75)


# What limits a prediction


def test_networks_of_whole_actions_foresee_what_broken_off_ones_do():
    rows = limits.partial_execution()
    assert {row["model"] for row in rows} == set(limits.WHOLE_ACTION_MODELS)
    late = [row for row in rows if row["from_phase"] >= 0.55]
    assert min(row["n"] for row in late) > 10
    assert max(row["whole_median_m"] for row in late) < 0.001
    assert all(row["slid_mean_m"] > 0 for row in late)
    before = [row["whole_mean_m"] for row in rows if row["from_phase"] == 0.0]
    assert max(before) < 1e-4  # before contact


def test_a_damaged_log_of_pushes_is_named(tmp_path):
    packed = (repo_root() / "data" / "own_log" / "felt_mid.txt.xz").read_bytes()
    text = lzma.decompress(packed)
    for name, content in (
        ("a.txt.xz", packed[:-100]),
        ("b.txt.xz", text),
        ("c.txt", text[:-4000]),
        ("d.txt", text.replace(b".", b",", 1)),
        ("e.txt", packed),
        ("f.txt", b""),
    ):
        path = tmp_path / name
        path.write_bytes(content)
        with pytest.raises(ValueError, match=f"{name} is damaged, or is not a log of pushes"):
            list(pushes_of(path))


def test_what_decides_a_study_is_the_same_in_every_process():
    code = "from experiments.studies import *; print([job(k).made_of() for k in sorted(STUDIES)])"
    here = str([studies.job(name).made_of() for name in sorted(studies.STUDIES)])
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, check=True, text=True)
    assert run.stdout.strip() == here
