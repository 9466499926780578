"""Figures, and explorers whose sliders need no kernel."""

import json
import os
import re

import matplotlib.pyplot as plt
import numpy as np
import pytest
import torch
from PIL import Image

from affordlib.models.base import condition_on_primitives
from affordlib.planning import execute_plan, plan_astar
from affordlib.primitives import Push
from affordlib.show import (
    conditioning_explorer,
    phase_explorer,
    plot_footprint,
    plot_outcome,
    plot_table,
)
from affordlib.types import Goal
from affordlib.world import Cuboid
from tests.problems import problem_of
from tests.waiting import printed


def test_a_footprint_is_drawn_where_the_object_is(world, trained):
    figure, ax = plt.subplots()
    plot_footprint(plot_table(ax), Cuboid(0.06, 0.04, 0.05), (0.1, -0.05), np.pi / 2)
    outline = ax.lines[-1].get_xydata()
    np.testing.assert_allclose(np.ptp(outline, axis=0), [4.0, 6.0], atol=1e-9)
    np.testing.assert_allclose(outline[:-1].mean(axis=0), [10.0, -5.0], atol=1e-9)
    world.place(Cuboid(0.06, 0.05, 0.05))
    problem = problem_of(trained, world.depth_image(), (0.0, 0.0), Goal((0.12, 0.0)))
    outcome = execute_plan(world, plan_astar(problem))
    assert "mm from the goal" in plot_outcome(ax, outcome, world.obj).get_title(loc="left")
    last = [line.get_xydata()[:-1] for line in ax.lines if len(line.get_xydata()) == 5][-1]
    np.testing.assert_allclose(last.mean(axis=0), 100 * np.array(outcome.end_pose[:2]), atol=1e-9)
    plt.close(figure)


def test_the_configuration_of_a_reader_changes_no_figure(tmp_path):
    (tmp_path / "matplotlibrc").write_text(
        "text.usetex: True\nfont.family: fantasy\naxes.grid: False\nfigure.figsize: 2, 2\n"
        "axes.facecolor: black\nsavefig.bbox: tight\naxes.prop_cycle: cycler('color', ['red'])\n"
    )
    code = (
        "import matplotlib.pyplot as plt\nfrom affordlib.show import save_figure, plot_table\n"
        "from pathlib import Path\nfigure, ax = plt.subplots()\nplot_table(ax)\n"
        "ax.set_title('50 % of $x_1$')\nax.plot([1, 2])\n"
        "print(save_figure(figure, Path('{}'), 'one'))"
    )
    drawn = []
    for name, own in (("own", {"MATPLOTLIBRC": str(tmp_path)}), ("plain", {})):
        environment = os.environ | {"MPLBACKEND": "agg"} | own
        path = printed(code.format(tmp_path / name), env=environment).strip()
        drawn.append(np.asarray(Image.open(path)))
    np.testing.assert_array_equal(*drawn)


@pytest.fixture
def push(world):
    world.place(Cuboid(0.07, 0.05, 0.05), (0.02, -0.01), 0.4)
    return world.execute_primitive(Push.towards(0.6))


@pytest.fixture
def explorer(trained, push):
    return conditioning_explorer(trained, push)


@pytest.fixture
def slider(world):
    world.place(Cuboid(0.07, 0.05, 0.05), (0.02, -0.01), 0.4)
    return phase_explorer(world, Push.towards(0.6), 0.8)


def state_of(explorer, *at):
    return int(np.ravel_multi_index(at, [len(values) for values in explorer.sliders.values()]))


@pytest.mark.slow
def test_what_is_observed_decides_what_is_predicted(explorer, trained, push):
    context = condition_on_primitives(trained, [push.primitive])
    t = torch.linspace(0, 1, 25)[None]
    with torch.no_grad():
        plain = trained.predict(trained.encode(torch.tensor(push.image)[None]), context, t)
    _, line, dots = explorer.panels["effect, x [cm], over phase"]
    alone = line.y[state_of(explorer, 4, 7, 4)]
    np.testing.assert_allclose(alone, 100 * plain.effect_mean[0, :, 0], atol=2e-3)
    np.testing.assert_array_equal(alone, line.y[state_of(explorer, 4, 2, 4)])  # w₁ = 1: no effect
    assert dots.y[state_of(explorer, 4, 7, 4)].max() < line.y.min()  # and no point of it
    assert np.abs(alone - line.y[state_of(explorer, 4, 7, 2)]).max() > 0.01
    late = line.y[state_of(explorer, 0, 10, 0)]
    np.testing.assert_allclose(line.y[state_of(explorer, 3, 10, 0)], late, atol=1e-4)
    assert late[-1] == pytest.approx(100 * push.effect[-1, 0], abs=3)


def test_a_stop_leaves_the_object_where_the_full_push_had_it(slider):
    _, _, rest, full = slider.panels["from above [cm]"]
    assert np.hypot(rest.x - full.x, rest.y - full.y).max() < 0.1
    moved, dots = slider.panels["object has moved [cm], over phase"]
    np.testing.assert_allclose(np.interp(dots.x, moved.x, moved.y), dots.y, atol=0.1)
    assert "has moved 0.0 cm" in slider.words[0]
    assert "At t = 0.80" in slider.words[slider.state]


@pytest.mark.parametrize("name", ["slider", "explorer"])
def test_a_page_gets_the_numbers_the_script_and_a_picture(name, request):
    explorer = request.getfixturevalue(name)
    html = explorer._repr_mimebundle_()["text/html"]
    assert len(html) < 450_000
    assert '<img alt="' in html
    data = json.loads(re.search(r"parentElement, (\{.*)\)</script>", html)[1])
    drawn = [len(panel["lines"]) for panel in data["panels"]]
    assert drawn == [*map(len, explorer.panels.values())]
    assert len(data["words"]) == np.prod([len(one["values"]) for one in data["sliders"]])


def test_values_out_of_range_are_named(trained, push, world):
    with pytest.raises(ValueError, match="effect_t must lie"):
        conditioning_explorer(trained, push, 1.2)
    with pytest.raises(ValueError, match="phase must lie"):
        phase_explorer(world, Push.towards(0.6), -1)
