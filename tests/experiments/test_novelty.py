"""Novelty: unfamiliar objects are detected, and σ grows with it and with nothing else."""

import numpy as np
import torch

from affordlib.interactions import InteractionTensors
from affordlib.models import EffectModel, condition_on_primitives
from affordlib.primitives import Push
from affordlib.world import Prism
from experiments.novelty import NOVELTY_GAIN, NoveltyAware, novelty_of

HOUSE = Prism(((-0.03, -0.03), (0.03, -0.03), (0.03, 0.01), (0.0, 0.04), (-0.03, 0.01)), 0.05)


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
    assert isinstance(aware, EffectModel)
    seen = torch.from_numpy(pushes["image"].values[:500])
    seen = seen[novelty(seen) < 0.9][:1]
    given = condition_on_primitives(film, [Push.towards(0.0)])
    for image, root in ((seen, 0.0), (house, (both[0] - 1).sqrt())):
        plain, wider = (m.predict(m.encode(image), given, t) for m in (film, aware))
        moved = plain.effect_mean[..., :2].norm(dim=-1, keepdim=True)
        grown = torch.hypot(plain.effect_std[..., :2], NOVELTY_GAIN * root * moved)
        assert torch.equal(plain.effect_mean, wider.effect_mean)
        assert torch.allclose(wider.effect_std[..., :2], grown, rtol=1e-4)
