"""Every notebook: as committed, as a web page, and executed with the smoke profile's values."""

import ast
import itertools
import json
import os
import re
import runpy
import subprocess
import sys

import nbformat
import numpy as np
import papermill
import pytest
from IPython.core.inputtransformer2 import TransformerManager
from pages import PAGES as PATHS
from pages import WIDGET, cleaned, parameters_of_pages
from slides import FIGURES, figures

from affordlib.results import read_results, repo_root, results_table
from affordlib.show import GOAL, PREDICTION, TRUTH
from tests import book_check

ROOT = repo_root()
RESULTS = ROOT / "data" / "results"
# A machine-specific path: a slash at the start of a word, and a folder name common at the root.
ABSOLUTE = re.compile(
    r"(?<![\w.~/:-])/(?:home|root|tmp|work|usr|var|opt|mnt|media|Users|private)/\w|\b[A-Z]:\\\w"
)

READERS_DASK = {"REQUIRE_ENCRYPTION": "true", "DEFAULT_SCHEME": "tls"}  # no page may fail with it
each_notebook = pytest.mark.parametrize("name", list(PATHS))


def read(name):
    return nbformat.read(PATHS[name], as_version=4)


def default_parameters(name):
    found = papermill.inspect_notebook(str(PATHS[name])).items()
    return {parameter: ast.literal_eval(one["default"]) for parameter, one in found}


def parameters(profile, seed=0):
    return parameters_of_pages({"PROFILE": profile, "SEED": str(seed), "OUT": "", "ARGS": ""})


def code_of(notebook):
    return [cell for cell in notebook.cells if cell.cell_type == "code"]


@each_notebook
def test_every_picture_has_its_caption(name):
    cells, count = read(name).cells, 0
    for cell, below in itertools.pairwise(cells):
        shown = [output.get("data", {}) for output in cell.get("outputs", [])]
        drawn = ["<img" in data.get("text/html", "") for data in shown]  # an explorer or a scene
        if any(drawn) or any(kind.startswith("image/") for data in shown for kind in data):
            count += 1
            page = "N" if name == "nano" else name[:2].removeprefix("0")
            caption = rf"\*\*Figure {page}\.{count}\.\*\* \S.{{20,}}\.$"
            assert re.match(caption, below.source, re.M), f"below it stands {below.source!r}"
    assert sum(c.source.startswith("**Figure ") for c in cells) == count > 0


class WithoutNotes(ast.NodeTransformer):
    """Code without values that are only recorded in `parameters`."""

    def visit_Assign(self, node):
        target = (getattr(node, "targets", None) or [node.target])[0]
        noted = target.value if isinstance(target, ast.Subscript) else target
        return None if getattr(noted, "id", "") == "parameters" else node

    visit_AugAssign = visit_Assign


@each_notebook
def test_every_parameter_is_explained_and_used(name):
    """At least one cell does more than record it."""
    defaults = default_parameters(name)
    assert (defaults["seed"], defaults["out_dir"]) == (0, "runs/lab")
    for parameter in papermill.inspect_notebook(str(PATHS[name])).values():
        assert parameter["inferred_type_name"] != "None", f"{parameter['name']} has no type"
        assert parameter["help"].strip(), f"{parameter['name']} is not explained"
    cells = code_of(read(name))
    at = next(i for i, c in enumerate(cells) if "parameters" in c.metadata.get("tags", []))
    code = [TransformerManager().transform_cell(cell.source) for cell in cells[at + 1 :]]
    nodes = [node for c in code for node in ast.walk(WithoutNotes().visit(ast.parse(c)))]
    names = {n.id for n in nodes if isinstance(n, ast.Name) and isinstance(n.ctx, ast.Load)}
    assert not defaults.keys() - names


@each_notebook
def test_executed_in_order_without_errors_small_clean_and_colours_have_one_meaning(name):
    cells = code_of(read(name))
    for colour in (GOAL, PREDICTION, TRUTH):
        assert not [c for c in cells if colour.lower() in c.source.lower()], "use its name"
    assert [cell.execution_count for cell in cells] == list(range(1, len(cells) + 1))
    outputs = [output for cell in cells for output in cell.outputs]
    assert outputs, "run `make notebooks`"
    assert [o for o in outputs if o.output_type == "error" or o.get("name") == "stderr"] == []
    text = PATHS[name].read_text(encoding="utf-8")
    assert len(text.encode()) < 1_500_000
    assert text == cleaned(read(name)), "metadata is not clean; run `make notebooks`"


