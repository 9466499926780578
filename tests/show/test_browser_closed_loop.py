"""Notebook 07 in a real browser: all its cells, and a robot that is disturbed by hand."""

from urllib.parse import urlparse

import numpy as np
import pytest
import yaml

from affordlib.paths import repo_root
from tests.show.lab_pages import (
    WIDGET,
    Table,
    ask,
    button,
    goal_of,
    hosts,
    in_a_browser,
    opened,
    picture,
    saved_outputs,
    serve,
    wait_for_words,
)

pytestmark = in_a_browser

NAME = "07_closed_loop"


@pytest.fixture(scope="module")
def lab(tmp_path_factory):
    smoke = yaml.safe_load((repo_root() / "notebooks" / "profiles" / "smoke.yaml").read_text())
    with serve(tmp_path_factory.mktemp("lab"), NAME, **smoke[NAME]) as lab:
        yield lab


@pytest.fixture(scope="module")
def page(lab):
    with opened(lab) as page:
        yield page


def test_all_cells_have_run(page, lab):
    outputs = saved_outputs(page, lab)
    assert [o for o in outputs if o.output_type == "error"] == []
    assert sum("image/png" in o.get("data", ()) for o in outputs) >= 7
    assert all("image/png" in o["data"] for o in outputs if WIDGET in o.get("data", ()))
    assert (lab.out / f"{NAME}.json").is_file()


def test_disturbed_while_it_works_it_still_arrives(page, lab):
    table = Table(page)
    goal = goal_of(page)
    button(page, "Run").click()
    page.wait_for_function("() => document.querySelector('.trail')?.getAttribute('points')")
    first = table.points(".plan .prediction")
    button(page, "Shove it").click()
    button(page, "Move goal").click()
    wait_for_words(page, "from the goal, within")
    last = table.points(".plan .prediction")  # of the plan that it has come to in the end
    assert first.shape != last.shape or not np.allclose(first, last)
    np.testing.assert_allclose(last[-1], ask(page, "list(picker.goal.xy_m)"), atol=0.005)
    assert hosts(page) == {urlparse(lab.address).netloc}
    there = ask(page, "list(picker.goal.xy_m)")
    assert 0.039 < np.hypot(*np.subtract(there, goal)) < 0.081
    assert ask(page, "picker.outcome.distance_m") < 0.005
    np.testing.assert_allclose(table.points(".object").mean(axis=0), there, atol=0.006)
    np.testing.assert_allclose(table.goal(), there, atol=1e-4)
    picture(page, "8_disturbed_in_07")
