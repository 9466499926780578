"""Notebook 00, an explorer and the web pages in headless Chromium; pictures: `runs/browser/`."""

import json
import os
import re
import secrets
import socket
import subprocess
import sys
from contextlib import contextmanager
from types import SimpleNamespace
from urllib.parse import unquote, urlparse

import nbformat
import numpy as np
import papermill
import pytest
from bs4 import BeautifulSoup
from pages import WIDGET

from affordlib.results import repo_root
from tests.waiting import wait_until

PICTURES = repo_root() / "runs" / "browser"

pytestmark = [pytest.mark.slow, pytest.mark.browser, pytest.mark.timeout(300)]
page = pytest.fixture(lambda lab, browser: opened(lab, browser), scope="module")
table = pytest.fixture(lambda page: Table(page))


@contextmanager
def serve(folder, name, more_cells=(), app="jupyterlab"):
    """Start a Jupyter with separate settings, workspaces and run-time files, and one notebook.

    more_cells: code added after the goal picker; the page omits cells that are far out of view.
    """
    book = folder / "book"
    book.mkdir()
    file, out = book / f"{name}.ipynb", folder / "out"
    source, given = repo_root() / "notebooks" / f"{name}.ipynb", {"out_dir": str(out)}
    python = {"kernel_name": "python3", "language": "python"}
    notebook = papermill.execute_notebook(source, None, given, prepare_only=True, **python)
    after = [k for k, cell in enumerate(notebook.cells) if "GoalPicker." in cell.source][-1] + 1
    notebook.cells[after:after] = [nbformat.v4.new_code_cell(cell) for cell in more_cells]
    nbformat.write(notebook, file)
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port, token = free.getsockname()[1], secrets.token_hex(16)
    own = {f"JUPYTER_{part}_DIR": str(folder / part) for part in ("CONFIG", "DATA", "RUNTIME")}
    traits = {"jupyterlab": "LabApp", "notebook": "JupyterNotebookApp"}[app]
    options = ["--no-browser", "--allow-root", "--ip=127.0.0.1", f"--port={port}"]
    options += ["--ServerApp.port_retries=0", f"--ServerApp.root_dir={book}"]
    options += [f"--IdentityProvider.token={token}", f"--{traits}.expose_app_in_browser=True"]
    options += [f"--{traits}.user_settings_dir={folder / 'settings'}"]
    options += [f"--{traits}.workspaces_dir={folder / 'workspaces'}"]
    log, environment = folder / "lab.log", os.environ | own | {"JUPYTER_PREFER_ENV_PATH": "1"}
    with log.open("w") as said:
        command = [sys.executable, "-m", app, *options]
        server = subprocess.Popen(command, env=environment, stdout=said, stderr=said)
        address = f"http://127.0.0.1:{port}"
        try:
            wait_until(lambda: f":{port}/" in log.read_text(), 60, server, f"see {log}")
            path = "doc/tree" if app == "jupyterlab" else "notebooks"
            url = f"{address}/{path}/{name}.ipynb?token={token}"
            yield SimpleNamespace(address=address, url=url, notebook=file, out=out)
        finally:
            server.terminate()
            server.wait(timeout=60)


def ask(page, expression):
    """Value of an expression in the notebook's kernel, as JSON."""
    reply = page.evaluate(
        """async (code) => {
            const {kernel} = window.jupyterapp.shell.currentWidget.sessionContext.session;
            const future = kernel.requestExecute({
                code: 'import json', store_history: false,
                user_expressions: {answer: `json.dumps(${code})`},
            });
            // A timer, too: a promise that only the reply can end may be collected as garbage.
            const late = new Promise((done) => setTimeout(done, 60000));
            return (await Promise.race([future.done, late]))?.content.user_expressions.answer;
        }""",
        expression,
    )
    assert (reply or {}).get("status") == "ok", reply
    return json.loads(reply["data"]["text/plain"].strip("'").replace("\\\\", "\\"))


def goal_of(page):
    return tuple(ask(page, "picker.plan.goal.xy_m"))


