"""The paper's network: layers, equations and likelihood."""

import pytest
import torch
from torch import nn

from affordlib.interactions.dataset import Batch
from affordlib.models import CNPConfig
from affordlib.types import Observations

N = 7


def some_observations() -> Observations:
    g = torch.Generator().manual_seed(0)
    shapes = ((2, N, 2), (2, N)) * 2
    action, action_t, effect, effect_t = (torch.rand(*shape, generator=g) for shape in shapes)
    both = (action_t, 0.2 * action), (effect_t, 0.1 * effect)
    return Observations.of(CNPConfig(), *both, torch.rand(2, generator=g))


def linear_sizes(module: nn.Module) -> list[tuple[int, int]]:
    layers = [layer for layer in module.modules() if isinstance(layer, nn.Linear)]
    return [(layer.in_features, layer.out_features) for layer in layers]


def test_layer_table_of_the_appendix(untrained):
    encoder = [(3, 32), (32, 64), (64, 64), (64, 128), (128, 128), (128, 256), (256, 128)]
    decoder = [(1024, 512), (512, 256), (256, 128), (128, 32), (32, 4)]
    assert linear_sizes(untrained.action_encoder) == encoder
    assert linear_sizes(untrained.effect_encoder) == encoder
    assert isinstance(untrained.action_encoder[-1], nn.LeakyReLU)
    assert isinstance(untrained.effect_encoder[-1], nn.Linear)
    assert linear_sizes(untrained.merge) == [(128 + 16 + 1, 1024)]
    assert linear_sizes(untrained.action_decoder) == decoder
    assert linear_sizes(untrained.effect_decoder) == decoder
    assert sum(p.numel() for p in untrained.parameters()) == 2_009_912

    shapes, x = [], torch.zeros(1, 2, 48, 48)
    for layer in untrained.image_encoder:
        x = layer(x)
        if isinstance(layer, nn.MaxPool2d):
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
            expected = untrained.sigma_floor + nn.functional.softplus(raw)
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
