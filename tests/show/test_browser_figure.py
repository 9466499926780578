"""The figures whose points are dragged, in a real browser."""

import time

import nbformat
import pytest

from tests.show.lab_pages import ask, in_a_browser, opened, picture, serve

pytestmark = in_a_browser

CELLS = [
    "out_dir = ''",
    """from affordlib.models import load_checkpoint
from affordlib.primitives import Push
from affordlib.show import ConditioningExplorer, PhaseSlider
from affordlib.world import Cuboid, Tabletop

world = Tabletop()
world.place(Cuboid(0.07, 0.05, 0.05), (0.02, -0.01), 0.4)
seen = world.execute_primitive(Push.towards(0.6))
explorer = ConditioningExplorer(load_checkpoint("film_500")[0], seen)
explorer.observe_at((0.1, 0.9), 0.7, 0.5)
explorer""",
    """world.place(Cuboid(0.07, 0.05, 0.05), (0.02, -0.01), 0.4)
slider = PhaseSlider(world, Push.towards(0.6), phase=0.8)
slider""",
]


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    folder = tmp_path_factory.mktemp("lab")
    notebook = nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(c) for c in CELLS])
    notebook.cells[0].metadata["tags"] = ["parameters"]
    notebook.metadata["kernelspec"] = {"name": "python3", "display_name": "Python 3"}
    nbformat.write(notebook, folder / "dragged.ipynb")
    with (
        serve(folder, "dragged", source=folder / "dragged.ipynb") as lab,
        opened(lab, shows=".affordlib-drawing img >> nth=1") as page,
    ):
        yield page


def handle_of(page, widget, name):
    """A handle in the figure, in shares of its width and height, and the phase where it is."""
    k = ask(page, f"[name for _, name, *_ in {widget}._handles]").index(name)
    scene = ask(page, f"{widget}._drawing.scene")
    width, height = map(float, scene["box"].split()[2:])
    at = scene["handles"][k]
    y = (at["top"] + at["bottom"]) / 2 if at["y"] is None else at["y"]
    phase = (at["x"] - at["left"]) / (at["right"] - at["left"])
    return at["left"] / width, at["right"] / width, y / height, phase


def drag(page, widget, name, phase):
    """Take a handle of a figure by mouse to a phase; what is drawn before and after."""
    figure = page.locator(".affordlib-drawing img").nth(["explorer", "slider"].index(widget))
    figure.scroll_into_view_if_needed()
    before, box = figure.get_attribute("src"), figure.bounding_box()
    left, right, y, now = handle_of(page, widget, name)
    start, end = (
        (box["x"] + (left + at * (right - left)) * box["width"], box["y"] + y * box["height"])
        for at in (now, phase)
    )
    page.mouse.move(*start)
    page.mouse.down()
    page.mouse.move(*end, steps=6)
    picture(page, f"figure_{name.replace(' ', '_')}_held")
    page.mouse.up()
    return figure, before


def comes_true(condition, seconds=15):
    """Whether a condition holds before the time is over."""
    end = time.monotonic() + seconds
    while not condition() and time.monotonic() < end:
        time.sleep(0.05)
    return condition()


@pytest.mark.parametrize(
    ("name", "phase", "told"),
    [
        ("first action", 0.3, "explorer._action_t.value[0]"),
        ("second action", 0.6, "explorer._action_t.value[1]"),
        ("effect", 0.95, "explorer._effect_t.value"),
    ],
)
def test_observations_are_dragged_in_the_figure(page, name, phase, told):
    figure, before = drag(page, "explorer", name, phase)
    assert comes_true(lambda: ask(page, told) == pytest.approx(phase, abs=0.011))
    assert comes_true(lambda: figure.get_attribute("src") != before)

    assert comes_true(
        lambda: handle_of(page, "explorer", name)[3] == pytest.approx(phase, abs=0.011)
    )
    picture(page, f"figure_{name.replace(' ', '_')}")


def test_the_line_of_the_phase_slider_is_dragged(page):
    figure, before = drag(page, "slider", "phase", 0.65)
    assert comes_true(lambda: ask(page, "slider.phase") == pytest.approx(0.65, abs=0.011))
    assert comes_true(lambda: figure.get_attribute("src") != before)
    picture(page, "figure_phase")


def test_beside_the_handles_nothing_is_dragged(page):
    before = ask(page, "slider._drawing.wanted")
    box = page.locator(".affordlib-drawing img").nth(1).bounding_box()
    page.mouse.move(box["x"] + 5, box["y"] + 5)
    page.mouse.down()
    page.mouse.move(box["x"] + 200, box["y"] + 50, steps=4)
    page.mouse.up()
    assert ask(page, "slider._drawing.wanted") == before