def view_of(svg):
    """Middle (2,) of the table [pixels], what is there (2,) [m], and pixels per metre.

    It waits until the view stands: drawn twice, it is the same.
    """
    svg.evaluate(
        """async (svg) => {
            const frame = () => new Promise((done) => requestAnimationFrame(() => {
                const {x, y} = svg.getBoundingClientRect();
                setTimeout(() => done([svg.dataset.view, x, y].join()), 50);
            }));
            for (let last = await frame(), now; (now = await frame()) !== last; last = now);
        }"""
    )
    box = svg.bounding_box()
    x, y, half = map(float, svg.get_attribute("data-view").split())
    middle = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    return np.array(middle), np.array((x, y)), box["height"] / (2 * half)


def screen_at(svg, x_m, y_m):
    middle, there, scale = view_of(svg)
    return tuple(middle + scale * ((x_m, y_m) - there) * (1, -1))


class Table:
    """The table in the page: screen positions of its points, and what is drawn on it."""

    def __init__(self, page):
        self.page, self.svg = page, page.locator(".affordlib-table svg")
        self.svg.scroll_into_view_if_needed()
        box = self.svg.bounding_box()
        assert box["width"] > 280
        assert box["height"] == pytest.approx(box["width"], rel=0.01)

    def at(self, x_m, y_m):
        return screen_at(self.svg, x_m, y_m)

    def points(self, selector):
        """Corners (n, 2) [m] of everything drawn with a class."""
        corners = self.svg.locator(selector).evaluate_all(
            """all => all.flatMap((shape) => [...shape.points].map((corner) => {
                const {x, y} = corner.matrixTransform(shape.getScreenCTM());
                return [x, y];
            }))"""
        )
        middle, there, scale = view_of(self.svg)
        return there + (np.array(corners, dtype=float).reshape(-1, 2) - middle) * (1, -1) / scale

    def goal(self):
        return self.points(".goal").mean(axis=0)

    def wait_for_answer(self):
        self.page.wait_for_function(
            "svg => Number(svg.dataset.answered) >= Number(svg.dataset.query ?? 0)"
            " && svg.dataset.draft === 'false' && svg.dataset.planning === 'false'",
            arg=self.svg.element_handle(),
        )

    def start_over(self):
        button(self.page, "Start over").click()
        back = "max(map(abs, map(float.__sub__, picker._plan_pose, picker._first_pose))) < 1e-6"
        back += " and picker.goal.xy_m == picker._first_goal.xy_m"
        idle = "not (picker._is_outdated() or picker._running)"
        wait_until(lambda: ask(self.page, f"{back} and {idle}"))
        self.wait_for_answer()


def picture(page, name):
    PICTURES.mkdir(parents=True, exist_ok=True)
    page.screenshot(path=PICTURES / f"{name}.png")


def button(page, name):
    return page.locator(".affordlib-picker button", has_text=name)


def words(page):
    return page.locator(".affordlib-picker [role=status]").inner_text()


def wait_for_words(page, text, seconds=40):
    wait_until(lambda: text in words(page), seconds, otherwise=f"waited for {text!r}")


def assert_same_goal(page, table, x_m, y_m, within_m=0.0011):
    """Check that Python's goal and the drawing agree."""
    table.wait_for_answer()
    wanted = goal_of(page)
    assert wanted == pytest.approx((x_m, y_m), abs=within_m)
    wait_until(lambda: np.abs(table.goal() - wanted).max() < 3e-4)

    def drawn_is_planned():  # a better plan may follow the first
        paths = ask(page, "[s.predicted_path_xy_m.tolist() for s in picker.plan.steps]")
        drawn, planned = table.points(".prediction"), np.vstack(paths)
        return drawn.shape == planned.shape and np.abs(drawn - planned).max() < 5e-4

    wait_until(drawn_is_planned, otherwise="the drawn path is not that of the plan")


EXPLORER = """from affordlib.primitives import Push
from affordlib.show import phase_explorer

with Tabletop() as other:
    other.place(Cuboid(0.07, 0.05, 0.05), (0.02, -0.01), 0.4)
    explorer = phase_explorer(other, Push.towards(0.6))
explorer"""


@pytest.fixture(scope="module")
def lab(tmp_path_factory, browser):  # which may be missing
    folder = tmp_path_factory.mktemp("lab")
    with serve(folder, "00_start_here", [EXPLORER]) as lab:
        yield lab


