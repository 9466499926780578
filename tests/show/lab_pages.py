"""JupyterLab on this machine in headless Chromium, and what the tests do on its pages.

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
from contextlib import contextmanager
from types import SimpleNamespace
from urllib.error import URLError
from urllib.parse import urlparse

import nbformat
import numpy as np
import papermill
import pytest

from affordlib.paths import repo_root
from affordlib.workbook import WIDGET

CHROMIUM = shutil.which("chromium")
FLAGS = ["--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage"]
PICTURES = repo_root() / "runs" / "browser"

in_a_browser = [
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


@contextmanager
def serve(folder, name, more_cells=(), **parameters):
    """A JupyterLab with settings, workspaces and run-time files of its own, and one notebook.

    more_cells: code that is added after the goal picker; what is far off is not in the page.
    """
    book = folder / "book"
    book.mkdir()
    file, out = book / f"{name}.ipynb", folder / "out"
    notebook = papermill.execute_notebook(
        repo_root() / "notebooks" / f"{name}.ipynb",
        None,
        {"out_dir": str(out), **parameters},
        prepare_only=True,
        kernel_name="python3",
        language="python",
    )
    after = [k for k, cell in enumerate(notebook.cells) if "GoalPicker(" in cell.source][-1] + 1
    notebook.cells[after:after] = [nbformat.v4.new_code_cell(cell) for cell in more_cells]
    nbformat.write(notebook, file)
    port, token = free_port(), secrets.token_hex(16)
    own = {f"JUPYTER_{part}_DIR": str(folder / part) for part in ("CONFIG", "DATA", "RUNTIME")}
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
            url = f"{address}/doc/tree/{name}.ipynb?token={token}"
            yield SimpleNamespace(address=address, url=url, notebook=file, out=out)
        finally:
            server.terminate()
            server.wait(timeout=30)


def wait_for_server(url, server, log):
    def answers():
        assert server.poll() is None, log.read_text()
        try:
            urllib.request.urlopen(url, timeout=5).close()
        except (URLError, OSError):
            return False
        return True

    wait_until(answers, 60, f"JupyterLab did not answer, see {log}")


@contextmanager
def opened(lab):
    """The notebook, all its cells run, and `requests`: every address that was asked for."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
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
        page.locator(".affordlib-table .prediction").first.wait_for(timeout=90_000)
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
        corners = self.svg.locator(selector).evaluate_all(
            """all => all.flatMap((shape) => {
                const screen = shape.ownerSVGElement.getScreenCTM().inverse();
                const inPicture = screen.multiply(shape.getScreenCTM());
                return [...shape.points].map((corner) => {
                    const {x, y} = corner.matrixTransform(inPicture);
                    return [x, y];
                });
            })"""
        )
        return np.array(corners, dtype=float).reshape(-1, 2) * [1e-3, -1e-3]

    def goal(self):
        return self.points(".goal").mean(axis=0)

    def wait_for_answer(self):
        self.page.wait_for_function(
            "svg => Number(svg.dataset.answered) >= Number(svg.dataset.asked ?? 0)"
            " && svg.dataset.draft === 'false' && svg.dataset.planning === 'false'",
            arg=self.svg.element_handle(),
        )


def picture(page, name):
    PICTURES.mkdir(parents=True, exist_ok=True)
    page.screenshot(path=PICTURES / f"{name}.png")


def button(page, name):
    return page.locator(".affordlib-picker button", has_text=name)


def choose(page, option):
    page.locator(".affordlib-picker select", has_text=option).select_option(option)


def words(page):
    return page.locator(".affordlib-picker [role=status]").inner_text()


def wait_until(condition, seconds=20, otherwise="waited in vain"):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, otherwise
        time.sleep(0.05)


def wait_for_words(page, text, seconds=40):
    wait_until(lambda: text in words(page), seconds, f"waited for {text!r}")


def assert_same_goal(page, table, x_m, y_m, within_m=0.0011):
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


def hosts(page):
    """Where the page has asked anything."""
    asked = (url for url in page.requests if not url.startswith(("data:", "blob:")))
    return {urlparse(url).netloc for url in asked}


def saved_outputs(page, lab):
    """The notebook is saved as a reader saves it: all outputs that are then in its file."""
    page.evaluate("window.jupyterapp.commands.execute('docmanager:save')")
    outputs = []

    def saved():
        cells = nbformat.read(lab.notebook, as_version=4).cells
        outputs[:] = [output for cell in cells for output in cell.get("outputs", [])]
        return any(WIDGET in output.get("data", ()) for output in outputs)

    wait_until(saved, otherwise="the notebook was not saved with its widget")
    return outputs
