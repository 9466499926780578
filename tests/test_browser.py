"""Notebook 00 in a real browser: JupyterLab on this machine, headless Chromium, mouse and keys.

Pictures and measured times are left in `runs/browser/`.
"""

import json
import os
import secrets
import shutil
import socket
import subprocess
import sys
import time
import urllib.request
from types import SimpleNamespace
from urllib.error import URLError
from urllib.parse import urlparse

import nbformat
import numpy as np
import papermill
import pytest

from affordlib.paths import repo_root

CHROMIUM = shutil.which("chromium")
PICTURES = repo_root() / "runs" / "browser"

pytestmark = [
    pytest.mark.slow,
    pytest.mark.browser,
    pytest.mark.timeout(300),
    pytest.mark.skipif(
        CHROMIUM is None,
        reason="no Chromium is installed (on Debian: apt-get install chromium)",
    ),
]


def free_port():
    with socket.socket() as sock:
        sock.bind(("127.0.0.1", 0))
        return sock.getsockname()[1]


@pytest.fixture(scope="module")
def lab(tmp_path_factory):
    """A JupyterLab with settings, workspaces and run-time files of its own, and notebook 00."""
    folder = tmp_path_factory.mktemp("lab")
    book = folder / "book"
    book.mkdir()
    papermill.execute_notebook(
        repo_root() / "notebooks" / "00_start_here.ipynb",
        book / "00_start_here.ipynb",
        {"out_dir": str(folder / "out")},
        prepare_only=True,
        kernel_name="python3",
        language="python",
    )
    settings = folder / "settings" / "@jupyterlab" / "apputils-extension"
    settings.mkdir(parents=True)
    (settings / "notification.jupyterlab-settings").write_text(
        json.dumps({"fetchNews": "false", "checkForUpdates": False})
    )
    port, token = free_port(), secrets.token_hex(16)
    own = {
        f"JUPYTER_{name}_DIR": str(folder / name.lower()) for name in ("CONFIG", "DATA", "RUNTIME")
    }
    options = [
        "--no-browser",
        "--allow-root",
        "--ip=127.0.0.1",
        f"--port={port}",
        "--ServerApp.port_retries=0",
        f"--ServerApp.root_dir={book}",
        f"--IdentityProvider.token={token}",
        "--LabApp.expose_app_in_browser=True",
        f"--LabApp.user_settings_dir={folder / 'settings'}",
        f"--LabApp.workspaces_dir={folder / 'workspaces'}",
    ]
    with (folder / "lab.log").open("w") as log:
        server = subprocess.Popen(
            [sys.executable, "-m", "jupyterlab", *options],
            env=os.environ | own | {"JUPYTER_PREFER_ENV_PATH": "1"},
            stdout=log,
            stderr=subprocess.STDOUT,
        )
        address = f"http://127.0.0.1:{port}"
        try:
            wait_for_server(f"{address}/api?token={token}", server, folder / "lab.log")
            yield SimpleNamespace(
                address=address,
                url=f"{address}/doc/tree/00_start_here.ipynb?token={token}",
                notebook=book / "00_start_here.ipynb",
                out=folder / "out",
            )
        finally:
            server.terminate()
            server.wait(timeout=30)


def wait_for_server(url, server, log):
    end = time.monotonic() + 60
    while time.monotonic() < end:
        assert server.poll() is None, log.read_text()
        try:
            urllib.request.urlopen(url, timeout=5).close()
            return
        except (URLError, OSError):
            time.sleep(0.2)
    raise AssertionError(f"JupyterLab did not answer:\n{log.read_text()}")


@pytest.fixture(scope="module")
def page(lab):
    """The notebook, all its cells run, and `requests`: every address that was asked for."""
    from playwright.sync_api import sync_playwright

    flags = ["--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage"]
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=flags)
        page = browser.new_page(viewport={"width": 1280, "height": 1000})
        page.set_default_timeout(25_000)
        page.requests = []
        page.context.on("request", lambda request: page.requests.append(request.url))
        page.on("websocket", lambda socket: page.requests.append(socket.url))
        page.goto(lab.url)
        page.wait_for_function("() => window.jupyterapp")  # a little after the page has loaded
        page.evaluate("async () => { await window.jupyterapp.restored; }")
        page.wait_for_function(
            "() => window.jupyterapp.shell.currentWidget?.sessionContext?.session?.kernel"
            "?.status === 'idle'"
        )
        page.evaluate("window.jupyterapp.commands.execute('notebook:run-all-cells')")
        page.locator(".affordlib-table svg .plan .prediction").first.wait_for()
        ask(page, "1")  # answered after all cells
        yield page
        browser.close()


