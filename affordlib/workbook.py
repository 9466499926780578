"""Run the workbook: execute every notebook in order with papermill, into `runs/<name>/`.

    python -m affordlib.workbook --profile reader --seed 0 06_planning.n_goals=20

A notebook's parameters are its own defaults, overridden by `notebooks/profiles/<profile>.yaml`,
then by the command line, then by the seed and the folder of the run. Names and types are checked
before anything runs (papermill only logs an unknown name). A notebook is complete when its results
exist and its executed copy contains the hash of all their inputs, which is written last. A rerun
skips complete notebooks and continues with the others.
"""

import argparse
import ast
import copy
import difflib
import hashlib
import json
import logging
import math
import multiprocessing
import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from contextlib import nullcontext, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import ipykernel.kernelspec
import nbformat
import papermill
import yaml
import zmq
from filelock import FileLock, Timeout
from jupyter_client.kernelspec import KernelSpec
from jupyter_client.manager import AsyncKernelManager

from affordlib.commands import command, count_type, seed_type
from affordlib.paths import repo_root, resolve_out_dir
from affordlib.results import read_results, versions, write_atomically

WIDGET = "application/vnd.jupyter.widget-view+json"
INJECTED = {"injected-parameters", "papermill-error-cell-tag"}
"""Tags of the cells that papermill adds."""

INPUTS = ("affordlib", "experiments", "notebooks/exercises", "data")
"""Folders that results depend on."""

NO_INPUT = re.compile(r"/(\.|__pycache__)|^data/results/\d\d_")
"""Files in these folders that are no inputs: caches, and copies of the notebooks' own results."""


class WorkbookError(Exception):
    """Raised when a batch cannot start or a notebook fails; the message is shown to the user."""


@dataclass(frozen=True)
class Job:
    """One notebook of a batch: its path, its parameters and the path of its executed copy."""

    name: str
    path: Path
    notebook: nbformat.NotebookNode
    overrides: dict[str, Any]
    parameters: dict[str, Any]
    copy: Path
    in_place: bool

    @property
    def results(self) -> Path:
        """Path of the results file that the notebook has to write."""
        return repo_root() / self.parameters["out_dir"] / f"{self.name}.json"


def notebook_paths(root: Path) -> dict[str, Path]:
    """Return the paths of a checkout's notebooks by name, in order, with the appendix last."""
    pages = sorted(root.glob("notebooks/[0-9][0-9]_*.ipynb"))
    appendix = sorted(root.glob("notebooks/appendix/A[0-9]_*.ipynb"))
    return {path.stem: path for path in pages + appendix}


def read_notebook(path: Path) -> nbformat.NotebookNode:
    """Read a notebook; raises WorkbookError if the file is not a readable notebook."""
    try:
        return nbformat.read(path, as_version=4)
    except Exception as error:
        raise WorkbookError(f"{path.name} is not a notebook that can be read: {error}") from None


def default_parameters(notebook: nbformat.NotebookNode, name: str) -> dict[str, Any]:
    """Return a notebook's parameters: the plain literals in its cell tagged `parameters`."""
    try:
        (cell,) = (c for c in notebook.cells if "parameters" in c.metadata.get("tags", []))
        lines = ast.parse(cell.source).body
        targets = [x.target if isinstance(x, ast.AnnAssign) else x.targets[0] for x in lines]
        defaults = {t.id: ast.literal_eval(x.value) for t, x in zip(targets, lines, strict=True)}
    except (SyntaxError, ValueError, AttributeError, TypeError) as error:
        raise WorkbookError(
            f"{name} needs one cell tagged 'parameters' with one `name = value` per line, where "
            f"the values are plain literals ({error})"
        ) from None
    if missing := {"seed", "out_dir"} - defaults.keys():
        raise WorkbookError(f"{name} has no parameter {min(missing)!r}; every notebook needs it")
    return defaults


def read_profile(root: Path, profile: str) -> list[tuple[str, str, Any]]:
    """Return all (notebook, parameter, value) in `notebooks/profiles/<profile>.yaml`."""
    paths = {path.stem: path for path in sorted(root.glob("notebooks/profiles/*.yaml"))}
    choose("profile", profile, list(paths))
    try:
        values = yaml.safe_load(paths[profile].read_text(encoding="utf-8")) or {}
        return [(str(n), str(p), v) for n, entry in values.items() for p, v in entry.items()]
    except (yaml.YAMLError, AttributeError) as error:
        raise WorkbookError(
            f"profile: {profile}.yaml must map notebooks to their parameters ({error})"
        ) from None


