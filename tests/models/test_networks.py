"""Properties of every network in both frames: equivariance, gradients, ranges, loss."""

import dataclasses
import math

import pytest
import torch

from affordlib import models
from affordlib.interactions import Scaler
from affordlib.interactions.dataset import sample_mixed
from affordlib.models.base import (
    condition_on_final_effect,
    gaussian_nll,
    inverse,
    push_direction,
    rotate_image,
)
from affordlib.models.evaluation import AFTER_CONTACT, effects_at
from affordlib.models.film import CircularHarmonics
from affordlib.primitives import Drag, Push
from affordlib.types import Observations
from experiments.last_pose import CNPAroundMeanConfig, LastPoseConfig
from experiments.lstm import LSTMConfig

YAW = {"action_channels": ("x", "y", "yaw"), "effect_channels": ("x", "y", "yaw")}
SMALL = {"width": 32, "blocks": 2, "rings": 3, "orders": 4}
CONFIGS = {
    "cnp, table": models.CNPConfig(**YAW),
    "cnp, push": models.CNPConfig(**YAW, frame="push"),
    "film, table": models.FiLMConfig(**YAW, **SMALL, frame="table"),
    "film, push": models.FiLMConfig(**YAW, **SMALL),
    "last pose, table": LastPoseConfig(**YAW, **SMALL),
    "around mean, table": CNPAroundMeanConfig(**YAW),
    "lstm, push": LSTMConfig(**YAW, frame="push", width=16),
}
IN_PUSH_FRAME = [name for name in CONFIGS if name.endswith("push")]


@pytest.fixture(params=CONFIGS)
def network(request, some):
    return made(request.param, some)


def made(name, arrays):
    torch.manual_seed(0)
    scaler, domain = Scaler.fit(arrays), models.TrainingDomain.fit(arrays)
    network = models.build(CONFIGS[name], scaler, domain).eval()
    with torch.no_grad():  # the last layers of blocks are initialised to zero
        for parameter in network.parameters():
            parameter.add_(0.02 * torch.randn_like(parameter))
    return network


def batch_of(arrays, seed=0, n_targets=5):
    """A batch with all kinds of contexts for all interactions, at the paper's samples."""
    every = {"phase": arrays.phase[::12], "action": arrays.action[:, ::12]}
    arrays = dataclasses.replace(arrays, **every, effect=arrays.effect[:, ::12])
    return sample_mixed(arrays, n_targets, 4, torch.Generator().manual_seed(seed))


def predictions(network, batch, observations=None):
    """Means and σ of action and effect for a batch, optionally with other observations."""
    features = network.encode(batch.image)
    made = network.predict(features, observations or batch.observations, batch.t_target)
    return [getattr(made, f.name) for f in dataclasses.fields(made)]


@torch.no_grad()
def test_order_and_what_is_masked_have_no_effect(network, some, tmp_path):
    """Saving and loading have no effect either."""
    assert isinstance(network, models.EffectModel)
    batch = batch_of(some)
    predicted = predictions(network, batch)
    assert [tuple(v.shape) for v in predicted] == [(40, 5, 3)] * 4
    assert all(bool((v > 0).all()) for v in (predicted[1], predicted[3]))
    path = models.save_checkpoint(network, tmp_path / "m.safetensors", {"note": "none"})
    again, about = models.load_checkpoint(path)
    assert (type(again), about) == (type(network), {"note": "none"})
    for part in ("config", "scaler", "domain"):
        assert getattr(again, part) == getattr(network, part)
    assert all(map(torch.equal, predicted, predictions(again, batch)))
    seen = batch.observations
    action = torch.where(seen.action_mask[..., None], seen.action, 7.0)
    effect = torch.where(seen.effect_mask[..., None], seen.effect, -7.0)
    seen = dataclasses.replace(seen, action=action, effect=effect)
    order = torch.randperm(4, generator=torch.Generator().manual_seed(1))
    parts = [kind + part for kind in ("action", "effect") for part in ("", "_t", "_mask")]
    shuffled = dataclasses.replace(seen, **{n: getattr(seen, n)[:, order] for n in parts})
    for a, b in zip(predicted, predictions(network, batch, shuffled), strict=True):
        torch.testing.assert_close(a, b, rtol=1e-4, atol=1e-5)


def row_of(observations, row):
    """The observations of one row; unobserved ones become a single masked value."""
    one = {f.name: getattr(observations, f.name)[[row]] for f in dataclasses.fields(observations)}
    for kind in ("action", "effect"):
        seen = one[f"{kind}_mask"][0]
        seen = seen | ~seen.any() & (torch.arange(len(seen)) == 0)
        one |= {f"{kind}{part}": one[f"{kind}{part}"][:, seen] for part in ("", "_t", "_mask")}
    return Observations(**one)


