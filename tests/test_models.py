import json
import math
import pickle

import numpy as np
import pytest
import torch
from safetensors.torch import save
from torch import nn

from affordlib.evaluation import refuse_seen
from affordlib.evaluation.baselines import constant
from affordlib.interactions import InteractionTensors, Scaler, split_interactions
from affordlib.interactions.sampling import condition_on_recorded_action
from affordlib.models import (
    AffordanceCNP,
    CNPConfig,
    EffectModel,
    FiLMConfig,
    TrainingConfig,
    condition_on_primitives,
    load_checkpoint,
    save_checkpoint,
    train,
)
from affordlib.models.checkpoint import read_weights, write_weights
from affordlib.models.training import final_errors_m
from affordlib.planning.reachability import Reachability
from affordlib.primitives import Push
from affordlib.types import Observations

N = 7


def some_observations(seed: int = 0, n: int = N, m: int = N) -> Observations:
    g = torch.Generator().manual_seed(seed)

    def rand(*shape: int) -> torch.Tensor:
        return torch.rand(*shape, generator=g)

    action, action_t, effect, effect_t = rand(2, n, 2), rand(2, n), rand(2, m, 2), rand(2, m)
    both = (action_t, 0.2 * action), (effect_t, 0.1 * effect)
    return Observations.of(CNPConfig(), *both, rand(2))


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


def test_it_is_an_effect_model(untrained):
    assert isinstance(untrained, EffectModel)


def test_order_of_observations_does_not_matter(untrained):
    seen = some_observations()
    order = torch.randperm(N, generator=torch.Generator().manual_seed(1))
    shuffled = Observations(
        seen.action[:, order], seen.action_t[:, order], seen.action_mask,
        seen.effect, seen.effect_t, seen.effect_mask, seen.weight,
    )  # fmt: skip
    torch.testing.assert_close(untrained.represent(seen), untrained.represent(shuffled))


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


def test_masked_observations_count_for_nothing(untrained):
    seen = some_observations()
    mask = torch.arange(N) < 3
    hidden = Observations(
        torch.where(mask[:, None], seen.action, 1e3), seen.action_t, mask.expand(2, -1),
        seen.effect, seen.effect_t, seen.effect_mask, seen.weight,
    )  # fmt: skip
    short = Observations(
        seen.action[:, :3], seen.action_t[:, :3], seen.action_mask[:, :3],
        seen.effect, seen.effect_t, seen.effect_mask, seen.weight,
    )  # fmt: skip
    torch.testing.assert_close(untrained.represent(hidden), untrained.represent(short))


def test_folded_decoding_equals_the_layers_one_by_one(untrained):
    r, features = torch.randn(2, 128), torch.randn(2, 16)
    t = torch.rand(2, 60)
    known = torch.cat([r, features], dim=1)[:, None].expand(-1, 60, -1)
    merged = untrained.merge(torch.cat([known, t[..., None]], dim=-1))
    mu_a, sigma_a, mu_e, sigma_e = untrained.decode(r, features, t)
    for decoder, mean, std in (
        (untrained.action_decoder, mu_a, sigma_a),
        (untrained.effect_decoder, mu_e, sigma_e),
    ):
        literal_mean, raw = decoder(merged).chunk(2, dim=-1)
        torch.testing.assert_close(mean, literal_mean, rtol=1e-4, atol=1e-4)
        expected = untrained.sigma_floor + nn.functional.softplus(raw)
        torch.testing.assert_close(std, expected, rtol=1e-4, atol=1e-4)


def test_loss_is_the_gaussian_log_likelihood(untrained):
    seen, t = some_observations(), torch.rand(2, 5)
    image, action, effect = torch.rand(2, 2, 48, 48), torch.rand(2, 5, 2), torch.rand(2, 5, 2)
    mu_a, sigma_a, mu_e, sigma_e = untrained(image, seen, t)
    a = torch.distributions.Normal(mu_a, sigma_a).log_prob(action / 0.1).mean()
    e = torch.distributions.Normal(mu_e, sigma_e).log_prob(effect / 0.03).mean()
    torch.testing.assert_close(untrained.loss(image, seen, t, action, effect), -(a + e) / 2)