def choose(kind: str, given: str, known: Sequence[str]) -> str:
    """Return the known name for a name or number; raises WorkbookError with similar names."""
    number = re.fullmatch(r"A?\d+", given)
    matches = [n for n in known if n == given or (number and n.startswith(f"{given}_"))]
    if len(matches) == 1:
        return matches[0]
    near = difflib.get_close_matches(given, known, n=3, cutoff=0.5)
    hint = f"did you mean {' or '.join(near)}?" if near else f"there are: {', '.join(known)}"
    raise WorkbookError(f"{kind} {given!r} is unknown; {hint}")


def fitting(where: str, value: object, default: object) -> Any:
    """Return a value in the type of its default; raises WorkbookError if the types differ."""
    if isinstance(default, float) and type(value) is int:
        return float(value)
    if isinstance(default, list | tuple) and isinstance(value, list | tuple):
        return [fitting(f"{where}[{i}]", v, (*default, v)[0]) for i, v in enumerate(value)]
    fits = default is None or type(value) is type(default)
    least = 1 if type(default) is int and default else 0
    if fits and isinstance(value, int | float):
        fits = math.isfinite(value) and (isinstance(value, float) or value >= least)
    if not fits:
        limit = {int: f" from {least}", float: ", finite"}.get(type(default), "")
        raise WorkbookError(
            f"{where} must be {type(default).__name__}{limit}, like its default {default!r}, "
            f"got {type(value).__name__} {value!r:.60}"
        )
    return value


def literal(text: str, default: object) -> Any:
    """Parse a value given on the command line; strings need no quotes."""
    value: object = text
    for parse in (yaml.safe_load, ast.literal_eval):  # if neither can parse it, it is a string
        with suppress(Exception):
            value = parse(text)
    return text if isinstance(default, str) and not isinstance(value, str) else value


def make_jobs(
    root: Path, profile: str | None, settings: Sequence[str] = (), seed: int = 0, out: str = ""
) -> list[Job]:
    """Return a job per notebook, parameters checked; profile None: defaults, executed in place."""
    paths = notebook_paths(root)
    if not paths:
        raise WorkbookError(f"there is no notebook NN_title.ipynb in {root / 'notebooks'}")
    notebooks = {name: read_notebook(path) for name, path in paths.items()}
    defaults = {name: default_parameters(nb, name) for name, nb in notebooks.items()}
    overrides: dict[str, dict[str, Any]] = {name: {} for name in paths}
    folder, common, given = root / "runs" / "lab", {}, []
    if profile is not None:
        folder = root / "runs" / run_name(profile, seed, out)
        own = folder.relative_to(root) if root == repo_root() else folder
        common = {"seed": seed, "out_dir": own.as_posix()}
        given = [(f"{profile}.yaml", *each) for each in read_profile(root, profile)]
    for setting in settings:
        match = re.fullmatch(r"(\w+)\.(\w+)=(.*)", setting)
        if not match:
            raise WorkbookError(f"{setting!r} is not valid; write it like 06_planning.n_goals=20")
        given.append(("settings", *match.groups()))
    for source, notebook, parameter, value in given:
        name = choose(f"{source}: notebook", notebook, list(paths))
        where = choose(f"{source}: parameter of {name}", parameter, list(defaults[name]))
        if where in common:
            raise WorkbookError(f"{source}: {name}.{where} cannot be set; use --seed and --out")
        default = defaults[name][where]
        value = literal(value, default) if source == "settings" else value
        overrides[name][where] = fitting(f"{source}: {name}.{where}", value, default)
    jobs = []
    for name, path in paths.items():
        own, copied = overrides[name] | common, folder / path.name
        all_of = defaults[name] | own
        jobs.append(Job(name, path, notebooks[name], own, all_of, copied, profile is None))
    return jobs


def run_name(profile: str, seed: int, name: str) -> str:
    """Return the name of the run's folder under `runs/`."""
    name = name or profile + (f"-seed{seed}" if seed else "")
    if not re.fullmatch(r"\w[\w.-]*", name) or name in ("lab", "html"):
        raise WorkbookError(
            f"OUT (--out) must be a plain folder name under runs/, and neither lab nor html, "
            f"which other commands use, got {name!r}"
        )
    return name


