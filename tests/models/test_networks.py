"""Networks in both frames: equivariance, gradients, ranges, loss; the layers of the paper's."""

import dataclasses
import math

import pytest
import torch

from affordlib import models
from affordlib.interactions import Scaler
from affordlib.interactions.dataset import Batch, sample_mixed
from affordlib.models import CNPConfig, base
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
network = pytest.fixture(lambda request, some: made(request.param, some), params=CONFIGS)
N = 7


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


def row_of(observations, row):
    """The observations of one row; unobserved ones become a single masked value."""
    one = {f.name: getattr(observations, f.name)[[row]] for f in dataclasses.fields(observations)}
    for kind in ("action", "effect"):
        seen = one[f"{kind}_mask"][0]
        seen = seen | ~seen.any() & (torch.arange(len(seen)) == 0)
        one |= {f"{kind}{part}": one[f"{kind}{part}"][:, seen] for part in ("", "_t", "_mask")}
    return Observations(**one)


@torch.no_grad()
def test_order_batch_what_is_masked_and_saving_have_no_effect(network, some, tmp_path):
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
    for row in range(len(some)):
        part = {"image": batch.image[[row]], "t_target": batch.t_target[[row]]}
        one = dataclasses.replace(batch, observations=row_of(batch.observations, row), **part)
        for a, b in zip(predicted, predictions(network, one), strict=True):
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
    directed &= base.push_direction(o, *YAW.values())[:, 1] != 0
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
    far = base.condition_on_final_effect(network, torch.tensor([[0.2, 0.0, 0.0]]))
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
        return float(base.gaussian_nll(*effects_at(network, some, AFTER_CONTACT)).mean())

    before, scale = nll(), models.fit_sigma_scale(network, some)
    assert tuple(network.sigma_scale.tolist()) == scale
    best = nll()
    assert best < before
    for factor in (0.9, 1.1):  # the fitted scale maximises the likelihood
        network.sigma_scale.copy_(factor * torch.tensor(scale))
        assert best < nll()
    with pytest.raises(ValueError, match=r"level .* 1\.5"):
        models.coverage(z, zero, one, 1.5)


def test_bad_settings_are_named():
    for make, given, words in (
        (models.FiLMConfig, {"effect_channels": ("z",)}, "effect_channels must name x and y"),
        (models.FiLMConfig, {"rings": True}, "rings=True"),
        (LSTMConfig, {"steps": 2.5}, r"steps=2\.5"),
        (models.CNPConfig, {"sigma_floor": 0.0}, r"sigma_floor must lie in .*, got 0"),
        (models.FiLMConfig, {"blocks": 10**7}, r"blocks must be a whole number in \[1, 4096\]"),
    ):
        with pytest.raises((TypeError, ValueError), match=words):
            make(**given)


def test_harmonics_turn_as_their_image_does(some):
    harmonics = CircularHarmonics(rings=3, orders=4)
    known = harmonics(some.image)
    angle = math.tau * torch.rand(40, generator=torch.Generator().manual_seed(0))
    for turn, exact in ((torch.full((40,), math.pi / 2), True), (angle, False)):
        towards = torch.stack([turn.cos(), turn.sin()], dim=-1)
        quarter = torch.rot90(some.image, 1, (-2, -1))
        turned = quarter if exact else base.rotate_image(some.image, towards)
        kept = (1 - turned[:, 0]).sum(dim=(1, 2)) / (1 - some.image[:, 0]).sum(dim=(1, 2))
        assert (kept - 1).abs().max() < 0.01  # of the object's height, also in the corners
        off = harmonics.rotated(known, towards) - harmonics(turned)
        # An interpolated image differs slightly from a rotated one; rotated harmonics are exact.
        assert off.abs().max() < (1e-4 if exact else 0.03 * known.abs().max())
        assert (harmonics(turned) - known).abs().max() > 0.2 * known.abs().max()
    back = harmonics.rotated(harmonics.rotated(known, towards), base.inverse(towards))
    torch.testing.assert_close(back, known, atol=1e-5, rtol=1e-4)


def test_the_direction_is_that_of_the_push(some):
    channels = some.action_channels, some.effect_channels
    travel = some.action[:, -1, :2] - some.action[:, 0, :2]
    expected = travel / travel.norm(dim=-1, keepdim=True)
    for samples in ((0, -1), (0,), (-1, 0), (10, 20)):
        observed = Observations.of(some, some.action_at(torch.tensor(samples)))
        direction = base.push_direction(observed, *channels)
        torch.testing.assert_close(direction, expected, atol=1e-4, rtol=0)
    # For the inverse query it is the effect's direction; for a zero effect, the table's x axis.
    end = torch.tensor([[0.03, -0.04, 0.1], [0.0, 0.0, 0.0]])
    observed = Observations.of(some, effect=(torch.ones(2, 1), end[:, None]))
    direction = base.push_direction(observed, *channels)
    torch.testing.assert_close(direction, torch.tensor([[0.6, -0.8], [1.0, 0.0]]))


