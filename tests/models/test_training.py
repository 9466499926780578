"""Training: both loops, bit-identical resuming, target errors; checkpoints restore it or raise."""

import dataclasses
import json
import math
import operator
import pickle

import numpy as np
import pytest
import torch
from safetensors.torch import save

from affordlib import models
from affordlib.interactions import InteractionTensors, Scaler, split_interactions
from affordlib.interactions.dataset import condition_on_recorded_action
from affordlib.models.evaluation import final_errors_m, refuse_seen
from affordlib.planning import EffectMap
from affordlib.planning.skills import Reachability
from affordlib.results import repo_root
from affordlib.weights import read_weights, write_weights
from experiments.baselines import constant
from experiments.published import one_at_a_time
from experiments.runner import checkpoint_sha256
from tests.waiting import flipped, printed


def fresh(arrays):
    """An untrained small network."""
    torch.manual_seed(0)
    channels, small = (arrays.action_channels, arrays.effect_channels), {"width": 32, "blocks": 2}
    config = models.FiLMConfig(*channels, **small, rings=3, orders=4)
    return models.build(config, Scaler.fit(arrays)).eval()


def test_the_literal_loop_draws_up_to_all_observations(some):
    g = torch.Generator().manual_seed(0)
    counts = [one_at_a_time(some, 1, 10, g).observations.action_t.shape[1] for _ in range(200)]
    assert set(counts) == set(range(1, 11))


def test_a_training_that_never_validates_or_has_channels_in_another_order_says_so(some):
    config = models.TrainingConfig(steps=20, validate_every=10, learning_rate=0.5)
    never = {"score": lambda model, tensors: torch.full((len(tensors),), math.nan)}
    with pytest.raises(ValueError, match=r"learning_rate 0\.5: no validation error was finite"):
        models.train(fresh(some), some, some, config, **never)
    other = dataclasses.replace(some, effect_channels=("yaw", "x", "y"))
    for act in (final_errors_m, lambda model, data: models.train(model, some, data)):
        with pytest.raises(ValueError, match=r"has the effect_channels .* the model needs"):
            act(fresh(some), other)


def test_training_resumes_to_the_same_bits(some, tmp_path, monkeypatch):
    config = models.TrainingConfig(steps=9, batch_size=16, validate_every=2, ema=0.9)
    whole = fresh(some)
    history = models.train(whole, some, some, config)
    broken, calls, loss_of = fresh(some), [], models.FiLMNetwork.loss

    def stop(model, batch, beta):
        calls.append(0)
        if len(calls) == 6:
            raise KeyboardInterrupt
        return loss_of(model, batch, beta)

    file = tmp_path / "run" / "training.pt"
    with monkeypatch.context() as patch:
        patch.setattr(models.FiLMNetwork, "loss", stop)
        with pytest.raises(KeyboardInterrupt):
            models.train(broken, some, some, config, resume_checkpoint=file)
    again = fresh(some)
    resumed = models.train(again, some, some, config, resume_checkpoint=file)
    kept = operator.attrgetter("step", "loss", "validation_error")
    assert [*map(kept, resumed)] == [*map(kept, history)]
    assert all(map(torch.equal, whole.parameters(), again.parameters()))
    assert again.sigma_floor == whole.sigma_floor
    other = dataclasses.replace(config, steps=10)
    with pytest.raises(ValueError, match="resume_checkpoint is of a training with other steps"):
        models.train(fresh(some), some, some, other, resume_checkpoint=file)


