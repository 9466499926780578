"""The figures whose points are dragged, in a real browser."""

import time

import nbformat
import pytest

from tests.lab_pages import ask, in_a_browser, opened, picture, serve

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
explorer = ConditioningExplorer(load_checkpoint("push_film")[0], seen)
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
        opened(lab, shows=".affordlib-figure >> nth=1") as page,
    ):
        yield page


def drag(page, widget, name, phase):
    """Take a handle of a figure by mouse to a phase; what is drawn before and after."""
    figure = page.locator(".affordlib-figure img").nth(["explorer", "slider"].index(widget))
    figure.scroll_into_view_if_needed()
    before, box = figure.get_attribute("src"), figure.bounding_box()
    handles = ask(page, f"{widget}._image.handles")
    handle = next(h for h in handles if h["name"] == name)
    y = handle["y"] or (handle["top"] + handle["bottom"]) / 2
    x = handle["left"] + phase * (handle["right"] - handle["left"])
    place = [(box["x"] + u * box["width"], box["y"] + y * box["height"]) for u in (handle["x"], x)]
    page.mouse.move(*place[0])
    page.mouse.down()
    page.mouse.move(*place[1], steps=6)
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

    def shares():  # in the figure of x as in that of y
        handles = [h for h in ask(page, "explorer._image.handles") if h["name"] == name]
        return [(h["x"] - h["left"]) / (h["right"] - h["left"]) for h in handles]

    assert comes_true(lambda: shares() == pytest.approx([phase, phase], abs=0.011))
    picture(page, f"figure_{name.replace(' ', '_')}")


def test_the_line_of_the_phase_slider_is_dragged(page):
    figure, before = drag(page, "slider", "phase", 0.65)
    assert comes_true(lambda: ask(page, "slider.phase") == pytest.approx(0.65, abs=0.011))
    assert comes_true(lambda: figure.get_attribute("src") != before)
    picture(page, "figure_phase")


def test_beside_the_handles_nothing_is_dragged(page):
    before = ask(page, "slider._image.dragged")
    box = page.locator(".affordlib-figure img").nth(1).bounding_box()
    page.mouse.move(box["x"] + 5, box["y"] + 5)
    page.mouse.down()
    page.mouse.move(box["x"] + 200, box["y"] + 50, steps=4)
    page.mouse.up()
    assert ask(page, "slider._image.dragged") == before
