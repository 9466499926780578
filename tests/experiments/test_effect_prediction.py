"""Effect prediction: errors, baselines, novelty, cross-validation and its tables, ablations."""

import math
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
import torch

from affordlib import models
from affordlib.interactions import InteractionTensors
from affordlib.interactions.dataset import sample_mixed
from affordlib.primitives import Push
from affordlib.world import Prism
from experiments import effect_prediction as tables
from experiments import studies
from experiments.baselines import constant, gaussian_process, nearest, network_record
from experiments.effect_prediction import add_errors, job, network_and_training
from experiments.novelty import NOVELTY_GAIN, NoveltyAware, novelty_of

HOUSE = Prism(((-0.03, -0.03), (0.03, -0.03), (0.03, 0.01), (0.0, 0.04), (-0.03, 0.01)), 0.05)


def test_what_decides_a_training_decides_whether_its_result_is_stale(monkeypatch):
    network, training = network_and_training("film", "push")
    others = (replace(network, blocks=5), training), (network, replace(training, ema=0.5))
    made_of = [job("film", "push").made_of()]
    for now in (*others, (network, replace(training, device="cpu"))):
        monkeypatch.setattr(tables, "network_and_training", lambda *_, now=now: now)
        made_of.append(job("film", "push").made_of())
    assert [one == made_of[0] for one in made_of] == [True, False, False, True]


def test_shipped_networks_are_those_of_the_tables():
    names = ("film_500", "film_5000", "drag_film_500", "grasp_film_1000", "rotate_film_1000")
    for spec in map(tables.CHECKPOINT_SPECS.get, names):
        assert network_and_training("film", spec.data) == (spec.network, spec.training)
        assert (tables.task_of(spec.data).symmetries or ()) == spec.symmetries


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
    row = tables.confusion_columns(np.array([True, True, True, False, False, True]), lifted)
    assert [row[f"{k}_percent"] for k in ("tp", "tn")] == [75, 50]
    eight = tables.confusion_columns(np.arange(10) < 8, np.ones(10, bool))
    ends = [eight[f"tp_{end}_percent"] for end in ("low", "high")]
    assert ends == pytest.approx([49.02, 94.33], abs=0.01)  # Wilson's, of eight of ten
    none = tables.confusion_columns(np.array([True]), np.array([True]))
    assert none["tn_percent"] is none["tn_low_percent"] is None


def test_answers_are_those_of_the_model_itself(trained, held_out_pushes):
    some = np.arange(5)
    found = network_record(trained, held_out_pushes, some)
    arrays = InteractionTensors.from_dataset(held_out_pushes, some)
    expected = models.final_errors_m(trained, arrays)
    torch.testing.assert_close(torch.tensor(models.final_error(found)).float(), expected)
    short = models.network_predictions(trained, held_out_pushes, some)
    np.testing.assert_allclose(models.final_error(short), models.final_error(found), atol=1e-7)
    one = {part: {"x": short[part]["x"]} for part in ("mean", "truth")}
    off = np.subtract(*[v["x"] for v in one.values()])
    assert models.final_error(one) == pytest.approx(np.abs(off))
    assert found["interaction"] == some.tolist()
    assert (np.array(found["trajectory_error"]) < models.final_error(found)).mean() > 0.5


def test_a_turn_is_measured_the_short_way_round():
    found = pd.DataFrame({"truth_yaw": [3.1, 0.2], "mean_yaw": [-3.1, 0.1]})
    add_errors(found, "rotate")
    np.testing.assert_allclose(found["yaw_error"], [2 * math.pi - 6.2, 0.1])


def test_baselines_know_the_direction_and_recover_a_law_of_size():
    generator = torch.Generator().manual_seed(0)
    theta, size = (torch.rand(60, generator=generator) for _ in range(2))
    theta = 2 * math.pi * theta
    out = torch.stack([theta.cos(), theta.sin()], dim=-1)
    action = torch.stack([-0.2 * out, 0.05 * out], dim=1)
    effect = torch.stack([0 * out, (0.05 + 0.02 * size[:, None]) * out], dim=1)
    phase, image = torch.tensor([0.0, 1.0]), torch.zeros(60, 2, 4, 4)
    arrays = InteractionTensors(image, phase, action, effect, ("x", "y"), ("x", "y"))
    train, test, at = arrays.select(slice(0, 40)), arrays.select(slice(40, 60)), torch.tensor([1])
    known, queried = 3 * size[:40, None], 3 * size[40:, None]
    off = {}
    for baseline in (constant, nearest, gaussian_process):
        mean, std = baseline(train, test, at, known, queried)
        off[baseline] = float((mean[:, 0] - test.effect[:, 1]).norm(dim=-1).mean())
        assert mean.shape == std.shape == (20, 1, 2)
    length = 0.05 + 0.02 * size
    expected = (length[40:] - length[:40].mean()).abs().mean()
    assert off[constant] == pytest.approx(float(expected), rel=1e-4)
    assert off[nearest] < off[constant] / 5
    assert off[gaussian_process] < off[constant] / 20