def opened(lab, browser, click_m=None):
    """The notebook with all cells run, and `requests`: every requested address.

    click_m: a place on the table that is clicked while the later cells still run.
    """
    page = browser.new_page(viewport={"width": 1280, "height": 1000})
    page.set_default_timeout(25_000)
    page.requests = []
    page.context.on("request", lambda request: page.requests.append(request.url))
    page.on("websocket", lambda socket: page.requests.append(socket.url))
    load(page, lab.url)
    page.wait_for_function(
        "() => window.jupyterapp.shell.currentWidget?.sessionContext?.session?.kernel"
        "?.status === 'idle'"
    )
    page.evaluate("window.jupyterapp.commands.execute('notebook:run-all-cells')")
    page.locator(".affordlib-table .prediction").first.wait_for(timeout=90_000)
    if click_m:
        page.mouse.click(*Table(page).at(*click_m))
    ask(page, "setattr(picker, 'pace_s', 0.01)")  # answered after all cells
    return page


def load(page, url):
    page.goto(url)
    page.wait_for_function("() => window.jupyterapp")  # a little after the page has loaded
    page.evaluate("async () => { await window.jupyterapp.restored; }")


def test_the_first_click_after_scrolling_lands_where_the_mouse_is(page, table):
    table.svg.evaluate(
        """svg => {
            document.activeElement.blur();
            svg.scrollIntoView({block: "start"});
            let outer = svg.parentElement;
            const scrolls = (e) => e.scrollHeight > e.clientHeight + 50;
            while (outer && !scrolls(outer)) outer = outer.parentElement;
            outer.scrollTop += svg.getBoundingClientRect().height / 2;
        }"""
    )
    page.wait_for_timeout(300)
    top = table.svg.bounding_box()["y"]
    assert top < 60  # the upper half is out of sight
    page.mouse.click(*table.at(0.1, -0.1))
    assert_same_goal(page, table, 0.1, -0.1)
    assert abs(table.svg.bounding_box()["y"] - top) < 2


def test_sliders_by_keyboard(page, table):
    handles = page.locator(".affordlib-picker .noUi-handle")
    named = handles.evaluate_all("all => all.map((e) => e.getAttribute('aria-label'))")
    assert named == ["turn [°]", "lift [cm]", "time"]

    def press(slider, key, presses):
        for _ in range(presses):
            handles.nth(slider).press(key)

    press(0, "ArrowRight", 6)
    press(1, "ArrowRight", 10)
    wanted = [pytest.approx(np.radians(30)), pytest.approx(0.05)]  # no key press is lost
    wait_until(lambda: ask(page, "[picker.goal.turn_rad, picker.goal.height_m]") == wanted)
    wait_for_words(page, "then grasp to")
    table.wait_for_answer()

    def drawn_at_its_goal():
        predicted, place = table.points(".predicted"), table.points(".place")
        return predicted.shape == place.shape and np.abs(predicted - place).max() < 0.021

    wait_until(drawn_at_its_goal)
    picture(page, "7_turn_and_lift")
    posed = "(picker.controls.turn, picker.controls.height)"
    ask(page, f"[*(setattr(s, 'value', 0) for s in {posed}), picker.pick(0.1, 0)]")


