"""Studies: ablations, and predictions of partial actions."""

import lzma

import numpy as np
import pytest
import torch

from affordlib.geometry import centroid, cross
from affordlib.interactions import InteractionTensors
from affordlib.interactions.dataset import sample_mixed
from affordlib.logs import Log
from affordlib.results import repo_root
from affordlib.world.robot import ROD_WIDTH_M
from experiments import ablation, studies, t_on_arm
from experiments.ablation import random_contexts
from experiments.real_pushes import pushes_of


def test_random_contexts_are_of_any_phase(pushes):
    arrays, firsts = InteractionTensors.from_dataset(pushes, np.arange(80)), []
    for draw in (sample_mixed, random_contexts):
        seen = draw(arrays, 4, 6, torch.Generator().manual_seed(0)).observations
        firsts.append((seen.action_t[:, 0] == 0).float().mean())
    assert firsts[0] > 0.3
    assert firsts[1] < 0.1
    at = (seen.action_t * (len(arrays.phase) - 1)).round().long()
    assert torch.equal(seen.action, arrays.action[torch.arange(80)[:, None], at])


def test_changes_of_an_ablation_add_up(monkeypatch):
    made = []

    def remember(model, training, validation, config, sampler):
        made.append((model, config, sampler))

    monkeypatch.setattr(ablation, "train", remember)
    ablation.ablated(tuple(ablation.LADDER), 10)
    ablation.ablated(("contexts at the ends",), 10)
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


def test_networks_of_whole_actions_foresee_what_broken_off_ones_do():
    rows = studies.partial_execution()
    assert {row["model"] for row in rows} == set(studies.WHOLE_ACTION_MODELS)
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


def test_the_arms_t_is_its_outline_and_its_pushes_are_read_by_the_log():
    block = t_on_arm.TBlock()
    corners = block.footprint_m
    area_m2 = cross(corners, np.roll(corners, -1, axis=0)).sum() / 2
    assert block.volume_m3 == pytest.approx(area_m2 * block.height)
    np.testing.assert_allclose(centroid(corners), 0.0, atol=1e-9)
    log = Log("m", corners, tool_radius=ROD_WIDTH_M / 2)
    assert (log.add_all(t_on_arm.collect(6, seed=3)), len(log.pushes())) == ({}, 6)