def some_observations() -> Observations:
    g = torch.Generator().manual_seed(0)
    shapes = ((2, N, 2), (2, N)) * 2
    action, action_t, effect, effect_t = (torch.rand(*shape, generator=g) for shape in shapes)
    both = (action_t, 0.2 * action), (effect_t, 0.1 * effect)
    return Observations.of(CNPConfig(), *both, torch.rand(2, generator=g))


def linear_sizes(module: torch.nn.Module) -> list[tuple[int, int]]:
    layers = [layer for layer in module.modules() if isinstance(layer, torch.nn.Linear)]
    return [(layer.in_features, layer.out_features) for layer in layers]


def test_layer_table_of_the_appendix(untrained):
    encoder = [(3, 32), (32, 64), (64, 64), (64, 128), (128, 128), (128, 256), (256, 128)]
    decoder = [(1024, 512), (512, 256), (256, 128), (128, 32), (32, 4)]
    encoders = untrained.action_encoder, untrained.effect_encoder
    assert [*map(linear_sizes, encoders)] == [encoder] * 2
    assert [type(one[-1]) for one in encoders] == [torch.nn.LeakyReLU, torch.nn.Linear]
    assert linear_sizes(untrained.merge) == [(128 + 16 + 1, 1024)]
    for one in (untrained.action_decoder, untrained.effect_decoder):
        assert linear_sizes(one) == decoder
    assert sum(p.numel() for p in untrained.parameters()) == 2_009_912

    shapes, x = [], torch.zeros(1, 2, 48, 48)
    for layer in untrained.image_encoder:
        x = layer(x)
        if isinstance(layer, torch.nn.MaxPool2d):
            shapes.append(tuple(x.shape[1:]))
    assert shapes == [(32, 24, 24), (64, 12, 12), (64, 6, 6), (128, 3, 3), (128, 1, 1)]
    assert x.shape == (1, 16)


def test_representation_is_equations_2_and_3(untrained):
    """Observed at the same times, r is the mean of r_i = w₁ h_a(a_i) + w₂ h_e(e_i)."""
    seen = some_observations()
    expected = []
    for b in range(2):
        r_i = []
        for i in range(N):
            a = torch.cat([seen.action[b, i] / 0.1, seen.action_t[b, i : i + 1]])
            e = torch.cat([seen.effect[b, i] / 0.03, seen.effect_t[b, i : i + 1]])
            w_1 = seen.weight[b]
            h_a, h_e = untrained.action_encoder(a), untrained.effect_encoder(e)
            r_i.append(w_1 * h_a + (1 - w_1) * h_e)
        expected.append(torch.stack(r_i).mean(dim=0))
    torch.testing.assert_close(untrained.represent(seen), torch.stack(expected))


def test_folded_decoding_equals_the_layers_one_by_one(untrained):
    """Also after a fused optimiser, which changes weights without incrementing their version."""
    r, features = torch.randn(2, 128), torch.randn(2, 16)
    t = torch.rand(2, 60)
    known = torch.cat([r, features], dim=1)[:, None].expand(-1, 60, -1)
    optimiser = torch.optim.Adam(untrained.parameters(), 1e-3, fused=True)
    for _ in range(2):
        with torch.no_grad():
            merged = untrained.merge(torch.cat([known, t[..., None]], dim=-1))
            mu_a, sigma_a, mu_e, sigma_e = untrained.eval().decode(r, features, t)
        for decoder, mean, std in (
            (untrained.action_decoder, mu_a, sigma_a),
            (untrained.effect_decoder, mu_e, sigma_e),
        ):
            literal_mean, raw = decoder(merged).chunk(2, dim=-1)
            torch.testing.assert_close(mean, literal_mean, rtol=1e-4, atol=1e-4)
            expected = untrained.sigma_floor + torch.nn.functional.softplus(raw)
            torch.testing.assert_close(std, expected, rtol=1e-4, atol=1e-4)
        sum(v.sum() for v in untrained.train().decode(r, features, t)).backward()
        optimiser.step()


@pytest.mark.parametrize("beta", [0.0, 0.5])
def test_loss_is_the_gaussian_log_likelihood(untrained, beta):
    seen, t = some_observations(), torch.rand(2, 5)
    image, action, effect = torch.rand(2, 2, 48, 48), torch.rand(2, 5, 2), torch.rand(2, 5, 2)
    mu_a, sigma_a, mu_e, sigma_e = untrained(image, seen, t)
    a = torch.distributions.Normal(mu_a, sigma_a).log_prob(action / 0.1) * sigma_a ** (2 * beta)
    e = torch.distributions.Normal(mu_e, sigma_e).log_prob(effect / 0.03) * sigma_e ** (2 * beta)
    loss = untrained.loss(Batch(image, seen, t, action, effect), beta)
    torch.testing.assert_close(loss, -(a.mean() + e.mean()) / 2)
