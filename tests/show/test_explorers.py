import base64
import io

import numpy as np
import pytest
import torch
from PIL import Image

from affordlib.models.protocol import condition_on_primitives
from affordlib.primitives import Push
from affordlib.show import ConditioningExplorer, PhaseSlider
from affordlib.world import Cuboid


@pytest.fixture
def push(world):
    world.place(Cuboid(0.07, 0.05, 0.05), (0.02, -0.01), 0.4)
    return world.execute_primitive(Push.towards(0.6))


@pytest.fixture
def slider(world):
    world.place(Cuboid(0.07, 0.05, 0.05), (0.02, -0.01), 0.4)
    return PhaseSlider(world, Push.towards(0.6), phase=0.8)


@pytest.fixture
def explorer(trained, push):
    return ConditioningExplorer(trained, push)


def test_a_stop_leaves_the_object_where_the_slider_said(slider):
    before = slider.picture()
    slider._stop.click()
    expected = slider.expected(0.8)
    assert np.hypot(*(expected[:2] - slider.rest[0.8][:2])) < 1e-3
    assert np.hypot(*(expected[:2] - (0.02, -0.01))) > 0.03
    assert slider.picture() != before
    assert "Stopped there, it rests <b>" in slider._words.value
    slider._phase.value = 0.3
    assert "has moved 0.0 cm" in slider._words.value
    slider._stop.click()
    assert slider.rest[0.3] == pytest.approx((0.02, -0.01, 0.4), abs=1e-4)


@pytest.mark.slow
def test_what_is_observed_decides_what_is_predicted(explorer, trained, push):
    alone = explorer.prediction.effect_mean
    told = condition_on_primitives(trained, [push.primitive])
    t = torch.linspace(0, 1, 101)[None]
    with torch.no_grad():
        plain = trained.predict(trained.encode(torch.tensor(push.image)[None]), told, t)
    torch.testing.assert_close(alone, plain.effect_mean, atol=1e-5, rtol=1e-4)
    explorer._has_effect.value = True
    torch.testing.assert_close(explorer.prediction.effect_mean, alone)  # w₁ = 1: effect ignored
    explorer._weight.value = 0.5
    assert (explorer.prediction.effect_mean - alone).abs().max() > 1e-4
    explorer.observe_at(action_t=None, effect_t=1.0, weight=1.0)
    assert float(explorer.observations().weight) == 0.0
    end = explorer.prediction.effect_mean[0, -1, :2].numpy()
    assert np.hypot(*(end - push.effect[-1, :2])) < 0.03


def test_with_nothing_observed_it_says_so(explorer):
    seen, before = explorer._drawing.scene["handles"][0], explorer._drawing.picture
    explorer._has_action.value = False
    assert "Nothing is observed" in explorer._words.value
    assert explorer._drawing.scene["handles"] == []
    assert explorer._drawing.picture != before
    explorer._drawing.wanted = ["0", seen["right"], seen["top"], 1]  # a drag that began before
    explorer._has_effect.value = True
    (legend,) = explorer._figure.legends
    assert "observed" in [text.get_text() for text in legend.get_texts()]
    explorer.draw = lambda _: 1 / 0
    explorer.refresh()
    assert "division by zero" in explorer._words.value
    assert len(explorer._handles) == len(explorer._drawing.scene["handles"]) == 2


@pytest.mark.parametrize("name", ["slider", "explorer"])
def test_saved_widgets_leave_their_pictures(name, request):
    bundle, about = request.getfixturevalue(name)._repr_mimebundle_()
    picture = Image.open(io.BytesIO(base64.b64decode(bundle["image/png"])))
    assert picture.size[0] == 2 * about["image/png"]["width"] == 1800


def test_what_can_be_dragged_is_where_it_is_drawn(explorer):
    explorer.observe_at((0.25, 0.75), effect_t=0.9, weight=0.5)
    handles = explorer._drawing.scene["handles"]
    points = ["first action", "second action", "effect"]
    assert [h[1] for h in explorer._handles] == points[:2] * 2 + points[2:] * 2
    pixels = np.asarray(Image.open(io.BytesIO(explorer.picture())).convert("L"))
    for handle in handles:
        assert pixels[int(2 * handle["y"]), int(2 * handle["x"])] < 30  # black


def test_one_end_of_an_action_never_passes_the_other(explorer):
    explorer.observe_at((0.4, 0.75), effect_t=0.9, weight=0.5)
    k = [name for _, name, _, _ in explorer._handles].index("second action")
    handle = explorer._drawing.scene["handles"][k]
    explorer._drawing.wanted = [str(k), handle["left"], handle["top"], 1]
    assert explorer._action_t.value == pytest.approx((0.4, 0.4))


def test_what_is_set_together_is_drawn_once(explorer, monkeypatch):
    drawn, real = [], type(explorer).draw
    monkeypatch.setattr(type(explorer), "draw", lambda *a: drawn.append(1) or real(*a))
    explorer.observe_at((0.1, 0.9), 0.7, 0.4)
    assert len(drawn) == 1
