"""Lever-ups: arrays in the frame of the lever, what models may know, the older layout, pictures."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from matplotlib.figure import Figure
from PIL import Image

from affordlib.interactions import Normaliser, open_interactions
from affordlib.interactions.batches import draw_forward, symmetric_copies
from affordlib.interactions.lever import (
    AHEAD,
    MIRRORED,
    POSE_CHANNELS,
    SEEN,
    draw_beginnings,
    draw_windows,
    lever_arrays,
    n_windows,
    poses_seen,
    read_trajectories,
    write_trajectories,
)
from affordlib.interactions.recipes import Recipe, draw_scene
from affordlib.models import build
from affordlib.models.anchored import AnchoredNetwork, _last
from affordlib.models.lever import (
    LEVER_MODELS,
    PROTOCOLS,
    beginning_errors_m,
    fit_lever_model,
    foresee,
    window_errors_m,
)
from affordlib.models.lstm import LSTMConfig, on_grid
from affordlib.models.lstm_published import PublishedConfig, PublishedLSTM, train_published
from affordlib.show import Film, outline_in_lever_frame, plot_levered


@pytest.fixture(scope="module")
def data():
    return open_interactions("lever_up").isel(interaction=slice(0, 48)).load()


@pytest.fixture(scope="module")
def arrays(data):
    return lever_arrays(data)


@pytest.fixture(scope="module", params=["anchored", "lstm_tuned", "paper"])
def untrained(request, arrays):
    torch.manual_seed(0)
    model = build(LEVER_MODELS[request.param].network, Normaliser.fit(arrays))
    if hasattr(model, "fit_course"):
        model.fit_course(arrays.effect)
    return model.eval()


def short(name, **change):
    lever = LEVER_MODELS[name]
    training = replace(
        lever.training, **({"steps": 4, "batch_size": 8, "validate_every": 2} | change)
    )
    return replace(lever, training=training)


# Data


def test_arrays_are_in_the_frame_of_the_lever(data, arrays):
    assert arrays.effect.shape == (len(arrays), 26, 4)
    assert arrays.effect[:, 0].abs().max() == 0
    # Turning changes no length, and objects go where the lever points.
    kept = ~data["fault"].values
    raw = data["effect"].values[kept][:, ::12]
    np.testing.assert_allclose(
        arrays.effect[..., :2].norm(dim=-1), np.hypot(raw[..., 0], raw[..., 1]), atol=1e-6
    )
    assert arrays.effect[:, -1, 0].min() > 0.02
    # The blade comes from behind the contact, slides 12 mm under, and never leaves its plane.
    assert arrays.action[:, 0, 0].numpy() == pytest.approx(-0.03, abs=1e-5)
    assert arrays.action[:, 7, 0].numpy() == pytest.approx(0.012, abs=1e-4)
    assert (arrays.action[:, -1, 1] > 0.1 * math.sin(math.radians(65))).any()


def test_no_view_cuts_an_object_off(data, arrays):
    wide, full = (lever_arrays(data, view=view).image for view in ("wide", "full"))
    assert full.shape[-1] == 128
    assert arrays.image.shape[-1] == wide.shape[-1] == 48
    area = full[:, 1].sum(dim=(1, 2)) / 128**2
    torch.testing.assert_close(4 * arrays.image[:, 1].sum(dim=(1, 2)), full[:, 1].sum(dim=(1, 2)))
    torch.testing.assert_close(wide[:, 1].mean(dim=(1, 2)), area, rtol=0.02, atol=0)
    with pytest.raises(ValueError, match="view must be one of"):
        lever_arrays(data, view="far")


def test_mirror_images_mirror_only_what_is_across(arrays):
    both = symmetric_copies(arrays, MIRRORED)
    n = len(arrays)
    sign = torch.tensor([1.0, -1.0, 1.0, 1.0])
    torch.testing.assert_close(both.effect[n:], arrays.effect * sign)
    torch.testing.assert_close(both.image[n:], arrays.image.flip(-2))
    torch.testing.assert_close(both.action[n:], arrays.action)


def test_windows_are_fifteen_steps_and_the_next_five(arrays):
    generator = torch.Generator().manual_seed(0)
    assert n_windows(arrays) == 7
    batch = draw_windows(arrays, torch.arange(len(arrays)), AHEAD, SEEN, generator)
    seen = (batch.observations.effect_t * 25).round()
    assert (seen.diff(dim=1) == 1).all()
    assert {int(s) for s in seen[:, 0]} == set(range(7))
    torch.testing.assert_close((batch.t_target[:, 0] * 25).round(), seen[:, -1] + 1)
    assert batch.observations.effect_mask.all()
    told = {
        bool(
            draw_beginnings(arrays, torch.arange(2), 0, 0, generator).observations.effect_mask.any()
        )
        for _ in range(20)
    }
    assert told == {True, False}


# Models


def test_no_model_sees_what_it_has_to_foresee(untrained, arrays):
    """Whatever happens after the observed steps, predictions stay."""
    for protocol, last in zip(PROTOCOLS, (SEEN - 1, 0, 0), strict=True):
        later = arrays.effect.clone()
        later[:, last + 1 :] += 0.05
        told, _ = foresee(untrained, arrays, protocol)
        again, truth = foresee(untrained, replace(arrays, effect=later), protocol)
        torch.testing.assert_close(told.effect_mean, again.effect_mean)
        assert truth.shape == told.effect_mean.shape == told.effect_std.shape


def test_models_use_what_they_observe(untrained, arrays):
    earlier = arrays.effect.clone()
    earlier[:, SEEN - 1] += 0.05
    told, _ = foresee(untrained, arrays, "window")
    other, _ = foresee(untrained, replace(arrays, effect=earlier), "window")
    assert (told.effect_mean - other.effect_mean).abs().max() > 1e-3


def test_the_first_pose_tells_nothing_to_those_that_anchor(arrays):
    for name in ("anchored", "lstm_tuned"):
        torch.manual_seed(0)
        model = build(LEVER_MODELS[name].network, Normaliser.fit(arrays)).eval()
        first, none = (foresee(model, arrays, p)[0].effect_mean for p in PROTOCOLS[1:])
        if name == "lstm_tuned":
            torch.testing.assert_close(first, none)
        assert first[:, 0, :3].abs().max() < 0.05


def test_the_last_observation_is_found_in_any_order():
    off = torch.tensor([[[1.0], [4.0], [2.0], [9.0]]])
    t = torch.tensor([[0.1, 0.4, 0.2, 0.9]])
    seen = torch.tensor([[True, True, True, False]])
    value, at, speed = _last(off, t, seen)
    assert (value.item(), at.item()) == (4.0, pytest.approx(0.4))
    torch.testing.assert_close(speed, torch.tensor([[1.0]]))
    value, at, speed = _last(off, t, torch.zeros_like(seen))
    assert value.abs().sum() + at.abs().sum() + speed.abs().sum() == 0


def test_an_anchored_network_begins_where_the_object_is(arrays):
    torch.manual_seed(0)
    model = build(LEVER_MODELS["anchored"].network, Normaliser.fit(arrays)).eval()
    assert isinstance(model, AnchoredNetwork)
    model.fit_course(arrays.effect)
    seen = poses_seen(arrays, torch.zeros(len(arrays), dtype=torch.long), 10)
    t = arrays.phase[[9]].expand(len(arrays), -1)
    with torch.no_grad():
        told = model.predict(model.encode(arrays.image), seen, t)
    torch.testing.assert_close(told.effect_mean[:, 0], arrays.effect[:, 9], atol=1e-5, rtol=0)


def test_observations_fall_on_their_steps():
    t = torch.tensor([[0.2, 0.4, 0.0], [0.0, 0.0, 0.0]])
    seen = torch.tensor([[True, True, False], [False, False, False]])
    known = on_grid(torch.arange(6.0).reshape(2, 3, 1) + 1, t, seen, 5)
    assert known.where.tolist() == [[False, True, True] + [False] * 3, [True] + [False] * 5]
    assert known.first.tolist() == [1, 0]
    assert known.d[0, :, 0].tolist() == [0, 1, 2, 0, 0, 0]


def test_a_rollout_does_not_depend_on_how_far_it_is_asked(arrays):
    torch.manual_seed(0)
    model = build(LEVER_MODELS["lstm_tuned"].network, Normaliser.fit(arrays)).eval()
    torch.nn.init.normal_(model.last[-1].weight, std=0.02)
    seen = poses_seen(arrays, torch.zeros(len(arrays), dtype=torch.long), 5)
    ask = arrays.phase[[5, 12, 25]].expand(len(arrays), -1)
    with torch.no_grad():
        features = model.encode(arrays.image)
        whole = model.predict(features, seen, ask)
        near = model.predict(features, seen, ask[:, :1])
        between = model.predict(features, seen, (arrays.phase[[5]] + 0.02).expand(len(arrays), -1))
        next_one = model.predict(features, seen, arrays.phase[[6]].expand(len(arrays), -1))
    torch.testing.assert_close(whole.effect_mean[:, :1], near.effect_mean)
    middle = (near.effect_mean + next_one.effect_mean) / 2
    torch.testing.assert_close(between.effect_mean, middle, atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize(("name", "kind"), [("anchored", "all"), ("lstm_tuned", "first_step")])
def test_training_learns(arrays, name, kind):
    lever = short(name, steps=60, batch_size=16, validate_every=30, ema=0.0)
    model, history = fit_lever_model(lever, arrays, arrays, kind, progress=False)
    moves = arrays.effect[:, 1:, :3].norm(dim=-1).mean()
    assert beginning_errors_m(model, arrays).mean() < moves / 3
    assert len(history) == 2


def test_the_published_network_is_the_published_one(arrays):
    config = PublishedConfig(arrays.action_channels, arrays.effect_channels)
    torch.manual_seed(0)
    model = PublishedLSTM(config, Normaliser.fit(arrays))
    total = sum(p.numel() for p in model.parameters())
    assert 71e6 < total < 73e6
    assert [m.out_channels for m in model.cnn if hasattr(m, "out_channels")] == [32, 64, 128, 256]


@pytest.fixture
def small_published(arrays, monkeypatch):
    from affordlib.models import lstm_published

    monkeypatch.setattr(lstm_published, "CONVOLUTION_WIDTHS", (2, 2, 2, 2))
    monkeypatch.setattr(lstm_published, "LEVER_IMAGE_PIXELS", 48)
    monkeypatch.setattr(lstm_published, "DENSE", 8)

    def make():
        torch.manual_seed(0)
        config = PublishedConfig(arrays.action_channels, arrays.effect_channels)
        return PublishedLSTM(config, Normaliser.fit(arrays))

    return make


def test_its_recurrence_is_that_of_features_repeated_and_concatenated(arrays, small_published):
    model, start = small_published().eval(), torch.zeros(len(arrays), dtype=torch.long)
    lstm = torch.nn.LSTM(model.lstm.input_size, model.lstm.hidden_size, batch_first=True)
    lstm.load_state_dict({f"{k}_l0": v for k, v in model.lstm.state_dict().items()})
    pose = (arrays.effect / model.effect_scale)[:, : SEEN + 1]
    ends = (arrays.action[:, [0, -1]] / model.action_scale).flatten(1)
    again = [model.encode(arrays.image), pose[:, 0], ends]
    told = torch.cat([x[:, None].expand(-1, SEEN, -1) for x in again], dim=-1)
    told[:, :, 8 : -ends.shape[1]] = pose[:, :-1]
    phase = (torch.arange(SEEN) / model.config.steps).expand(len(arrays), -1)[..., None]
    out, _ = lstm(torch.cat([told, phase], dim=-1))
    expected = torch.nn.functional.mse_loss(model.next_pose(out), pose[:, 1:])
    torch.testing.assert_close(model.next_step_loss(arrays, start, SEEN), expected)


def test_a_published_training_goes_on_where_it_was_broken_off(tmp_path, arrays, small_published):
    def train(epochs, file):
        model = small_published()
        told = train_published(model, arrays, arrays, "window", epochs, checkpoint=file)
        return model, told

    whole, told = train(3, None)
    train(2, tmp_path / "half.pt")
    again, resumed = train(3, tmp_path / "half.pt")
    assert told["validation_error"] == resumed["validation_error"]
    for a, b in zip(whole.parameters(), again.parameters(), strict=True):
        torch.testing.assert_close(a, b, atol=0, rtol=0)
    assert window_errors_m(whole, arrays).shape == (len(arrays), 7, 5)
    assert beginning_errors_m(whole, arrays).shape == (len(arrays), 25)


def test_an_lstm_of_pushes_is_a_model_like_the_others(pushes):
    from affordlib.interactions import TrainingArrays
    from affordlib.models.protocol import EffectModel, observe_actions
    from affordlib.primitives import Push

    few = TrainingArrays.from_dataset(pushes, np.arange(8))
    torch.manual_seed(0)
    model = build(LSTMConfig(frame="push", steps=5, width=16), Normaliser.fit(few)).eval()
    torch.nn.init.normal_(model.last[-1].weight)  # zero at first, so that it begins by coasting
    assert isinstance(model, EffectModel)
    batch = draw_forward(few, torch.arange(8), 3, 1, torch.Generator().manual_seed(0))
    loss = model.loss(batch.image, batch.observations, batch.t_target, batch.action, batch.effect)
    assert torch.isfinite(loss)
    seen = observe_actions(model, [Push(0.3)])
    action = seen.action.requires_grad_()
    told = model.predict(
        model.encode(few.image[:1]), replace(seen, action=action), torch.ones(1, 1)
    )
    told.effect_mean.sum().backward()
    assert action.grad.abs().sum() > 0


# The older study's layout


@pytest.fixture
def older(tmp_path):
    """Two trajectories of 26 poses and their images."""
    poses, gray = np.zeros((2, 26, 6)), np.full((2, 128, 128), 0.8)
    poses[..., 0], poses[..., 4] = np.linspace(0.3, 0.4, 26), np.linspace(0, 1.0, 26)
    gray[:, 40:80, 64:100] = np.random.default_rng(0).uniform(0.2, 0.4, (2, 40, 36))
    write_trajectories(tmp_path, poses, gray)
    return tmp_path


def test_the_older_layout_is_read(older):
    arrays = read_trajectories(older)
    assert arrays.effect_channels == POSE_CHANNELS
    assert arrays.effect.shape == (2, 26, 4)
    torch.testing.assert_close(arrays.effect[0, -1], torch.tensor([0.1, 0.0, 0.0, 1.0]))
    assert arrays.image[:, 1].sum(dim=(1, 2)).tolist() == [40 * 36] * 2
    small = replace(arrays, image=torch.nn.functional.interpolate(arrays.image, (48, 48)))
    model, history = fit_lever_model(short("lstm_tuned"), small, small, "window", progress=False)
    assert len(history) == 2
    assert window_errors_m(model, small).shape == (2, 7, 5)


def test_other_lengths_of_the_older_layout_are_learned_from(older, tmp_path):
    poses, gray = np.zeros((20, 41, 6)), np.full((20, 128, 128), 0.8)
    poses[..., 2] = np.linspace(0.0, 0.2, 41)
    gray[:, 40:80, 64:100] = np.random.default_rng(1).uniform(0.2, 0.4, (20, 40, 36))
    write_trajectories(tmp_path / "long", poses, gray)
    arrays = read_trajectories(tmp_path / "long", view="wide")
    assert arrays.image.shape == (20, 2, 48, 48)
    for name, kind in (("anchored", "all"), ("lstm_tuned", "window")):
        model, _ = fit_lever_model(short(name), arrays, arrays, kind, progress=False)
        assert window_errors_m(model, arrays).shape == (20, 41 - 19, 5)


@pytest.mark.parametrize(
    ("spoil", "reason"),
    [
        (lambda f: (f / "images" / "0001.png").unlink(), "no image 0001.png"),
        (lambda f: (f / "trajectories" / "0001.txt").write_text("1 2 3\n"), "six finite numbers"),
        (
            lambda f: (f / "trajectories" / "0001.txt").write_text("1 2 x 4 5 6\n"),
            "0001.txt: every row",
        ),
        (lambda f: (f / "trajectories" / "0001.txt").write_text("0 0 0 0 0 0\n"), "has 1 rows"),
        (lambda f: [p.unlink() for p in (f / "trajectories").iterdir()], "no file trajectories"),
        (lambda f: Image.new("L", (9, 9)).save(f / "images" / "0001.png"), "must be 128×128"),
    ],
)
def test_what_is_wrong_with_a_folder_is_said(older, spoil, reason):
    spoil(older)
    with pytest.raises((ValueError, FileNotFoundError), match=reason):
        read_trajectories(older)


# Pictures


def test_the_drawn_polygon_is_the_one_in_the_image(data):
    from matplotlib.path import Path as Outline

    recipe = Recipe.from_json(data.attrs["recipe"])
    masks = lever_arrays(data, view="full").image[:, 1].numpy() > 0.5
    centre = ((np.arange(128) + 0.5) / 128 - 0.5) * 0.56
    grid = np.stack(np.meshgrid(centre, -centre), axis=-1).reshape(-1, 2)
    kept = np.flatnonzero(~data["fault"].values)
    for row in (0, 5, 11):
        number = int(kept[row])
        thing, yaw, _ = draw_scene(recipe, number)
        lever = data.isel(interaction=number)
        contact = np.array([float(lever["contact_x"]), float(lever["contact_y"])])
        outline = outline_in_lever_frame(thing, yaw, contact, float(lever["theta"]))
        inside = Outline(outline).contains_points(grid).reshape(128, 128)
        assert (inside & masks[row]).sum() > 0.96 * (inside | masks[row]).sum()


def test_a_levered_prism_is_drawn_where_it_is():
    square = np.array([[0.0, -0.1], [0.2, -0.1], [0.2, 0.1], [0.0, 0.1]])
    figure = Figure()
    ax = plot_levered(figure.subplots(), square, 0.04, np.zeros(4), "k")
    low, high = (100 * np.array(v) for v in (0.0 - 0.3 * 0.1, 0.04 + 0.3 * 0.1))
    drawn = np.concatenate([line.get_xydata() for line in ax.lines])
    assert (drawn[:, 1].min(), drawn[:, 1].max()) == (pytest.approx(low), pytest.approx(high))
    # Upended: as high as it was long.
    pose = np.array([0.0, 0.0, 0.1 - 0.02, math.pi / 2])
    upended = plot_levered(Figure().subplots(), square, 0.04, pose, "k")
    top = max(line.get_ydata().max() for line in upended.lines)
    assert top == pytest.approx(100 * (0.2 + 0.3 * 0.1))
    film = Film(height=100)
    film.add(figure)
    assert film.frames[0].shape[0] == 100


def test_a_published_training_of_something_else_is_not_gone_on_with(
    tmp_path, arrays, small_published
):
    file = tmp_path / "half.pt"
    train_published(small_published(), arrays, arrays, "window", 1, checkpoint=file)
    for other in ({"seed": 1}, {"trained_for": "first_step"}):
        told = {"trained_for": "window", "epochs": 2, "checkpoint": file} | other
        with pytest.raises(ValueError, match="delete it, or train as it was begun"):
            train_published(small_published(), arrays, arrays, **told)


def test_the_course_of_pushes_is_that_seen_from_behind(pushes):
    from affordlib.interactions import TrainingArrays
    from affordlib.models.make_checkpoints import courses

    few = TrainingArrays.from_dataset(pushes, np.arange(60), ("x", "y"), ("x", "y", "yaw"))
    config = LSTMConfig(effect_channels=("x", "y", "yaw"), frame="push", width=16)
    model = build(config, Normaliser.fit(few))
    mean = courses(model, few).mean(dim=0)
    assert mean.shape == (26, 3)
    torch.testing.assert_close(mean[:, 1:], torch.zeros(26, 2), atol=1e-6, rtol=0)
    length = float(few.effect[:, -1, :2].norm(dim=-1).mean())
    assert float(mean[-1, 0]) == pytest.approx(length, rel=0.2)
