"""Ensembles of networks: moments of their mixture, and use by planners."""

import numpy as np
import pytest
import torch

from affordlib.interactions import InteractionTensors
from affordlib.models import EffectModel, condition_on_primitives, load_checkpoint
from affordlib.primitives import Push
from experiments.ensemble import Ensemble

NAMES = ("film_500", "film_5000")


@pytest.fixture
def members():
    return [load_checkpoint(name)[0] for name in NAMES]


@pytest.fixture
def asked(members, pushes):
    images = InteractionTensors.from_dataset(pushes, np.arange(4)).image
    return images, condition_on_primitives(members[0], [Push(0.3 * k) for k in range(4)])


@torch.no_grad()
def test_mean_and_sigma_are_those_of_the_mixture(members, asked):
    images, observed = asked
    ensemble, t_target = Ensemble(members), torch.tensor([[0.0, 0.5, 1.0]]).expand(4, -1)
    assert isinstance(ensemble, EffectModel)
    told = ensemble.predict(ensemble.encode(images), observed, t_target)
    each = [m.predict(m.encode(images), observed, t_target) for m in ensemble.members]
    mean = torch.stack([p.effect_mean for p in each]).double()
    torch.testing.assert_close(told.effect_mean.double(), mean.mean(dim=0), atol=1e-8, rtol=1e-5)
    # The variance of each about the mean of all, in double precision to avoid cancellation.
    std = torch.stack([p.effect_std for p in each]).double()
    variance = (std**2 + (mean - mean.mean(dim=0)) ** 2).mean(dim=0)
    torch.testing.assert_close(told.effect_std.double(), variance.sqrt(), atol=0, rtol=1e-5)


def test_members_are_left_as_they_were(members):
    before = [member.sigma_scale.tolist() for member in members]
    ensemble = Ensemble(members)
    assert [member.sigma_scale.tolist() for member in members] == before
    assert all(member.sigma_scale.tolist() == [1.0] * 3 for member in ensemble.members)
    assert all(t != 1 for scale in before for t in scale)


@torch.no_grad()
def test_one_member_is_itself_and_one_object_serves_all_queries(members, asked):
    images, observed = asked
    t_target = torch.ones(4, 1)
    for model in (Ensemble(members), Ensemble(members[:1])):
        one = model.predict(model.encode(images[:1]), observed, t_target)
        same = model.predict(model.encode(images[:1]).expand(4, -1), observed, t_target)
        torch.testing.assert_close(one.effect_mean, same.effect_mean)
    alone = members[0].predict(members[0].encode(images[:1]), observed, t_target)
    torch.testing.assert_close(one.effect_mean, alone.effect_mean)
    torch.testing.assert_close(one.action_std, alone.action_std)


def test_members_must_agree_on_channels(members):
    with pytest.raises(ValueError, match="member 1 has"):
        Ensemble([members[0], load_checkpoint("cnp_500")[0]])
    with pytest.raises(ValueError, match="at least one network"):
        Ensemble([])