def test_a_run_is_drawn_from_above_and_in_3d_while_it_is_simulated(page, table):
    table.start_over()
    page.mouse.click(*table.at(0.12, 0.12))
    assert_same_goal(page, table, 0.12, 0.12)
    before = table.points(".object").mean(axis=0)
    ask(page, "setattr(picker, 'pace_s', 0.05)")
    page.evaluate(
        """([name, ...arm]) => {
            window.all = () => globalThis.affordlib[name].getWorld().K3DObjects.children;
            window.seen = [];
            setInterval(() => {
                const words = document.querySelector(".affordlib-picker [role=status]").innerText;
                const parts = all().filter((body) => arm.includes(body.K3DIdentifier));
                seen.push([words, ...parts.map((body) => body.position.toArray())]);
            }, 20);
        }""",
        ask(page, "[picker.scene.name, *(one.id for one in picker.scene.bodies[:-1])]"),
    )
    button(page, "Run").click()
    wait_for_words(page, "from the goal, ")
    ask(page, "setattr(picker, 'pace_s', 0.01)")
    outcome = ask(page, "[*picker.outcome.end_pose, picker.outcome.distance_m]")
    assert f"{1000 * outcome[3]:.1f} mm" in words(page)
    wait_until(lambda: abs(table.points(".object").mean(axis=0) - outcome[:2]).max() < 1e-3)
    assert np.hypot(*(table.points(".object").mean(axis=0) - before)) > 0.05
    np.testing.assert_allclose(table.points(".truth")[-1], outcome[:2], atol=1e-3)
    seen = [row[1:] for row in page.evaluate("seen") if row[0].startswith("Push 1 of")]
    assert (np.ptp(seen, axis=0).max(axis=1) > 0.02).sum() > 5  # parts of the arm
    assert len(np.unique(seen, axis=0)) > 5
    number, *at = ask(page, "[picker.scene.bodies[-1].id, *picker.world.object_state()[:3]]")
    shown = f"all().find((body) => body.K3DIdentifier === {number})?.position.toArray()"
    wait_until(lambda: np.allclose(page.evaluate(shown) or 0, at, atol=1e-3), 20)
    ratio = "Object.values(affordlib)[0].getWorld().renderer.getPixelRatio()"
    assert page.evaluate(ratio) < 1  # without a GPU
    picture(page, "4_run_in_3d")


def test_a_closed_loop_follows_a_goal_that_moves(page, table):
    table.start_over()
    ask(page, "picker.pick(0.18, 0.0)")
    assert_same_goal(page, table, 0.18, 0.0)
    modes = page.locator(".affordlib-picker select", has_text="closed loop").first
    modes.select_option("closed loop")
    button(page, "Run").click()
    page.locator(".affordlib-table .hand").wait_for(state="attached")
    page.mouse.click(*table.at(0.1, 0.16))
    button(page, "Shove it").click()
    wait_for_words(page, "from the goal, within")
    assert ask(page, "picker.outcome.distance_m") < 0.01
    goal = ask(page, "picker.goal.xy_m")
    assert goal == pytest.approx((0.1, 0.16), abs=0.0011)
    assert ask(page, "picker.scene._marks[-1].model_matrix[:2, 3].tolist()") == pytest.approx(goal)
    at = ask(page, "picker.world.object_pose()[:2]")  # also if the shove came after the last action
    wait_until(lambda: np.allclose(table.points(".object").mean(axis=0), at, atol=0.001), 20)
    picture(page, "6_closed_loop")
    modes.select_option("open loop")


@pytest.mark.parametrize("width", [1280, 853, 600, 400])  # 853: 1280 at a zoom of 150 %
def test_it_fits_its_window(page, table, width):
    """Table and controls are side by side from 800 px on, the words are below the table."""
    page.set_viewport_size({"width": width, "height": 1000})
    parts = (table.svg, page.locator(".affordlib-picker [role=status]"), button(page, "Run"))

    def arranged():
        top, said, run = (part.bounding_box() for part in parts)
        beside = run["x"] > top["x"] + top["width"] and run["y"] < top["y"] + top["height"]
        below = 0 < said["y"] - top["y"] - top["height"] < 220  # behind the obstacles' buttons
        within = top["x"] - 1 < said["x"] < said["x"] + said["width"] < top["x"] + top["width"] + 1
        return below and within and beside == (width >= 800)

    wait_until(arranged)
    cut = """all => all.filter((part) => part.getClientRects().length).filter((part) => {
        const {left, right} = part.closest('.jp-OutputArea-output').getBoundingClientRect();
        const own = part.getBoundingClientRect();
        const hides = getComputedStyle(part).overflowX !== 'visible' && part.clientWidth;
        return own.left < left - 1 || own.right > right + 1
            || hides && part.scrollWidth > part.clientWidth + 1;
    }).map((part) => part.outerHTML)"""
    for widget in ("picker", "explorer"):
        assert page.locator(f".affordlib-{widget} :not(svg *, option)").evaluate_all(cut) == []
    picture(page, f"8_width_{width}")
    page.set_viewport_size({"width": 1280, "height": 1000})


