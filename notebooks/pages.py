"""The pages of the book: their paths, their parameters, and the form in which they are committed.

    python notebooks/pages.py

lists for make what has to be made. Options are variables of the environment, as in the Makefile.
A page's parameters are its own defaults, overridden by `profiles/<PROFILE>.yaml`, then by ARGS,
then by SEED and the folder of the run.
"""

import ast
import copy
import difflib
import json
import os
import re
import sys
from collections.abc import Iterable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml
from beartype.door import is_bearable

if TYPE_CHECKING:
    import nbformat

ROOT = Path(__file__).resolve().parents[1]
PAGES = {path.stem: path for path in ROOT.glob("notebooks/nano.ipynb")}
PAGES |= {path.stem: path for path in sorted(ROOT.glob("notebooks/[0-9][0-9]_*.ipynb"))}
PAGES |= {path.stem: path for path in sorted(ROOT.glob("notebooks/appendix/A[0-9]_*.ipynb"))}
WIDGET = "application/vnd.jupyter.widget-view+json"
SHOWN = {"image/png", "image/svg+xml", "text/html"}
ADDED = {"injected-parameters", "papermill-error-cell-tag"}
"""Tags of the cells that papermill adds."""

TYPES = {"int": int, "float": float, "str": str, "list": list, "list[str]": list[str]}


def choose(kind: str, given: str, known: Iterable[str]) -> str:
    """Return the known name for a name or the number of a page."""
    for name in known:
        if given in (name, name.partition("_")[0]):
            return name
    near = difflib.get_close_matches(given, known, n=3, cutoff=0.5) or known
    raise ValueError(f"{kind} {given!r:.60} is unknown; did you mean {' or '.join(near)}?")


def types_of_parameters(path: Path) -> dict[str, str]:
    """Return the types of a page's parameters: the annotations in its cell tagged `parameters`."""
    cells = json.loads(path.read_text("utf-8"))["cells"]
    (cell,) = (c for c in cells if "parameters" in c["metadata"].get("tags", []))
    lines = ast.parse("".join(cell["source"])).body
    return {line.target.id: ast.unparse(line.annotation) for line in lines}


def run_folder(options: Mapping[str, str] = os.environ) -> str:
    """Return the folder of the run, relative to the repository."""
    if options.get("IN_PLACE"):
        return "runs/lab"
    profile, seed = options["PROFILE"], options["SEED"]
    name = options["OUT"] or profile + (f"-seed{seed}" if seed != "0" else "")
    if not re.fullmatch(r"\w[\w.-]*", name) or name in ("lab", "html"):
        raise ValueError(f"OUT must be a plain name, and neither lab nor html, got {name!r:.60}")
    return f"runs/{name}"


def parameters_of_pages(options: Mapping[str, str] = os.environ) -> dict[str, dict[str, Any]]:
    """Return, for each page, the parameters that replace its defaults."""
    if options.get("IN_PLACE"):
        return {page: {} for page in PAGES}
    if not re.fullmatch(r"\d{1,9}", options["SEED"]):
        raise ValueError(f"SEED must be a whole number, got {options['SEED']!r:.60}")
    profiles = {path.stem: path for path in sorted(ROOT.glob("notebooks/profiles/*.yaml"))}
    profile = choose("PROFILE", options["PROFILE"], profiles)
    given = []
    for page, values in yaml.safe_load(profiles[profile].read_text("utf-8")).items():
        given += [(f"{profile}.yaml", page, name, value) for name, value in values.items()]
    for setting in options["ARGS"].split():
        match = re.fullmatch(r"(\w+)\.(\w+)=(.*)", setting)
        if not match:
            raise ValueError(f"ARGS: {setting!r:.60} must look like 06_planning.n_goals=20")
        given.append(("ARGS", *match.groups()))
    common = {"seed": int(options["SEED"]), "out_dir": run_folder(options)}
    chosen: dict[str, dict[str, Any]] = {page: {} for page in PAGES}
    for source, page, name, value in given:
        page = choose(f"{source}: page", page, PAGES)
        types = types_of_parameters(PAGES[page])
        name = choose(f"{source}: parameter of {page}", name, [*types.keys() - common])
        wanted = types[name]
        if source == "ARGS" and wanted != "str":
            with suppress(yaml.YAMLError, ValueError, RecursionError):  # stays text, is refused
                value = yaml.safe_load(value)
        value = float(value) if wanted == "float" and type(value) is int else value
        if isinstance(value, bool) or not is_bearable(value, TYPES[wanted]):
            raise ValueError(f"{source}: {page}.{name} must be {wanted}, got {value!r:.60}")
        chosen[page][name] = value
    return {page: own | common for page, own in chosen.items()}


def own_cells(notebook: "nbformat.NotebookNode") -> list["nbformat.NotebookNode"]:
    """Return the cells of an executed notebook without those that papermill added."""
    return [c for c in notebook.cells if not ADDED & {*c.metadata.get("tags", [])}]


def cleaned(notebook: "nbformat.NotebookNode") -> str:
    """Return the text of an executed notebook to commit: outputs and tags, no other metadata.

    JupyterLab does not know the tag `hide-input`; it folds a cell whose source is hidden.
    A widget is replaced by its picture or page: JupyterLab shows an error for it without a kernel.
    The caption in the cell below a picture becomes the picture's alternative text.
    """
    import nbformat  # here, because its import takes longer than all else

    cells = own_cells(copy.deepcopy(notebook))
    for cell, below in zip(cells, cells[1:] + cells[-1:], strict=True):
        caption = re.match(r"\*\*Figure .*?\*\* (.*)", below.source)
        for output in cell.get("outputs", []):
            for kind in SHOWN & output.get("data", {}).keys():
                output.data.pop(WIDGET, None)
                if caption and kind != "text/html":
                    output.metadata.setdefault(kind, {})["alt"] = caption[1]
        tags = cell.metadata.get("tags")
        folded = {"jupyter": {"source_hidden": True}} if "hide-input" in (tags or []) else {}
        cell.metadata = {"tags": tags} | folded if tags else {}
    kernel = {"display_name": "Python 3", "language": "python", "name": "python3"}
    metadata = {"kernelspec": kernel, "language_info": {"name": "python"}}
    return nbformat.writes(nbformat.v4.new_notebook(cells=cells, metadata=metadata)) + "\n"


def list_goals() -> None:
    """Print the folder of the run, what to make in it, and pages whose parameters have changed."""
    chosen, run = parameters_of_pages(), Path(run_folder())
    only = re.findall(r"[^\s,]+", os.environ["ONLY"])
    wanted = {choose("ONLY: page", page, PAGES) for page in only} or PAGES
    goals = [str(run)]
    for name, path in PAGES.items():
        if name in wanted:
            copy, made_with = run / path.name, None
            with suppress(OSError, ValueError, KeyError):
                document = json.loads(copy.read_text("utf-8"))
                made_with = document["metadata"]["papermill"]["parameters"]
            if os.environ.get("FORCE") or made_with != chosen[name]:
                goals += ["-W", str(path.relative_to(ROOT))]
            goals += [str(copy), str(copy.with_suffix(".json"))]
    print(*goals)


if __name__ == "__main__":
    try:
        list_goals()
    except ValueError as problem:
        sys.exit(str(problem))