def own_cells(notebook: nbformat.NotebookNode) -> list[nbformat.NotebookNode]:
    """Return the cells of a notebook without those that papermill added."""
    return [c for c in notebook.cells if not INJECTED & set(c.metadata.get("tags", []))]


def cleaned(notebook: nbformat.NotebookNode) -> str:
    """Return the text of an executed notebook to commit: outputs and tags, no other metadata.

    JupyterLab does not know the tag `hide-input`; it folds a cell whose source is hidden.
    A widget is replaced by its picture, as JupyterLab shows an error for a widget without a kernel.
    The caption in the cell below a picture becomes the picture's alternative text.
    """
    cells = own_cells(notebook)
    for cell, below in zip(cells, cells[1:] + cells[-1:], strict=True):
        caption = re.match(r"\*\*Figure .*?\*\* (.*)", below.source)
        for output in cell.get("outputs", []):
            for kind in {"image/png", "image/svg+xml"} & output.get("data", {}).keys():
                output.data.pop(WIDGET, None)
                if caption:
                    output.metadata.setdefault(kind, {})["alt"] = caption[1]
        tags = cell.metadata.get("tags")
        folded = {"jupyter": {"source_hidden": True}} if "hide-input" in (tags or []) else {}
        cell.metadata = {"tags": tags} | folded if tags else {}
    kernel = {"display_name": "Python 3", "language": "python", "name": "python3"}
    metadata = {"kernelspec": kernel, "language_info": {"name": "python"}}
    return nbformat.writes(nbformat.v4.new_notebook(cells=cells, metadata=metadata)) + "\n"