def test_everything_can_be_pressed_without_a_mouse(page, table):
    table.start_over()
    table.svg.focus()
    focused = "document.activeElement"
    names = []
    while "Shove it" not in names:
        page.keyboard.press("Tab")
        names.append(page.evaluate(f"{focused}.innerText || {focused}.className"))
        assert len(names) < 40, names
        assert page.evaluate(f"{focused}.closest('.affordlib-picker') !== null"), names
    assert any(name.strip() == "Run" for name in names), names
    pose, goal = ask(page, "picker.world.object_pose()"), goal_of(page)
    page.keyboard.press("Enter")
    wait_until(lambda: ask(page, "picker.world.object_pose()") != pose)
    page.keyboard.press("Tab")
    assert page.evaluate(f"{focused}.innerText").strip() == "Move goal"
    page.keyboard.press("Space")
    wait_until(lambda: goal_of(page) != goal)


def test_the_browser_plans_while_the_hand_drags(page, table):
    table.start_over()
    before = ask(page, "list(picker.plan.goal.xy_m)")
    page.mouse.move(*table.at(*table.goal()))
    page.mouse.down()
    for share in np.linspace(0, 1, 6):
        page.mouse.move(*table.at(0.05 + 0.02 * share, 0.09))
        drawn = table.points(".prediction")
        assert np.hypot(*(drawn[-1] - table.goal())) < 0.003
        assert ask(page, "list(picker.plan.goal.xy_m)") == before  # not yet wanted for
    page.mouse.up()
    assert_same_goal(page, table, 0.07, 0.09)


def test_what_a_planner_has_tried_is_drawn(page, table):
    planner, tried = "picker.planners['continuous']", [[[0, 0], [0.1, 0.05]], [[0.05, -0.05]]]
    seen = f"lambda problem, plan={planner}: picker._searched.extend({tried}) or plan(problem)"
    ask(page, f"picker.planners.update(continuous={seen})")
    page.mouse.click(*table.at(0.1, 0.1))
    table.wait_for_answer()
    page.wait_for_timeout(2000)  # in which it grows
    drawn = re.findall(r"[\d.-]+", page.locator(".tried").get_attribute("d").removesuffix("h0"))
    corner = [table.svg.bounding_box()[name] for name in "xy"]
    wanted = [np.subtract(table.at(*xy), corner) for line in tried for xy in line]
    np.testing.assert_allclose(np.reshape([*map(float, drawn)], (-1, 2)), wanted, atol=2)


def test_a_slider_of_an_explorer_changes_its_figure_without_the_kernel(page):
    explorer = page.locator(".affordlib-explorer")
    explorer.scroll_into_view_if_needed()
    slider, words = explorer.locator("input"), explorer.locator("[role=status]")
    wait_until(lambda: "At t = 0.80" in words.inner_text())
    assert explorer.locator("img").count() == 0  # that of pages without scripts
    before = explorer.locator("circle").get_attribute("cx")
    slider.press("ArrowLeft")
    wait_until(lambda: "At t = 0.75" in words.inner_text())
    assert float(explorer.locator("circle").get_attribute("cx")) < float(before)
    picture(page, "explorer")


def test_a_saved_notebook_keeps_a_picture(page, lab):
    page.evaluate("window.jupyterapp.commands.execute('docmanager:save')")
    outputs = []

    def saved():
        cells = nbformat.read(lab.notebook, as_version=4).cells
        outputs[:] = [output for cell in cells for output in cell.get("outputs", [])]
        return any(WIDGET in output.get("data", ()) for output in outputs)

    wait_until(saved, otherwise="the notebook was not saved with its widget")
    widget = [o for o in outputs if WIDGET in o.get("data", ())]
    drawn = ["<img" in output["data"].get("text/html", "") for output in widget]  # a scene
    assert all("image/png" in o["data"] or is_ for o, is_ in zip(widget, drawn, strict=True))
    assert [o for o in outputs if o.output_type == "error"] == []
    assert (lab.out / "00_start_here.json").is_file()


def test_no_request_leaves_the_machine(page, lab):
    wanted = [url for url in page.requests if not url.startswith(("data:", "blob:"))]
    assert {urlparse(url).netloc for url in wanted} == {urlparse(lab.address).netloc}
    assert any("ws" in urlparse(url).scheme for url in page.requests)
    assert page.locator("text=Would you like to get notified").count() == 0