def ask(page, expression):
    """What the notebook's kernel says an expression is, as JSON."""
    reply = page.evaluate(
        """async (code) => {
            const {kernel} = window.jupyterapp.shell.currentWidget.sessionContext.session;
            const future = kernel.requestExecute({
                code: 'import json', store_history: false,
                user_expressions: {answer: `json.dumps(${code})`},
            });
            return (await future.done).content.user_expressions.answer;
        }""",
        expression,
    )
    assert reply["status"] == "ok", reply
    return json.loads(reply["data"]["text/plain"].strip("'").replace("\\\\", "\\"))


def goal_of(page):
    return tuple(ask(page, "picker.plan.goal.xy_m"))


class Table:
    """The table in the page: where its points are on the screen, and what is drawn on it."""

    def __init__(self, page):
        self.page, self.svg = page, page.locator(".affordlib-table svg")
        self.svg.scroll_into_view_if_needed()
        box = self.svg.bounding_box()
        assert box["width"] > 300
        assert box["height"] == pytest.approx(box["width"], rel=0.01)

    def at(self, x_m, y_m):
        box = self.svg.bounding_box()
        mm = float(self.svg.get_attribute("viewBox").split()[2])
        pixels = (box["width"] - 2) / mm  # a border of one pixel
        return (
            box["x"] + box["width"] / 2 + 1000 * x_m * pixels,
            box["y"] + box["height"] / 2 - 1000 * y_m * pixels,
        )

    def points(self, selector):
        """(n, 2) [m]: the corners of all that is drawn with a class."""
        lists = self.svg.locator(selector).evaluate_all(
            "all => all.map((e) => e.getAttribute('points'))"
        )
        numbers = [pair.split(",") for text in lists for pair in (text or "").split()]
        return np.array(numbers, dtype=float).reshape(-1, 2) * [1e-3, -1e-3]

    def goal(self):
        return self.points(".goal").mean(axis=0)

    def wait_for_answer(self):
        self.page.wait_for_function(
            "svg => Number(svg.dataset.answered) >= Number(svg.dataset.asked ?? 0)",
            arg=self.svg.element_handle(),
        )


@pytest.fixture
def table(page):
    return Table(page)


def picture(page, name):
    PICTURES.mkdir(parents=True, exist_ok=True)
    page.screenshot(path=PICTURES / f"{name}.png")


def button(page, name):
    return page.locator(".affordlib-picker button", has_text=name)


def choose(page, option):
    page.locator(".affordlib-picker select", has_text=option).select_option(option)


def words(page):
    return page.locator(".affordlib-picker [role=status]").inner_text()


def wait_for_words(page, text, seconds=40):
    end = time.monotonic() + seconds
    while text not in words(page):
        assert time.monotonic() < end, f"waited for {text!r}, but it says {words(page)!r}"
        time.sleep(0.05)


def same_goal(page, table, x_m, y_m, within_m=0.0011):
    """What Python plans for, what the sliders say and what is drawn agree."""
    table.wait_for_answer()
    asked = goal_of(page)
    assert asked == pytest.approx((x_m, y_m), abs=within_m)
    np.testing.assert_allclose(table.goal(), asked, atol=1e-4)
    shown = page.locator(".affordlib-picker .widget-readout").all_inner_texts()[:2]
    assert [float(text.replace("−", "-")) for text in shown] == pytest.approx(
        [100 * v for v in asked]
    )
    drawn = table.points(".plan .prediction")
    planned = np.vstack(ask(page, "[s.predicted_path_xy_m.tolist() for s in picker.plan.steps]"))
    np.testing.assert_allclose(drawn, planned, atol=2e-4)


