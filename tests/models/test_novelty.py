"""Novelty: unfamiliar objects are detected, plans for them warn, and σ grows."""

import numpy as np
import pytest
import torch

from affordlib.interactions import InteractionTensors, split_interactions
from affordlib.models import load_checkpoint, save_checkpoint
from affordlib.models.calibration import NOVELTY_GAIN, Novelty, NoveltyAware
from affordlib.models.protocol import EffectModel, condition_on_primitives
from affordlib.planning import Skills, plan_continuous
from affordlib.primitives import Push
from affordlib.show import GoalPicker
from affordlib.types import Goal
from affordlib.world import Cuboid, Prism
from experiments.runner import checkpoint_sha256
from tests.problems import problem_of

HOUSE = Prism(((-0.03, -0.03), (0.03, -0.03), (0.03, 0.01), (0.0, 0.04), (-0.03, 0.01)), 0.05)


@pytest.fixture(scope="module")
def house(one_world):
    one_world.place(HOUSE, (0.0, 0.0), 0.3)
    return torch.from_numpy(np.array(one_world.depth_image()))[None]


def test_what_is_shipped_knows_the_objects_of_training_and_tests(
    pushes, held_out_pushes, film, house
):
    training = InteractionTensors.from_dataset(pushes, split_interactions(500).train).image
    again = Novelty.fit(training).references  # the order of summation depends on the processor
    torch.testing.assert_close(again, film.novelty.references, rtol=1e-4, atol=1e-5)
    assert (film.novelty(training) < 1e-3).all()
    tests = film.novelty(InteractionTensors.from_dataset(held_out_pushes).image)
    assert 0.96 < (tests < 1).double().mean() < 0.999
    turned = torch.cat([torch.rot90(house, k, (-2, -1)) for k in range(4)])
    both = film.novelty(torch.cat([turned, turned.flip(-1)]))
    assert both[0] > 10
    assert torch.allclose(both, both[:1].expand(8), rtol=1e-2)


def test_a_checkpoint_keeps_it_and_its_hash(film, untrained, house, tmp_path):
    path = save_checkpoint(untrained, tmp_path / "a.safetensors", {})
    before = checkpoint_sha256(path)
    with pytest.raises(ValueError, match="no novelty"):
        NoveltyAware(load_checkpoint(path)[0])
    untrained.novelty = film.novelty
    again, _ = load_checkpoint(save_checkpoint(untrained, path, {}))
    assert checkpoint_sha256(path) == before
    assert torch.equal(again.novelty(house), film.novelty(house))


@pytest.mark.parametrize("name", ["film_500", "cnp_500", "lstm_500"])
def test_sigma_grows_with_novelty_and_with_nothing_else(name, pushes, house):
    model, _ = load_checkpoint(name)
    aware, t = NoveltyAware(model), torch.tensor([[0.3, 1.0]])
    assert isinstance(aware, EffectModel)
    seen = torch.from_numpy(pushes["image"].values[split_interactions(500).train[:1]])
    given = condition_on_primitives(model, [Push.towards(0.0)])
    for image, root in ((seen, 0.0), (house, (model.novelty(house) - 1).sqrt())):
        plain, wider = (m.predict(m.encode(image), given, t) for m in (model, aware))
        moved = plain.effect_mean[..., :2].norm(dim=-1, keepdim=True)
        grown = torch.hypot(plain.effect_std[..., :2], NOVELTY_GAIN * root * moved)
        assert torch.equal(plain.effect_mean, wider.effect_mean)
        assert torch.allclose(wider.effect_std[..., :2], grown, rtol=1e-4)


def test_the_planner_and_the_picker_warn_of_unlike_objects(film, house, world, tmp_path):
    query = house[0].numpy(), (0.0, 0.0), Goal((0.1, 0.05))
    plain, aware = (
        plan_continuous(problem_of(model, *query)) for model in (film, NoveltyAware(film))
    )
    assert "trained on no such object" in plain.warning
    assert aware.steps[-1].std_m > 1.5 * plain.steps[-1].std_m
    for obj, warning in ((Cuboid(0.06, 0.05, 0.05), ""), (HOUSE, plain.warning)):
        world.place(obj)
        picker = GoalPicker(
            world, Skills({"push": film}), {"continuous": plan_continuous}, folder=str(tmp_path)
        )
        assert picker.plan.warning == warning
        assert ("trained on no such" in picker.controls.words.value) == bool(warning)