def test_gradient_with_respect_to_the_observed_effect(untrained):
    """The gradient planner descends it; compare with finite differences, in double precision."""
    model = untrained.double()
    features = model.encode(torch.rand(1, 2, 48, 48, dtype=torch.float64))

    def predicted(effect: torch.Tensor) -> torch.Tensor:
        one = torch.ones(1, 1, dtype=torch.float64)
        seen = Observations.of(model, effect=(one, effect[:, None]))
        return model.predict(features, seen, one).effect_mean

    effect = torch.tensor([[0.05, -0.08]], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(predicted, (effect,), eps=1e-7, atol=1e-6)


def mean_length_error_m(training, test):
    """Of knowing only the direction and the mean length."""
    mean, _ = constant(training, test, torch.tensor([-1]))
    return (mean[:, 0] - test.effect[:, -1]).norm(dim=-1).mean()


@pytest.mark.slow
def test_a_minute_of_training_beats_the_mean_length(pushes):
    """The check that an eighth of the shipped training already learns what an image tells."""
    split = split_interactions(500)
    training = InteractionTensors.from_dataset(pushes, split.train)
    validation = InteractionTensors.from_dataset(pushes, split.validation)
    torch.manual_seed(0)
    model = AffordanceCNP(CNPConfig(), Scaler.fit(training))
    config = TrainingConfig(steps=600, n_targets=8, batch_size=48, validate_every=200)
    history = train(model, training, validation, config, progress=False)
    assert history[-1].loss < history[0].loss
    errors = final_errors_m(model, validation)
    # Early stopping keeps the best weights, not the last.
    assert errors.mean() == pytest.approx(min(h.validation_error for h in history), rel=1e-4)
    assert errors.mean() < mean_length_error_m(training, validation)


def test_training_is_repeatable(pushes):
    arrays = InteractionTensors.from_dataset(pushes, np.arange(40))
    weights = []
    for _ in range(2):
        torch.manual_seed(1)
        model = AffordanceCNP(CNPConfig(), Scaler.fit(arrays))
        train(model, arrays, arrays, TrainingConfig(steps=3, batch_size=8), progress=False)
        weights.append(model.merge.weight.detach().clone())
    assert torch.equal(*weights)


@pytest.mark.slow
def test_the_shipped_model_on_the_held_out_pushes(trained, held_out_pushes, pushes):
    """Under 4 mm, and clearly better than a direction and a mean length."""
    test = InteractionTensors.from_dataset(held_out_pushes)
    training = InteractionTensors.from_dataset(pushes, split_interactions(500).train)
    errors = final_errors_m(trained, test)
    assert len(errors) == 1000
    assert errors.mean() < 0.004  # 2.7 mm
    assert errors.mean() < 0.75 * mean_length_error_m(training, test)
    # Conditioned on the effect instead, it finds the action that gives it.
    n = len(test)
    seen = Observations.of(test, effect=test.effect_at(torch.tensor([-1])))
    action = trained.predict(trained.encode(test.image), seen, torch.zeros(n, 1)).action_mean
    turned = torch.atan2(action[:, 0, 1], action[:, 0, 0]) - torch.atan2(
        test.action[:, 0, 1], test.action[:, 0, 0]
    )
    degrees = torch.rad2deg(torch.atan2(turned.sin(), turned.cos())).abs()
    assert degrees.median() < 8


def test_encoding_once_equals_encoding_each_time(trained, held_out_pushes):
    one = InteractionTensors.from_dataset(held_out_pushes, np.arange(1))
    pushed = [Push(theta) for theta in np.linspace(0, 6, 8)]
    seen, t = condition_on_primitives(trained, pushed), torch.ones(8, 1)
    once = trained.predict(trained.encode(one.image), seen, t)
    each = trained.predict(trained.encode(one.image.expand(8, -1, -1, -1)), seen, t)
    torch.testing.assert_close(once.effect_mean, each.effect_mean, rtol=1e-4, atol=1e-6)
    # What condition_on_primitives commands is what the data set stores.
    recorded = condition_on_recorded_action(one)
    again = condition_on_primitives(trained, [Push(float(held_out_pushes["theta"][0]))])
    torch.testing.assert_close(recorded.action, again.action, atol=1e-6, rtol=0)


def test_checkpoint_round_trip(untrained, tmp_path):
    path = save_checkpoint(untrained, tmp_path / "m.safetensors", {"note": "none"})
    again, about = load_checkpoint(path)
    assert about == {"note": "none"}
    assert again.scaler == untrained.scaler
    for name, value in untrained.state_dict().items():
        assert torch.equal(again.state_dict()[name], value)
    assert [p.name for p in tmp_path.iterdir()] == ["m.safetensors"]


def test_a_bad_checkpoint_is_named(untrained, tmp_path):
    with pytest.raises(FileNotFoundError, match=r"'nobody'.*'cnp_500'"):
        load_checkpoint("nobody")
    path = save_checkpoint(untrained, tmp_path / "m.safetensors", {})
    whole = path.read_bytes()
    tensors, description = read_weights(path, "")
    wrong = {
        "half": lambda: path.write_bytes(whole[: len(whole) // 2]),
        "a pickle": lambda: path.write_bytes(pickle.dumps({"weights": [1.0]})),
        "not a number": lambda: write_weights(path, {"a": torch.tensor([math.nan])}, description),
        "no description": lambda: path.write_bytes(save(tensors)),
        "another kind": lambda: write_weights(path, tensors, {"format": "something else"}),
        "another model": lambda: write_weights(path, tensors, description | {"model": "lstm"}),
        "half numbers": lambda: write_weights(
            path, {name: value.half() for name, value in tensors.items()}, description
        ),
        "no scale": lambda: write_weights(
            path,
            tensors,
            description | {"normaliser": description["normaliser"] | {"action_scale": [0.0, 1.0]}},
        ),
        "one temperature": lambda: write_weights(
            path, tensors, description | {"config": description["config"] | {"temperature": [1.0]}}
        ),
    }
    for spoil in wrong.values():
        path.unlink()
        spoil()
        with pytest.raises(ValueError, match=r"(?s)m\.safetensors.*train it again"):
            load_checkpoint(path)


def test_a_network_of_absurd_size_is_refused_at_once():
    with pytest.raises(ValueError, match=r"blocks must lie in \[1, 4096\]"):
        FiLMConfig(blocks=10**7)


def damaged_by_a_bit(content, rng):
    spoiled = bytearray(content)
    spoiled[rng.integers(len(content))] ^= 1 << int(rng.integers(8))
    return bytes(spoiled)


def test_no_flipped_bit_loads_as_another_model(untrained, tmp_path):
    rng = np.random.default_rng(0)
    reach = Reachability()
    files = {
        save_checkpoint(untrained, tmp_path / "m.safetensors", {"note": "none"}): load_checkpoint,
        reach.save(tmp_path / "r.safetensors"): Reachability.load,
    }
    for path, load in files.items():
        whole = path.read_bytes()
        header = 8 + int.from_bytes(whole[:8], "little")
        for number in range(100):
            part = whole[:header] if number % 2 else whole
            path.write_bytes(damaged_by_a_bit(part, rng) + whole[len(part) :])
            with pytest.raises(ValueError, match=path.name):
                load(path)


def test_a_file_that_is_no_checkpoint_is_not_replaced(untrained, tmp_path):
    notes = tmp_path / "m.safetensors"
    notes.write_text("notes")
    (tmp_path / "f.safetensors").mkdir()
    (tmp_path / "l.safetensors").symlink_to(tmp_path / "nowhere")
    for name in "mfl":
        with pytest.raises(FileExistsError, match=f"{name}.safetensors is there and is not"):
            save_checkpoint(untrained, tmp_path / f"{name}.safetensors", {})
    assert notes.read_text() == "notes"


def test_a_failed_save_leaves_nothing(untrained, tmp_path):
    with pytest.raises(ValueError, match="not JSON compliant"):
        save_checkpoint(untrained, tmp_path / "m.safetensors", {"loss": math.nan})
    assert list(tmp_path.iterdir()) == []


def test_a_model_is_not_judged_on_what_it_saw(pushes, held_out_pushes):
    _, about = load_checkpoint("cnp_500")
    split = split_interactions(500)
    refuse_seen(about, pushes, split.test)
    refuse_seen(about, held_out_pushes, np.arange(1000))
    for part in (split.train, split.validation):
        with pytest.raises(ValueError, match="was trained or tuned on"):
            refuse_seen(about, pushes, part)


def test_in_doubt_a_model_is_not_judged(pushes):
    """Neither a recipe of an earlier version, with fewer fields, nor none opens the test."""
    _, about = load_checkpoint("cnp_500")
    seen = split_interactions(500).train
    older = json.loads(about["recipe"])
    del older["anywhere"], older["world"]["tip_offset_m"]
    rougher = json.loads(about["recipe"])
    rougher["world"]["table_friction"] = 0.6
    for recipe in (older, rougher):
        with pytest.raises(ValueError, match="was trained or tuned on"):
            refuse_seen(about | {"recipe": json.dumps(recipe)}, pushes, seen)
    for unknown in ({}, about | {"recipe": "{}"}, about | {"recipe": '{"seeds": 1}'}):
        with pytest.raises(ValueError, match="does not say which interactions"):
            refuse_seen(unknown, pushes, seen)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: TrainingConfig(steps=0), "steps .* 0"),
        (lambda: TrainingConfig(learning_rate=math.nan), "learning_rate .* nan"),
        (lambda: TrainingConfig(max_minutes=-1), "max_minutes .* -1"),
        (lambda: CNPConfig(sigma_floor=0.0), "sigma_floor .* 0.0"),
        (lambda: CNPConfig(action_channels=()), "action_channels must name"),
    ],
)
def test_bad_settings_are_named(make, words):
    with pytest.raises(ValueError, match=words):
        make()


def test_of_whatever_size_a_set_of_the_same_recipe_is_known(pushes):
    _, about = load_checkpoint("cnp_500")
    larger = json.loads(pushes.attrs["recipe"]) | {"n_interactions": 2000}
    with pytest.raises(ValueError, match="was trained or tuned on"):
        refuse_seen(about, pushes.assign_attrs(recipe=json.dumps(larger)), np.arange(500))


def test_folded_weights_are_those_of_now(untrained):
    """A fused optimiser changes weights without leaving a trace on them."""
    model, t_target = untrained, torch.linspace(0, 1, 120)[None]
    observed, features = condition_on_primitives(model, [Push(0.3)]), torch.zeros(1, 16)

    def told():
        with torch.no_grad():
            return model.eval().predict(features, observed, t_target).effect_mean

    before = told()
    optimiser = torch.optim.Adam(model.parameters(), 1e-3, fused=True)
    for _ in range(3):
        model.train().predict(features, observed, t_target).effect_mean.sum().backward()
        optimiser.step()
    after = told()
    assert (after - before).abs().max() > 1e-4
    with torch.no_grad():  # few targets: nothing is folded
        plain = model.predict(features, observed, t_target[:, :1]).effect_mean
    torch.testing.assert_close(after[:, :1], plain)