@torch.no_grad()
def test_a_row_alone_is_predicted_as_in_a_batch(network, some):
    batch = batch_of(some)
    together = predictions(network, batch)
    for row in range(len(some)):
        part = {"image": batch.image[[row]], "t_target": batch.t_target[[row]]}
        one = dataclasses.replace(batch, observations=row_of(batch.observations, row), **part)
        for a, b in zip(together, predictions(network, one), strict=True):
            torch.testing.assert_close(a[[row]], b, atol=4e-5, rtol=1e-4)  # 8e-6


@torch.no_grad()
@pytest.mark.parametrize("name", IN_PUSH_FRAME)
@pytest.mark.parametrize("quarters", [1, 2, 3])
def test_a_quarter_turn_of_the_table_turns_the_prediction(name, quarters, some):
    network = made(name, some)
    turned = some.rotated_and_mirrored(quarters)
    a, b = batch_of(some), batch_of(turned)
    # Predictions are rotated by the function that rotates data.
    mean_a, std_a, mean_e, std_e = predictions(network, a)
    t_mean_a, t_std_a, t_mean_e, t_std_e = predictions(network, b)
    start = torch.zeros(len(some), 1, 3)
    both = {"action": torch.cat([start, mean_a], 1), "effect": torch.cat([start, mean_e], 1)}
    phase = torch.linspace(0, 1, 6)
    predicted = dataclasses.replace(some, phase=phase, **both).rotated_and_mirrored(quarters)
    rotated_a, rotated_e = predicted.action[:, 1:], predicted.effect[:, 1:]
    # Without a direction, such as for an effect before contact, the frame is the table's.
    o = a.observations
    seen_e = o.effect_mask & (o.effect[..., :2].norm(dim=-1) > 1e-3)
    directed = o.action_mask.any(1) | (seen_e & (o.weight < 1)[:, None]).any(1)
    directed &= push_direction(o, *YAW.values())[:, 1] != 0
    assert directed.sum() > 20
    for mine, theirs in ((rotated_e, t_mean_e), (rotated_a[..., :2], t_mean_a[..., :2])):
        torch.testing.assert_close(mine[directed], theirs[directed], rtol=0, atol=2e-5)
    by = (rotated_a[..., 2] - t_mean_a[..., 2])[directed]
    assert torch.remainder(by + math.pi, 2 * math.pi).sub(math.pi).abs().max() < 1e-4
    for mine, theirs in ((std_a, t_std_a), (std_e, t_std_e)):
        swapped = mine[..., [1, 0, 2]] if quarters % 2 else mine
        torch.testing.assert_close(swapped[directed], theirs[directed], rtol=1e-3, atol=2e-5)