class OwnKernelManager(AsyncKernelManager):
    """Starts kernels with the running interpreter, independent of the registered kernels."""

    kernel_spec = KernelSpec(
        env={"MPLBACKEND": "module://matplotlib_inline.backend_inline"},
        **ipykernel.kernelspec.get_kernel_dict(),
    )

    async def start_kernel(self, **options: Any) -> None:
        """Start the kernel, encrypted if possible, and discard its output outside of cells."""
        options |= {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        encryption = "auto" if zmq.has("curve") else "disabled"
        await super().start_kernel(transport_encryption=encryption, **options)


def environment_hash(root: Path) -> str:
    """Return a hash of the inputs of results other than the notebooks: `INPUTS` and versions."""
    digest = hashlib.sha256(repr(versions()).encode())
    for path in sorted(path for folder in INPUTS for path in (root / folder).rglob("*")):
        name = path.relative_to(root).as_posix()
        if path.is_file() and not NO_INPUT.search(name):
            digest.update(f"{name} {path.stat().st_size}\n".encode() + path.read_bytes())
    return digest.hexdigest()


def is_complete(job: Job, mark: str) -> bool:
    """Return whether a notebook's results and copy exist, the copy with the hash `mark`."""
    with suppress(OSError, ValueError, WorkbookError):
        read_results(job.results)
        done = read_notebook(job.copy)
        if done.metadata.get("complete") == mark:
            return not job.in_place or cleaned(done) == job.path.read_text(encoding="utf-8")
    return False


def run(
    jobs: Sequence[Job], environment: str, only: Sequence[str], options: argparse.Namespace
) -> None:
    """Execute incomplete notebooks in order; raises WorkbookError at the first failure."""
    before: list[str | None] = []  # hash of each earlier notebook, None if not part of this run
    left = []
    for number, job in enumerate(jobs, 1):
        cells = [[c.cell_type, c.source, c.metadata.get("tags", [])] for c in job.notebook.cells]
        inputs = json.dumps([job.parameters, cells, environment, before], sort_keys=True)
        mark = hashlib.sha256(inputs.encode()).hexdigest()
        complete, wanted = is_complete(job, mark), not only or job.name in only
        before.append(mark if complete or wanted else None)
        if not wanted:
            continue
        place = f"[{number}/{len(jobs)}] {job.name}"
        if complete and not options.force:
            print(f"{place}: skipped: complete", flush=True)
        elif options.dry_run:
            print(f"{place}: would run with {job.parameters}", flush=True)
        else:
            left.append((place, job, mark))
    if options.workers == 1:
        for each in left:
            execute(*each)
        return
    with multiprocessing.Pool(options.workers, end_with_parent) as pool:
        for done in [pool.apply_async(execute, each) for each in left]:
            done.get()


def end_with_parent() -> None:
    """Make this process, and thereby its kernel, end when its parent ends or terminates it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent handles Ctrl-C
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    parent = multiprocessing.parent_process()
    threading.Thread(target=lambda: (parent.join(), os._exit(1)), daemon=True).start()


def execute(place: str, job: Job, mark: str) -> None:
    """Execute one notebook, check its results, mark it as complete and print the run time."""
    print(f"{place} …", flush=True)
    start = time.monotonic()
    job.results.unlink(missing_ok=True)
    try:
        papermill.execute_notebook(
            os.path.relpath(job.path),  # papermill writes both paths into the copy
            os.path.relpath(job.copy),
            job.overrides,
            kernel_name="python3",
            language="python",
            progress_bar=False,
            start_timeout=120,
            cwd=job.path.parent,
            kernel_manager_class=OwnKernelManager,
            coalesce_streams=True,
        )
        read_results(job.results)
    except KeyboardInterrupt:
        # nbclient's task survives the interrupt and would log the kernel's end as an error.
        logging.getLogger("asyncio").setLevel(logging.CRITICAL)
        raise
    except Exception as error:
        print(f"{place}: failed", flush=True)
        raise WorkbookError(explained(job, error)) from None
    notebook = read_notebook(job.copy)
    if job.in_place:
        write_atomically(job.path, cleaned(copy.deepcopy(notebook)))
    notebook.metadata["complete"] = mark
    write_atomically(job.copy, nbformat.writes(notebook))
    print(f"{place}: {time.monotonic() - start:.1f} s", flush=True)


def explained(job: Job, error: Exception) -> str:
    """Describe a failure: notebook, cell number in the committed notebook, and error."""
    reason, where = f"{type(error).__name__}: {error}", ""
    if isinstance(error, papermill.PapermillExecutionError):
        reason = f"{error.ename}: {error.evalue}"
    with suppress(WorkbookError):
        for number, cell in enumerate(own_cells(read_notebook(job.copy)), 1):
            if cell.metadata.get("papermill", {}).get("start_time"):
                line = cell.source.strip().partition("\n")[0]
                where = f" in cell {number}, which begins `{line}`"
    return (
        f"{job.name} failed{where}\n{reason}\nThe executed copy is {os.path.relpath(job.copy)}. "
        "Fix it and run the same command again: it continues with this notebook."
    )


@command(OSError, WorkbookError)
def main(argv: Sequence[str] | None = None, root: Path | None = None) -> int:
    """Execute the notebooks of the book in order, skipping complete ones."""
    parser = argparse.ArgumentParser(prog="python -m affordlib.workbook", description=main.__doc__)
    parser.add_argument("settings", nargs="*", metavar="NN_title.parameter=value")
    parser.add_argument("--profile", default="reader", help="smoke, reader (default) or full")
    parser.add_argument("--seed", type=seed_type, default=0)
    parser.add_argument(
        "--out", default="", metavar="NAME", help="folder under runs/; default: the profile"
    )
    parser.add_argument("--only", default="", metavar="'03 06'", help="run only these notebooks")
    parser.add_argument("--workers", type=count_type, default=1, help="notebooks run in parallel")
    parser.add_argument("--force", action="store_true", help="also run complete notebooks")
    parser.add_argument("--dry-run", action="store_true", help="only print what would be run")
    parser.add_argument(
        "--in-place", action="store_true", help="execute the committed notebooks at their defaults"
    )
    options = parser.parse_args(argv)
    root = root or repo_root()
    logging.getLogger("papermill").setLevel(logging.CRITICAL)
    if options.in_place and (options.settings or options.seed or options.out):
        raise WorkbookError("--in-place takes the notebooks' own defaults; leave out the settings")
    profile = None if options.in_place else options.profile
    jobs = make_jobs(root, profile, options.settings, options.seed, options.out)
    names = [job.name for job in jobs]
    only = [choose("ONLY: notebook", name, names) for name in re.findall(r"[^\s,]+", options.only)]
    folder, lock = jobs[0].copy.parent, nullcontext()
    if not options.dry_run:  # the lock ends with its process, so a killed run leaves none behind
        lock = FileLock(resolve_out_dir(folder) / ".lock", timeout=0)
    try:
        with lock:
            run(jobs, environment_hash(root), only, options)
    except Timeout:
        raise WorkbookError(
            f"another run is writing to {os.path.relpath(folder)}; wait for it, or choose another "
            "name with OUT= (--out)"
        ) from None
    return 0


if __name__ == "__main__":
    sys.exit(main())
