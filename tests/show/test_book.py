"""How `make html` prepares the pages."""

import itertools
import json
import runpy

import pytest

from affordlib.results import repo_root


@pytest.fixture(scope="module")
def conf():
    return runpy.run_path(str(repo_root() / "notebooks" / "book_html" / "conf.py"))


def test_a_picture_is_described_by_its_caption_also_after_jupyterlab_has_saved_the_page(conf):
    picture = {"data": {"image/png": "…"}, "metadata": {"image/png": {"width": 900}}}
    cell = {"cell_type": "code", "source": ["plot()"], "metadata": {}, "outputs": [picture]}
    caption = "**Figure 1.2.** Turn $\\varphi_1$ of *aligned* pushes by `A*` ([why](06.ipynb))."
    conf["describe"](cell, caption)
    assert cell["metadata"]["mystnb"]["image"]["alt"] == "Turn φ1 of aligned pushes by A* (why)."
    conf["describe"](cell, "Text.")
    assert cell["metadata"]["mystnb"]["image"]["alt"]


def test_no_alternative_text_of_the_book_has_marks(conf):
    for path in (repo_root() / "notebooks").rglob("[0-9A]*.ipynb"):
        cells = json.loads(path.read_text())["cells"]
        for cell, below in itertools.pairwise(cells):
            if cell["cell_type"] == "code":
                conf["describe"](cell, "".join(below["source"]))
                alt = cell["metadata"]["mystnb"].get("image", {}).get("alt", "")
                assert not {"$", "\\", "`"} & set(alt), (path, alt)
                assert "*" not in alt.replace("A*", ""), (path, alt)