def test_a_second_window_without_webgl_shows_the_same_and_plays_from_above(page, table, lab):
    """It is loaded while the kernel runs, so this is a reload, too."""
    table.start_over()
    page.evaluate("window.jupyterapp.commands.execute('docmanager:save')")
    other = page.context.browser.new_page(viewport={"width": 1280, "height": 1000})
    none = "{apply: (get, el, kind) => /webgl/.test(kind[0]) ? null : get.apply(el, kind)}"
    context = "HTMLCanvasElement.prototype.getContext"
    other.add_init_script(f"{context} = new Proxy({context}, {none})")
    load(other, lab.url)
    other.locator(".affordlib-table .prediction").first.wait_for(timeout=40_000)
    second = Table(other)
    other.mouse.click(*second.at(0.07, 0.03))
    for key in ("ArrowRight", "ArrowUp", "ArrowRight", "ArrowUp"):
        other.keyboard.press(f"Shift+{key}")  # nor does the slower window bring earlier goals back
    wait_until(lambda: goal_of(page) == (0.072, 0.032))
    assert_same_goal(other, second, 0.072, 0.032)
    button(other, "Run").click()
    other.locator(".affordlib-table .hand").wait_for(state="attached")
    wait_for_words(other, "from the goal, ")
    end = ask(page, "picker.outcome.end_pose[:2]")
    for one in (table, second):
        wait_until(lambda one=one: np.allclose(one.points(".object").mean(axis=0), end, atol=1e-3))
    picture(other, "without_webgl")
    other.close()


def test_a_goal_out_of_reach_is_hollow_and_says_how_far(page, table):
    table.start_over()
    ask(page, "picker.pick(0.3, 0.25)")
    hollow = table.svg.locator(".short-by")
    wait_until(lambda: goal_of(page) == (0.3, 0.25) and hollow.count() == 1)
    short_cm = ask(page, "100 * picker.plan.predicted_distance_m")
    assert f"{short_cm:.0f} cm short" in hollow.text_content()
    style = "svg => getComputedStyle(svg.querySelector('.goal.missed'))"
    assert table.svg.evaluate(f"{style}.fill") != table.svg.evaluate(f"{style}.stroke")
    picture(page, "out_of_reach")
    table.start_over()


def test_after_a_restart_of_the_kernel_one_sentence_says_what_to_do(page):
    page.evaluate("window.jupyterapp.shell.currentWidget.sessionContext.session.kernel.restart()")
    said = "e => getComputedStyle(e, '::before').content"
    picker = page.locator(".affordlib-picker")
    wait_until(lambda: "run the cells above again" in picker.evaluate(said), 40)
    assert button(page, "Run").evaluate(said) == "none"
    picture(page, "9_restarted")


def test_notebook_7_draws_the_picker_which_answers(tmp_path, browser):
    pytest.importorskip("notebook", reason="Notebook 7 is not installed")
    with serve(tmp_path, "00_start_here", app="notebook") as served:
        page = opened(served, browser, click_m=(0.1, -0.1))
        assert_same_goal(page, Table(page), 0.1, -0.1)


@pytest.fixture(scope="module")
def web(tmp_path_factory, browser):
    """The folder of the web pages, the text of each by path, and the paths in reading order."""
    made = tmp_path_factory.mktemp("web")
    options = ["-q", "-W", "--keep-going", "-c", "notebooks/book_html", "-d", made / "doctrees"]
    command = [sys.executable, "-m", "sphinx", *options, ".", made / "html"]
    subprocess.run(command, cwd=repo_root(), check=True)
    folder, first = made / "html", made / "html" / "README.html"
    files = sorted(folder.rglob("*.html"))
    pages = {path: BeautifulSoup(path.read_text(), "html.parser") for path in files}
    names = [link["href"] for link in pages[first].select(".sidebar-tree a.internal")]
    return folder, pages, [first, *(folder / name for name in names)]


def test_every_link_of_the_web_pages_leads_somewhere(web):
    folder, pages, order = web
    written = {f"{path.stem}.html" for path in (repo_root() / "notebooks").rglob("[0-9A]*.ipynb")}
    assert written <= {path.name for path in order} <= {path.name for path in pages}
    named = {path: {tag["id"] for tag in page.select("[id]")} for path, page in pages.items()}
    for path, page in pages.items():
        for tag in page.select("[href], [src]"):
            link = tag.get("href") or tag["src"]
            url = urlparse(link)
            if url.scheme in ("http", "https"):
                assert tag.name == "a", f"{path} loads {link}"
            if url.scheme in ("http", "https", "data"):
                continue
            file = (path.parent / unquote(url.path)).resolve() if url.path else path
            assert file.is_file(), f"{path}: {link}"
            assert file.is_relative_to(folder), f"{path}: {link}"
            assert not url.fragment or unquote(url.fragment) in named[file], f"{path}: {link}"
        assert all(image.get("alt") for image in page.select("img")), path
    assert sum(file.stat().st_size for file in folder.rglob("*") if file.is_file()) < 20e6