READS_STORED = 'read_results(\\"data/results/'  # in JSON
STORED = [name for name, path in PATHS.items() if READS_STORED in path.read_text("utf-8")]


def last_value(source, space):
    """Execute a cell and return its last line's value; None if it needs undefined names."""
    tree = ast.parse(source)
    last = tree.body.pop() if isinstance(tree.body[-1], ast.Expr) else None
    try:
        exec(compile(tree, "cell", "exec"), space)
        return eval(compile(ast.Expression(last.value), "cell", "eval"), space) if last else None
    except NameError:
        return None


@pytest.mark.parametrize("name", STORED)
def test_stored_results_are_shown_as_they_are_now(name):
    space = {"np": np, "read_results": read_results, "results_table": results_table}
    space |= default_parameters(name)
    compared = 0
    for cell in code_of(read(name)):
        if not ("results_table(" in cell.source or "read_results(" in cell.source):
            continue
        assert "import " not in cell.source, "with the imports, cells that train would run here too"
        value = last_value(cell.source, space)
        if value is not None:
            shown = [o.data["text/html"] for o in cell.outputs if "text/html" in o.get("data", {})]
            assert shown == [value._repr_html_()], f"run `make notebooks`: stale\n{cell.source}"
            compared += 1
    assert compared


def test_of_a_widget_its_picture_is_kept():
    """JupyterLab shows the picture without a kernel; without it, a widget would show an error."""
    shown = {WIDGET: {"model_id": "1"}, "text/plain": "a widget"}
    both = [nbformat.v4.new_output("display_data", shown | {"image/png": "iVBORw0="})]
    alone = [nbformat.v4.new_output("display_data", shown)]
    cells = [nbformat.v4.new_code_cell("a", outputs=outputs) for outputs in (both, alone)]
    kept = nbformat.reads(cleaned(nbformat.v4.new_notebook(cells=cells)), 4).cells
    assert set(kept[0].outputs[0].data) == {"image/png", "text/plain"}
    assert WIDGET in kept[1].outputs[0].data


@each_notebook
def test_everything_shown_shows_on_the_web_and_nothing_depends_on_the_machine(name):
    """Web pages made from a notebook drop GIFs, and print the object's name instead."""
    known = {"image/png", "image/svg+xml", "image/jpeg", "text/html", "text/markdown"}
    for number, cell in enumerate(read(name).cells, 1):
        words = [cell.source]
        for output in cell.get("outputs", []):
            data = output.get("data", {})
            alone = data.get("text/plain", "")
            assert data.keys() & known or "<" not in alone, f"cell {number} of {name}: {alone}"
            words += [output.get("text", "")]
            words += [str(value) for kind, value in data.items() if kind.startswith("text/")]
        found = ABSOLUTE.search("\n".join(words))
        assert not found, f"cell {number} of {name} holds the absolute path {found.group()!r}"
        if cell.cell_type == "code":
            bad = re.search(r"\bsys\.path\b|\bos\.chdir\b|^\s*[!%]\s*(pip|cd)\b", cell.source, re.M)
            assert not bad, f"cell {number} of {name} has {bad.group()!r}"
            assert "filterwarnings" not in cell.source


def test_the_book_keeps_to_its_style_and_values_of_profiles_to_their_types():
    for profile in ("smoke", "reader", "full"):
        assert parameters(profile).keys() == PATHS.keys()
    assert [picture[:4] for picture, _ in figures().values()] == [b"\x89PNG"] * len(FIGURES)
    assert book_check.check()[1] == []


def prepare(path, parameters, folder):
    """Write a copy with these parameters into a folder, ready to run."""
    copy, python = folder / path.name, {"kernel_name": "python3", "language": "python"}
    papermill.execute_notebook(path, copy, parameters, prepare_only=True, **python)
    return copy


def append_solutions(copy):
    """Append the solutions of a notebook's exercises, if any, and require them to pass."""
    solutions = ROOT / "notebooks" / "solutions" / f"{copy.stem}.py"
    if solutions.is_file():
        notebook = nbformat.read(copy, as_version=4)
        all_pass = "for verdict in VERDICTS:\n    assert verdict.passed, str(verdict)\n"
        all_pass += "    assert '; expected' in str(verdict)"
        for code in (solutions.read_text(), all_pass):
            notebook.cells.append(nbformat.v4.new_code_cell(code))
        nbformat.write(notebook, copy)