def test_a_foreign_or_damaged_state_of_a_training_is_named(some, tmp_path):
    config = models.TrainingConfig(steps=2, batch_size=4, validate_every=1)
    file = tmp_path / "training.pt"
    models.train(fresh(some), some, some, config, resume_checkpoint=file)
    damaged = flipped(file.read_bytes(), file.stat().st_size // 2)
    for content in (damaged, damaged[:-9], b"", b"notes", pickle.dumps({"about": 1})):
        file.write_bytes(content)
        says = r"training\.pt' is damaged or holds no training state"
        with pytest.raises(ValueError, match=says) as caught:
            models.train(fresh(some), some, some, config, resume_checkpoint=file)
        assert "weights_only" not in str(caught.value)
        assert caught.value.__suppress_context__


def test_training_continues_from_a_loaded_model_as_from_the_one_in_memory(some, tmp_path):
    """The σ floor goes on from where it stopped, and never rises."""
    model = fresh(some)
    config = models.TrainingConfig(steps=4, validate_every=2, final_sigma_floor=0.005)
    models.train(model, some, some, config)
    models.fit_sigma_scale(model, some)
    again, _ = models.load_checkpoint(models.save_checkpoint(model, tmp_path / "m.safetensors", {}))
    torch.testing.assert_close(again.state_dict(), model.state_dict(), rtol=0, atol=0)
    assert again.config == model.config == fresh(some).config
    floor = float(model.sigma_floor)
    for one in (model, again):
        models.train(one, some, some, models.TrainingConfig(steps=3, validate_every=1))
        assert float(one.sigma_floor) == floor
    assert all(map(torch.equal, model.parameters(), again.parameters()))


def test_images_of_another_width_or_size_are_refused(some, cuboid_image):
    config = models.FiLMConfig(some.action_channels, some.effect_channels)
    model = models.build(config, Scaler.fit(some), models.TrainingDomain.fit(some))
    wider = dataclasses.replace(some, image_width_m=0.2)
    with pytest.raises(ValueError, match=r"validation has images 0\.2 m wide, .* 0\.16 m wide"):
        models.train(model, some, wider)
    with pytest.raises(ValueError, match=r"image has 24×24 pixels, trained on 48×48"):
        model.encode(some.image[..., ::2, ::2])
    model.domain = dataclasses.replace(model.domain, image_width_m=0.2)
    with pytest.raises(ValueError, match=r"image has images 0\.16 m wide, but .* 0\.2 m wide"):
        EffectMap(model, cuboid_image)


@pytest.mark.slow
def test_a_short_training_beats_the_mean_length(pushes):
    """600 steps, a quarter of a minute, already use the image."""
    split = split_interactions(500)
    training = InteractionTensors.from_dataset(pushes, split.train)
    validation = InteractionTensors.from_dataset(pushes, split.validation)
    torch.manual_seed(0)
    model = models.build(models.FiLMConfig(), Scaler.fit(training))
    config = models.TrainingConfig(steps=600, n_targets=8, batch_size=48, validate_every=200)
    history = models.train(model, training, validation, config)
    assert history[-1].loss < history[0].loss
    errors = final_errors_m(model, validation)
    # Early stopping keeps the best weights, not the last.
    assert errors.mean() == pytest.approx(min(h.validation_error for h in history), rel=1e-4)
    mean, _ = constant(training, validation, torch.tensor([-1]))
    of_mean = (mean[:, 0] - validation.effect[:, -1]).norm(dim=-1)
    assert errors.mean() < 0.5 * of_mean.mean()  # 1.3 of 7 mm


@pytest.mark.slow
@pytest.mark.parametrize(("n", "most"), [(500, (1.0, 1.5, 4.0, 3.0)), (5000, (0.5, 0.8, 2.5, 1.5))])
def test_the_shipped_networks_reach_their_goals(n, most, held_out_pushes):
    model, about = models.load_checkpoint(f"film_{n}")
    all_mm, cuboid_mm, p95_mm, yaw_deg = most
    split = split_interactions(n)
    assert about["seen_interactions"] == sorted([*split.train, *split.validation])
    channels = model.action_channels, model.effect_channels
    test = InteractionTensors.from_dataset(held_out_pushes, None, *channels)
    errors = 1000 * final_errors_m(model, test)
    box = torch.from_numpy(held_out_pushes["category"].values == 0)
    assert (errors[box].mean() + errors[~box].mean()) / 2 < all_mm
    assert errors[box].mean() < cuboid_mm
    assert errors.quantile(0.95) < p95_mm
    with torch.no_grad():
        given = condition_on_recorded_action(test), torch.ones(len(test), 1)
        predicted = model.predict(model.encode(test.image), *given)
    off = (predicted.effect_mean[:, 0, 2] - test.effect[:, -1, 2])[box].abs().mean()
    assert math.degrees(off) < yaw_deg


def test_the_hash_is_of_all_that_decides_the_predictions(untrained, tmp_path):
    def sha256(about):
        path = models.save_checkpoint(untrained, tmp_path / "m.safetensors", about)
        return checkpoint_sha256(path)

    first = sha256({})
    assert sha256({"note": "another"}) == first
    untrained.sigma_scale.fill_(3.0)
    assert sha256({}) != first


def test_a_bad_checkpoint_is_named(untrained, tmp_path):
    with pytest.raises(FileNotFoundError, match=r"'nobody'.*'cnp_500'"):
        models.load_checkpoint("nobody")
    path = models.save_checkpoint(untrained, tmp_path / "m.safetensors", {})
    whole = path.read_bytes()
    tensors, description = read_weights(path, "")
    half = {name: value.half() for name, value in tensors.items()}
    scaler = {"scaler": description["scaler"] | {"action_scale": [0.0, 1.0]}}
    config = {"config": description["config"] | {"sigma_floor": 0}}
    for spoil in (
        lambda: path.write_bytes(whole[: len(whole) // 2]),
        lambda: path.write_bytes(pickle.dumps({"weights": [1.0]})),
        lambda: path.write_bytes(save(tensors)),
        lambda: write_weights(path, {"a": torch.tensor([math.nan])}, description),
        lambda: write_weights(path, tensors, {"format": "something else"}),
        lambda: write_weights(path, half, description),
        lambda: write_weights(path, tensors, description | scaler),
        lambda: write_weights(path, tensors, description | config),
    ):
        path.unlink()
        spoil()
        with pytest.raises(ValueError, match=r"(?s)m\.safetensors.*train it again"):
            models.load_checkpoint(path)


def test_a_shipped_network_from_elsewhere_loads_in_a_fresh_process():
    code = "from affordlib.models import load_checkpoint as load; print(*load('lstm_500')[1])"
    assert "seen_interactions" in printed(code, cwd=repo_root())


def test_a_renamed_checkpoint_is_refused(monkeypatch, tmp_path):
    (tmp_path / "data" / "checkpoints").mkdir(parents=True)
    names = [f"data/checkpoints/{name}.safetensors" for name in ("cnp_500", "film_500")]
    (tmp_path / names[1]).write_bytes((repo_root() / names[0]).read_bytes())
    monkeypatch.setattr("affordlib.results.repo_root", lambda: tmp_path)
    with pytest.raises(ValueError, match=r"film_500\.safetensors .*it is 'cnp_500', renamed"):
        models.load_checkpoint("film_500")
    models.load_checkpoint(tmp_path / names[1])  # a path may have any name


def test_no_flipped_bit_loads_as_another_model(untrained, tmp_path):
    rng = np.random.default_rng(0)
    network = models.save_checkpoint(untrained, tmp_path / "m.safetensors", {"note": "none"})
    reach = Reachability(("push",)).save(tmp_path / "r.safetensors")
    for path, load in ((network, models.load_checkpoint), (reach, Reachability.load)):
        whole = path.read_bytes()
        header = 8 + int.from_bytes(whole[:8], "little")
        for number in range(50):
            at = rng.integers(header if number % 2 else len(whole))
            path.write_bytes(flipped(whole, at, rng.integers(8)))
            with pytest.raises(ValueError, match=path.name):
                load(path)


def test_what_is_no_checkpoint_is_not_replaced(untrained, tmp_path):
    (tmp_path / "m.safetensors").write_text("notes")
    (tmp_path / "f.safetensors").mkdir()
    (tmp_path / "l.safetensors").symlink_to(tmp_path / "nowhere")
    for name in "mfl":
        with pytest.raises(FileExistsError, match=f"{name}.safetensors exists and is not"):
            models.save_checkpoint(untrained, tmp_path / f"{name}.safetensors", {})
    assert (tmp_path / "m.safetensors").read_text() == "notes"


def test_a_model_is_not_judged_on_what_it_saw(pushes, held_out_pushes):
    """Subsets of a recipe, and recipes written with fewer fields, also count as seen."""
    _, about = models.load_checkpoint("cnp_500")
    split = split_interactions(500)
    refuse_seen(about, pushes, split.test)
    refuse_seen(about, held_out_pushes, np.arange(1000))
    older, rougher = json.loads(about["recipe"]), json.loads(about["recipe"])
    del older["anywhere"], older["world"]["tip_offset_m"]
    rougher["world"]["table_friction"] = 0.6
    larger = json.loads(pushes.attrs["recipe"]) | {"n_interactions": 2000}
    for known, data, part in (
        (about, pushes, split.train),
        (about, pushes, split.validation),
        (about | {"recipe": json.dumps(older)}, pushes, split.train),
        (about | {"recipe": json.dumps(rougher)}, pushes, split.train),
        (about, pushes.assign_attrs(recipe=json.dumps(larger)), np.arange(500)),
    ):
        with pytest.raises(ValueError, match="was trained or tuned on"):
            refuse_seen(known, data, part)