@pytest.mark.parametrize("name", IN_PUSH_FRAME)
def test_gradients_in_effect_and_action(name, some):
    """Planners use them; compared with finite differences in double precision."""
    network = made(name, some).double()
    features = network.encode(some.image[:1].double())
    one = torch.ones(1, 1, dtype=torch.float64)

    def of_effect(effect):
        seen = Observations.of(network, effect=(one, effect[:, None]))
        return network.predict(features, seen, one).effect_mean

    def of_direction(angle):
        start = torch.stack([0.2 * angle.cos(), 0.2 * angle.sin(), angle + math.pi], dim=-1)
        seen = Observations.of(network, action=(0 * one, start[:, None]))
        return network.predict(features, seen, one).effect_mean

    effect = torch.tensor([[0.05, -0.08, 0.1]], dtype=torch.float64, requires_grad=True)
    angle = torch.tensor([0.7], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(of_effect, (effect,), eps=1e-7, atol=1e-5)
    assert torch.autograd.gradcheck(of_direction, (angle,), eps=1e-7, atol=1e-5)


def test_what_is_out_of_range_is_refused(some):
    network = made("film, push", some)
    features = network.encode(some.image[:1])
    one = torch.ones(1, 1)
    for action, words in (
        (Push(0, radius=0.26), r"starts 0\.260 m .* trained on 0\.200 to 0\.200 m"),
        (Drag(0), r"starts 0\.000 m"),
        (Push(0, length=0.12), r"ends 0\.120 m"),
    ):
        with pytest.raises(ValueError, match=words):
            network.predict(features, models.condition_on_primitives(network, [action]), one)
    pushed = models.condition_on_primitives(network, [Push(0)])
    for t in (-0.2, 1.5, math.nan):
        with pytest.raises(ValueError, match=r"t_target must lie in \[0, 1\]"):
            network.predict(features, pushed, torch.full((1, 1), t))
    nowhere = dataclasses.replace(pushed, action=torch.full_like(pushed.action, math.nan))
    with pytest.raises(ValueError, match="starts nan m"):
        network.predict(features, nowhere, one)
    far = condition_on_final_effect(network, torch.tensor([[0.2, 0.0, 0.0]]))
    with pytest.warns(models.OutOfRangeWarning, match=r"ends 0\.200 m away, trained on 0\.0\d+ to"):
        network.predict(features, far, one)
    empty = some.image[:2].clone()
    empty[1, 1] = 0
    with pytest.raises(ValueError, match=r"image 1: the object covers 0\.0% of it"):
        network.encode(empty)
    with pytest.raises(ValueError, match="image 0: the object reaches its edge"):
        network.encode(torch.roll(some.image[:1], 16, dims=-1))


def test_coverage_and_variance_scaling(some):
    generator = torch.Generator().manual_seed(0)
    z = torch.randn(100_000, generator=generator)
    zero, one = torch.zeros_like(z), torch.ones_like(z)
    for level in (0.5, 0.9):
        assert models.coverage(z, zero, one, level) == pytest.approx(level, abs=0.005)
        assert models.coverage(z, zero, one / 2, level) < level - 0.1
    network = made("film, push", some)

    def nll():
        return float(gaussian_nll(*effects_at(network, some, AFTER_CONTACT)).mean())

    before, scale = nll(), models.fit_sigma_scale(network, some)
    assert tuple(network.sigma_scale.tolist()) == scale
    best = nll()
    assert best < before
    for factor in (0.9, 1.1):  # the fitted scale maximises the likelihood
        network.sigma_scale.copy_(factor * torch.tensor(scale))
        assert best < nll()
    with pytest.raises(ValueError, match=r"level .* 1\.5"):
        models.coverage(z, zero, one, 1.5)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: models.FiLMConfig(effect_channels=("z",)), "effect_channels must name x and y"),
        (lambda: models.FiLMConfig(rings=True), "rings=True"),
        (lambda: LSTMConfig(steps=2.5), r"steps=2\.5"),
        (lambda: models.CNPConfig(sigma_floor=0.0), r"sigma_floor .* 0\.0"),
        (lambda: models.FiLMConfig(blocks=10**7), r"blocks must be a whole number in \[1, 4096\]"),
    ],
)
def test_bad_settings_are_named(make, words):
    with pytest.raises((TypeError, ValueError), match=words):
        make()


def test_harmonics_turn_as_their_image_does(some):
    harmonics = CircularHarmonics(rings=3, orders=4)
    known = harmonics(some.image)
    angle = math.tau * torch.rand(40, generator=torch.Generator().manual_seed(0))
    for turn, exact in ((torch.full((40,), math.pi / 2), True), (angle, False)):
        towards = torch.stack([turn.cos(), turn.sin()], dim=-1)
        quarter = torch.rot90(some.image, 1, (-2, -1))
        turned = quarter if exact else rotate_image(some.image, towards)
        kept = (1 - turned[:, 0]).sum(dim=(1, 2)) / (1 - some.image[:, 0]).sum(dim=(1, 2))
        assert (kept - 1).abs().max() < 0.01  # of the object's height, also in the corners
        off = harmonics.rotated(known, towards) - harmonics(turned)
        # An interpolated image differs slightly from a rotated one; rotated harmonics are exact.
        assert off.abs().max() < (1e-4 if exact else 0.03 * known.abs().max())
        assert (harmonics(turned) - known).abs().max() > 0.2 * known.abs().max()
    back = harmonics.rotated(harmonics.rotated(known, towards), inverse(towards))
    torch.testing.assert_close(back, known, atol=1e-5, rtol=1e-4)


def test_the_direction_is_that_of_the_push(some):
    channels = some.action_channels, some.effect_channels
    travel = some.action[:, -1, :2] - some.action[:, 0, :2]
    expected = travel / travel.norm(dim=-1, keepdim=True)
    for samples in ((0, -1), (0,), (-1, 0), (10, 20)):
        observed = Observations.of(some, some.action_at(torch.tensor(samples)))
        direction = push_direction(observed, *channels)
        torch.testing.assert_close(direction, expected, atol=1e-4, rtol=0)
    # For the inverse query it is the effect's direction; for a zero effect, the table's x axis.
    end = torch.tensor([[0.03, -0.04, 0.1], [0.0, 0.0, 0.0]])
    observed = Observations.of(some, effect=(torch.ones(2, 1), end[:, None]))
    direction = push_direction(observed, *channels)
    torch.testing.assert_close(direction, torch.tensor([[0.6, -0.8], [1.0, 0.0]]))