def test_it_opens_with_a_plan(page, table):
    assert goal_of(page) == (0.15, 0.10)
    same_goal(page, table, 0.15, 0.10)
    assert "Plan: push to" in words(page)
    picture(page, "1_open")


def test_click(page, table):
    page.mouse.click(*table.at(0.08, -0.11))
    same_goal(page, table, 0.08, -0.11)


def test_drag(page, table):
    page.mouse.move(*table.at(0.08, -0.11))
    page.mouse.down()
    for share in np.linspace(0, 1, 12):
        page.mouse.move(*table.at(0.08 - 0.2 * share, -0.11 + 0.2 * share))
    page.mouse.up()
    same_goal(page, table, -0.12, 0.09)
    page.mouse.move(*table.at(0.2, 0.2))  # let go: the star stays
    same_goal(page, table, -0.12, 0.09)
    picture(page, "2_dragged")


def test_arrow_keys(page, table):
    before = goal_of(page)
    table.svg.focus()
    for key in ("ArrowRight", "ArrowRight", "ArrowUp", "Shift+ArrowLeft", "Shift+ArrowDown"):
        page.keyboard.press(key)
    same_goal(page, table, before[0] + 0.019, before[1] + 0.009, within_m=1e-6)
    assert page.evaluate("document.activeElement.closest('.affordlib-table') !== null")


def test_sliders_by_keyboard(page, table):
    x, y = goal_of(page)
    handles = page.locator(".affordlib-picker .noUi-handle")
    handles.nth(0).focus()
    page.keyboard.press("ArrowRight")
    expect_goal(page, lambda goal: goal[0] > x)
    handles.nth(1).focus()
    page.keyboard.press("ArrowLeft")
    expect_goal(page, lambda goal: goal[1] < y)
    same_goal(page, table, *goal_of(page))


def expect_goal(page, condition, seconds=20):
    end = time.monotonic() + seconds
    while not condition(goal_of(page)):
        assert time.monotonic() < end, f"the goal stays {goal_of(page)}"
        time.sleep(0.05)


def test_planner(page, table):
    choose(page, "gradient")
    end = time.monotonic() + 20
    while ask(page, "picker.plan.planner") != "gradient_direction":
        assert time.monotonic() < end
    same_goal(page, table, *goal_of(page))
    choose(page, "A*")
    while ask(page, "picker.plan.planner") != "astar":
        assert time.monotonic() < end
    table.wait_for_answer()


def test_run(page, table):
    page.mouse.click(*table.at(0.12, 0.12))
    same_goal(page, table, 0.12, 0.12)
    before = table.points(".object").mean(axis=0)
    button(page, "Run").click()
    wait_for_words(page, "from the goal, ")
    outcome = ask(page, "[*picker.outcome.end_pose, picker.outcome.distance_m]")
    assert f"{1000 * outcome[3]:.1f} mm" in words(page)
    assert np.hypot(*(table.points(".object").mean(axis=0) - before)) > 0.05
    np.testing.assert_allclose(table.points(".object").mean(axis=0), outcome[:2], atol=1e-3)
    np.testing.assert_allclose(table.points(".truth")[-1], outcome[:2], atol=1e-3)
    picture(page, "3_run")


def test_run_and_stop_by_keyboard(page, table):
    button(page, "Start over").click()
    page.mouse.click(*table.at(0.2, -0.2))
    same_goal(page, table, 0.2, -0.2)
    assert ask(page, "len(picker.plan.steps)") > 1
    table.svg.focus()
    page.keyboard.press("Enter")
    page.wait_for_function("() => document.querySelector('.trail')?.getAttribute('points')")
    picture(page, "4_running")
    page.keyboard.press("Escape")
    wait_for_words(page, "Stopped after 1 action:")
    assert ask(page, "picker.outcome.distance_m") > 0.05