def test_the_web_pages_are_read_on_a_phone_without_a_network(web, browser):
    """Equations are drawn, nothing is wider than the window, and nothing is requested outside."""
    order, page = web[2], browser.new_page(viewport={"width": 400, "height": 800})
    requests, complaints, scrolled = [], [], 0
    page.on("request", lambda request: requests.append(request.url))
    page.on("console", lambda message: complaints.append(message.text))
    page.on("pageerror", lambda error: complaints.append(str(error)))
    for path, before, after in zip(order, [None, *order], [*order[1:], None], strict=False):
        page.goto(path.as_uri())
        assert page.evaluate("document.documentElement.scrollWidth") <= 400, path
        for way, neighbour in (("prev", before), ("next", after)):
            links = page.locator(f".related-pages .{way}-page").evaluate_all("a => a.map(String)")
            assert links == ([neighbour.as_uri()] if neighbour else []), path
        equations = page.locator("math:not(.katex-mathml math)")  # those are of k3d's hidden axes
        drawn = equations.evaluate_all("every => every.map(m => m.clientHeight)")
        assert min(drawn, default=9) > 4, path
        text = page.locator("article").evaluate(
            """article => {
                const copy = article.cloneNode(true);
                copy.querySelectorAll("pre, code, math, script, style").forEach((e) => e.remove());
                return copy.textContent;
            }"""
        )
        assert not {"$", "\\"} & set(text), path
        scrolled += page.locator("pre").evaluate_all(
            """all => all.filter((e) => e.scrollWidth > e.clientWidth
                && getComputedStyle(e).overflowX === "auto").length"""
        )
        assert page.locator("img").evaluate_all("all => all.every((e) => e.naturalWidth)"), path
    assert scrolled > 50
    assert all(url.startswith(("file:", "data:", "blob:")) for url in requests)
    assert not [text for text in complaints if "K3D" not in text and "GL Driver" not in text]


def test_the_first_web_page_plans_without_a_kernel(web, browser):
    page = browser.new_page(viewport={"width": 1280, "height": 900})
    page.goto((web[0] / "notebooks" / "00_start_here.html").as_uri())
    inside, table = page.frames[1], page.frame_locator("iframe.picker").locator("svg[data-view]")
    page.mouse.click(*screen_at(table, 0.0, 0.08))
    wait_until(lambda: "The goal is at x = 0.0, y = 8.0 cm" in table.get_attribute("aria-label"))
    assert "Predicted to end 0.0 mm" in inside.locator(".words").inner_text()
    wait_until(lambda: inside.evaluate("document.documentElement.scrollHeight <= innerHeight"))
    picture(page, "web_picker")


def test_the_web_pages_are_found_by_a_word_and_darken(web, browser):
    folder = web[0]
    page = browser.new_page(viewport={"width": 1280, "height": 900})
    page.goto((folder / "index.html").as_uri())
    page.locator("input.sidebar-search").fill("Garnelo")
    page.keyboard.press("Enter")
    found = page.locator("#search-results li a")
    found.first.wait_for()
    found.first.click()
    assert "Garnelo" in page.locator("article").inner_text()
    page.goto((folder / "notebooks" / "06_planning.html").as_uri())

    def shades():
        seen = "e => getComputedStyle(e)"
        back = page.locator("body").evaluate(f"({seen})(document.body).backgroundColor")
        return back, page.locator(".dataframe td").first.evaluate(f"e => ({seen})(e).color")

    bright = shades()
    page.emulate_media(color_scheme="dark")
    assert [sum(map(int, re.findall(r"\d+", shade))) > 380 for shade in bright] == [True, False]
    assert [sum(map(int, re.findall(r"\d+", shade))) > 380 for shade in shades()] == [False, True]
