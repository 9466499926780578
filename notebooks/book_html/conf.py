"""How notebooks, README and RESULTS become web pages: `make html` (Sphinx with MyST-NB).

Equations become MathML, which browsers draw without a script or a network.
"""

import html
import json
import re
import shutil
from pathlib import Path

import k3d
from docutils import nodes
from latex2mathml.converter import convert
from myst_parser.slugs import github_slugify

project = html_title = "Planning with partial actions"
root_doc = "README"
extensions = ["myst_nb"]
include_patterns = ["*.md", "data/*.md", "notebooks/*.md", "notebooks/*.ipynb"]
include_patterns += ["notebooks/appendix/*.ipynb"]
exclude_patterns = [".*", "runs", "build", "**/.*"]

PICKER = """<iframe class="picker" src="../_static/try_it.html" title="Pick a goal"></iframe>
<script>
addEventListener("message", ({data, source}) => {
  const frame = document.querySelector("iframe.picker");
  if (source === frame.contentWindow) frame.style.height = `${Number(data)}px`;
});
</script>"""
"""What stands for the goal picker of the first page: one that plans without a kernel."""

nb_execution_mode = "off"
nb_ipywidgets_js = {}
myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 4

html_theme = "furo"
html_theme_options = {"dark_css_variables": {"figure-filter": "brightness(0.9)"}}
html_math_renderer = "mathml"
html_static_path = html_css_files = ["style.css"]
html_show_search_summary = False  # would be fetched, which browsers refuse from disk
html_copy_source = html_show_copyright = html_use_index = False


def plain(text: str) -> str:
    """Markdown as a text to be read aloud: equations in letters, no marks, links by their names."""

    def letters(equation: re.Match) -> str:
        return html.unescape(re.sub(r"<.*?>", "", convert(equation[1])))

    text = re.sub(r"\$(.+?)\$", letters, text)
    text = re.sub(r"\[(.*?)\]\(.*?\)", r"\1", text).replace("`", "")
    return re.sub(r"(?<!\w)\*+(\S.*?)\*+", r"\1", text)  # not the star of A*


def describe(cell: dict, below: str) -> None:
    """Give a picture its alternative text, the caption in the cell below; name a folded cell."""
    about = cell["metadata"]["mystnb"] = {}
    if "GoalPicker.demo(" in "".join(cell["source"]):
        png = next((o["data"]["image/png"] for o in cell["outputs"] if "data" in o), "")
        still = f'<noscript><img alt="Its picture" src="data:image/png;base64,{png}"></noscript>'
        live = {"output_type": "display_data", "data": {"text/html": still + PICKER}}
        cell["outputs"] = [live | {"metadata": {}}]
    caption = re.match(r"\*\*Figure .*?\*\* (.*)", below)
    kinds = {"write_results(": "results", "import": "imports"}
    named = [name for word, name in kinds.items() if word in "".join(cell["source"])]
    for output in cell["outputs"]:
        if {"image/png", "image/svg+xml"} & output.get("data", {}).keys():
            alt = plain(caption[1]) if caption else "A picture that the cell above draws"
            about["image"], named = {"alt": alt}, ["figure"]
    about["code_prompt_show"] = about["code_prompt_hide"] = ": ".join(["Code", *named[:1]])


def prepare(app, docname: str, source: list[str]) -> None:
    """Write anchors as GitHub does; describe the cells; add the contents to the first page."""
    link, text = r"(\]\([^)\s]*#)([^)]+)\)", source[0]
    text = re.sub(link, lambda m: f"{m[1]}{github_slugify(m[2])})", text)
    if app.env.doc2path(docname).suffix == ".ipynb":
        notebook = json.loads(text)
        cells = notebook["cells"]
        for cell, below in zip(cells, [*cells[1:], {"source": ""}], strict=True):
            if cell["cell_type"] == "code":
                describe(cell, "".join(below["source"]))
        text = json.dumps(notebook)
    elif docname == root_doc:
        text += Path(__file__).with_name("contents.md").read_text()
    source[0] = text


def write_math(self, node) -> None:
    """Write an equation; its number, which MathML does not know, stands behind it."""
    body = re.sub(r"\\tag\{(.*?)\}", r"\\qquad\\text{(\1)}", node.astext())
    if isinstance(node, nodes.math_block):
        self.body.append(f'<div class="equation">{convert(body, display="block")}</div>')
    else:
        self.body.append(convert(body))
    raise nodes.SkipNode


def add_robot(app, page: str, template: str, context: dict, doctree) -> None:
    """Give a page that shows the robot in 3-D the script that draws it."""
    if "CreateK3DAndLoadBinarySnapshot" in context.get("body", ""):
        app.add_js_file(None, body="globalThis.define = (n, d, make) => (globalThis.k3d = make());")
        app.add_js_file("robot.js", priority=600)


def copy_scripts(app) -> None:
    """Copy the picker, and the robot's script from k3d by a name that it does not look for."""
    script = Path(k3d.__file__).parent / "static" / "standalone.js"
    folder = Path(app.outdir, "_static")
    folder.mkdir(parents=True, exist_ok=True)
    shutil.copy(script, folder / "robot.js")
    shutil.copy(Path(app.srcdir, "figures", "try_it.html"), folder)


def setup(app) -> None:
    """Register the above; when all is written, the first page is copied to index.html."""
    app.connect("builder-inited", copy_scripts)
    app.connect("html-page-context", add_robot)
    app.connect("source-read", prepare)
    app.add_html_math_renderer("mathml", (write_math, None), (write_math, None))
    first, index = (Path(app.outdir, f"{name}.html") for name in (root_doc, "index"))
    app.connect("build-finished", lambda app, error: error or shutil.copy(first, index))