def test_disturb(page, table):
    button(page, "Start over").click()
    wait_for_words(page, "Plan:")
    goal, pose = goal_of(page), ask(page, "playground.object_pose()")
    drawn = table.points(".object").mean(axis=0)
    button(page, "Shove it").click()
    end = time.monotonic() + 20
    while (shoved := ask(page, "playground.object_pose()")) == pose:
        assert time.monotonic() < end
    assert 0.019 < np.hypot(*np.subtract(shoved[:2], pose[:2])) < 0.041
    moved = table.points(".object").mean(axis=0) - drawn
    np.testing.assert_allclose(moved, np.subtract(shoved[:2], pose[:2]), atol=1e-3)
    button(page, "Move goal").click()
    expect_goal(page, lambda new: new != goal)
    same_goal(page, table, *goal_of(page))
    picture(page, "5_disturbed")


def test_a_closed_loop_follows_a_goal_that_moves(page, table):
    button(page, "Start over").click()
    page.mouse.click(*table.at(0.18, 0.0))
    same_goal(page, table, 0.18, 0.0)
    choose(page, "closed loop")
    button(page, "Run").click()
    page.wait_for_function("() => document.querySelector('.trail')?.getAttribute('points')")
    page.mouse.click(*table.at(0.1, 0.16))
    wait_for_words(page, "from the goal, within")
    assert ask(page, "picker.outcome.distance_m") < 0.01
    goal = ask(page, "picker._goal.xy_m")
    assert goal == pytest.approx((0.1, 0.16), abs=0.0011)
    np.testing.assert_allclose(table.points(".object").mean(axis=0), goal, atol=0.011)
    picture(page, "6_closed_loop")
    choose(page, "open loop")


def test_save_and_load(page, table):
    page.mouse.click(*table.at(-0.1, 0.05))
    same_goal(page, table, -0.1, 0.05)
    button(page, "Save").click()
    wait_for_words(page, "Saved the plan")
    goal = goal_of(page)
    page.mouse.click(*table.at(0.0, 0.15))
    same_goal(page, table, 0.0, 0.15)
    button(page, "Load").click()
    wait_for_words(page, "Loaded.")
    same_goal(page, table, *goal)


def test_the_plan_follows_the_hand(page, table):
    """From the event to the redrawn plan, seen from inside the page."""
    choose(page, "A*")
    times_ms = page.evaluate(
        """async () => {
            const svg = document.querySelector('.affordlib-table svg');
            svg.focus();
            const times = [];
            for (let k = 0; k < 40; k++) {
                const began = performance.now();
                const key = ['ArrowLeft', 'ArrowUp', 'ArrowRight', 'ArrowDown'][(k >> 2) % 4];
                svg.dispatchEvent(new KeyboardEvent('keydown', {key, bubbles: true}));
                const number = Number(svg.dataset.asked);
                await new Promise((done) => {
                    const look = () => Number(svg.dataset.answered) >= number
                        ? done() : requestAnimationFrame(look);
                    look();
                });
                times.push(performance.now() - began);
            }
            return times;
        }"""
    )
    measured = {
        "n": len(times_ms),
        "median_ms": float(np.median(times_ms)),
        "p95_ms": float(np.quantile(times_ms, 0.95)),
        "plan_ms": 1000 * ask(page, "picker.plan.plan_s"),
    }
    (PICTURES / "times.json").write_text(json.dumps(measured, indent=1) + "\n")
    assert measured["median_ms"] < 1000, measured


def test_a_saved_notebook_keeps_a_picture(page, lab):
    page.evaluate("window.jupyterapp.commands.execute('docmanager:save')")
    end = time.monotonic() + 20
    while True:
        cells = nbformat.read(lab.notebook, as_version=4).cells
        outputs = [o for cell in cells for o in cell.get("outputs", []) if "data" in o]
        widget = [o for o in outputs if "application/vnd.jupyter.widget-view+json" in o["data"]]
        if widget:
            break
        assert time.monotonic() < end, "the notebook was not saved with its widget"
    assert all("image/png" in output["data"] for output in widget)
    assert [o for cell in cells for o in cell.get("outputs", []) if o.output_type == "error"] == []
    assert (lab.out / "00_start_here.json").is_file()


def test_no_request_leaves_the_machine(page, lab):
    hosts = {
        urlparse(url).netloc for url in page.requests if not url.startswith(("data:", "blob:"))
    }
    assert hosts == {urlparse(lab.address).netloc}
    assert any("ws" in urlparse(url).scheme for url in page.requests)