def test_a_house_is_new_and_its_sigma_grows(film, held_out_pushes, pushes, world):
    novelty = novelty_of("film_500")
    tests = novelty(InteractionTensors.from_dataset(held_out_pushes).image)
    assert 0.96 < (tests < 1).double().mean() < 0.999
    world.place(HOUSE, (0.0, 0.0), 0.3)
    house = torch.from_numpy(np.array(world.depth_image()))[None]
    rotated = torch.cat([torch.rot90(house, k, (-2, -1)) for k in range(4)])
    both = novelty(torch.cat([rotated, rotated.flip(-1)]))
    assert both[0] > 10
    assert torch.allclose(both, both[:1].expand(8), rtol=1e-2)
    aware, t = NoveltyAware(film, novelty), torch.tensor([[0.3, 1.0]])
    assert isinstance(aware, models.EffectModel)
    seen = torch.from_numpy(pushes["image"].values[:500])
    seen = seen[novelty(seen) < 0.9][:1]
    given = models.condition_on_primitives(film, [Push.towards(0.0)])
    for image, root in ((seen, 0.0), (house, (both[0] - 1).sqrt())):
        plain, wider = (m.predict(m.encode(image), given, t) for m in (film, aware))
        moved = plain.effect_mean[..., :2].norm(dim=-1, keepdim=True)
        grown = torch.hypot(plain.effect_std[..., :2], NOVELTY_GAIN * root * moved)
        assert torch.equal(plain.effect_mean, wider.effect_mean)
        assert torch.allclose(wider.effect_std[..., :2], grown, rtol=1e-4)


def test_random_contexts_are_of_any_phase(pushes):
    arrays, firsts = InteractionTensors.from_dataset(pushes, np.arange(80)), []
    for draw in (sample_mixed, studies.random_contexts):
        seen = draw(arrays, 4, 6, torch.Generator().manual_seed(0)).observations
        firsts.append((seen.action_t[:, 0] == 0).float().mean())
    assert firsts[0] > 0.3
    assert firsts[1] < 0.1
    at = (seen.action_t * (len(arrays.phase) - 1)).round().long()
    assert torch.equal(seen.action, arrays.action[torch.arange(80)[:, None], at])


def test_changes_of_an_ablation_add_up(monkeypatch):
    made = []
    monkeypatch.setattr(studies, "train", lambda *a, sampler: made.append((a[0], a[3], sampler)))
    studies.error_m(tuple(studies.LADDER), 10)
    studies.error_m(("contexts at the ends",), 10)
    (bare, config, draw), (ours, usual, loose) = made
    assert draw is studies.one_at_a_time  # which draws at random moments, too
    assert (config.augment, config.beta, config.ema) == (False, 0.0, 0.0)
    assert (bare.config.frame, bare.scaler.action_scale) == ("table", (1.0, 1.0))
    assert not any(p.requires_grad for b in bare.blocks for p in b.modulation.parameters())
    assert loose is studies.random_contexts
    assert usual.augment
    assert (usual.beta, ours.config.frame) == (0.5, "push")
    assert ours.scaler.action_scale < (0.5, 0.5)
    first = [next(m for m in net.image_encoder if hasattr(m, "weight")) for net in (bare, ours)]
    assert not torch.equal(first[0].weight, first[1].weight)


def test_networks_of_whole_actions_foresee_what_broken_off_ones_do():
    rows = studies.partial_execution()
    assert {row["model"] for row in rows} == set(studies.WHOLE_ACTION_MODELS)
    late = [row for row in rows if row["from_phase"] >= 0.55]
    assert min(row["n"] for row in late) > 10
    assert max(row["whole_median_m"] for row in late) < 0.001
    assert all(row["slid_mean_m"] > 0 for row in late)
    before = [row["whole_mean_m"] for row in rows if row["from_phase"] == 0.0]
    assert max(before) < 1e-4  # before contact