def run_with_nbval(copy):
    """Run a prepared notebook in a separate pytest: asserts, and outputs marked for checking."""
    command = [sys.executable, "-m", "pytest", "--nbval-lax", "--nbval-current-env", copy]
    command += ["--nbval-cell-timeout=600", "-p", "no:cacheprovider", "--rootdir", copy.parent]
    environment = {k: v for k, v in os.environ.items() if k not in ("PYTEST_ADDOPTS", "MPLBACKEND")}
    environment |= {f"DASK_DISTRIBUTED__COMM__{k}": v for k, v in READERS_DASK.items()}
    return subprocess.run([*map(str, command)], env=environment, capture_output=True, text=True)


@pytest.fixture(scope="module")
def smoke(tmp_path_factory):
    """The folder of the runs of one worker: notebooks may read files of earlier ones."""
    return tmp_path_factory.mktemp("smoke"), parameters("smoke", seed=1)


@pytest.mark.slow
@pytest.mark.timeout(1200)
@each_notebook
def test_run(name, smoke):
    folder, chosen = smoke
    given = chosen[name] | {"out_dir": str(folder)}
    copy = prepare(PATHS[name], given, folder)
    append_solutions(copy)
    done = run_with_nbval(copy)
    assert done.returncode == 0, done.stdout + done.stderr
    assert f"{len(code_of(nbformat.read(copy, as_version=4)))} passed" in done.stdout
    document = read_results(folder / f"{name}.json")
    assert document["notebook"] == name
    # A run writes what it has measured itself, not the tables that the page only shows.
    others = [path for path in RESULTS.glob("*.json") if path.stem != name]
    committed = [read_results(path)["tables"].values() for path in others]
    assert not [t for t, rows in document["tables"].items() if any(rows in of for of in committed)]
    given = default_parameters(name) | given
    assert {k: v for k, v in document["parameters"].items() if k in given}.items() <= given.items()


@pytest.mark.slow
@pytest.mark.parametrize("page", ["README.md", "notebooks/cheat_sheet.md"])
def test_the_block_of_a_text_runs(page):
    """Also without the compiler of PyTorch, which takes a second or two to import."""
    (block,) = re.findall(r"```python\n(.*?)```", (ROOT / page).read_text("utf-8"), re.DOTALL)
    command = [sys.executable, "-c", f"{block}\nimport sys; print('torch._dynamo' in sys.modules)"]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT)
    assert float(done.stdout.removesuffix(" mm from the goal\nFalse\n")) < 5, done.stderr


@pytest.mark.slow
def test_the_same_route_fails_on_a_broken_notebook(tmp_path):
    given = {"seed": 1, "out_dir": str(tmp_path)}
    copy = prepare(ROOT / "tests" / "broken.ipynb", given, tmp_path)
    done = run_with_nbval(copy)
    assert done.returncode == 1, done.stdout + done.stderr
    # A wrong output and a false assert fail; the parameters, given and injected, pass.
    assert "2 failed, 2 passed" in done.stdout
    assert "assert total == 3" in done.stdout
    assert "mismatch 'stdout'" in done.stdout


def test_a_picture_is_described_by_its_caption_without_its_marks():
    """Also after JupyterLab has saved the page."""
    describe = runpy.run_path(f"{ROOT}/notebooks/book_html/conf.py")["describe"]
    picture = {"data": {"image/png": "…"}, "metadata": {"image/png": {"width": 900}}}
    cell = {"cell_type": "code", "source": ["plot()"], "metadata": {}, "outputs": [picture]}
    caption = "**Figure 1.2.** Turn $\\varphi_1$ of *aligned* pushes by `A*` ([why](06.ipynb))."
    describe(cell, caption)
    assert cell["metadata"]["mystnb"]["image"]["alt"] == "Turn φ1 of aligned pushes by A* (why)."
    describe(cell, "Text.")
    assert cell["metadata"]["mystnb"]["image"]["alt"]
    for path in (ROOT / "notebooks").rglob("[0-9A]*.ipynb"):
        for cell, below in itertools.pairwise(json.loads(path.read_text())["cells"]):
            if cell["cell_type"] == "code":
                describe(cell, "".join(below["source"]))
                alt = cell["metadata"]["mystnb"].get("image", {}).get("alt", "")
                assert not {"$", "\\", "`"} & set(alt), (path, alt)
                assert "*" not in alt.replace("A*", ""), (path, alt)
