"""Run the workbook: every notebook, in order, with papermill, into `runs/<name>/`.

    python -m affordlib.workbook --profile reader --seed 0 06_planning.n_goals=20

A notebook's parameters are its own defaults, overridden by `notebooks/profiles/<profile>.yaml`,
then by the command line, then by the seed and the folder of the run. A notebook is complete when
its executed copy and its results exist and a record, written last, holds the fingerprint of all
that they depend on. A rerun skips what is complete and goes on from there.
"""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import importlib.metadata
import json
import logging
import os
import platform
import re
import subprocess
import sys
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import ipykernel.kernelspec
import nbformat
import papermill
import traitlets
import zmq
from filelock import FileLock, Timeout
from jupyter_client.kernelspec import KernelSpec
from jupyter_client.manager import AsyncKernelManager
from nbclient.exceptions import DeadKernelError

from affordlib.commands import command, seed_type
from affordlib.paths import digest_of, repo_root, resolve_out_dir
from affordlib.profiles import (
    WorkbookError,
    choose,
    default_parameters,
    fitting,
    literal,
    notebook_paths,
    parse_setting,
    read_notebook,
    read_profile,
)
from affordlib.results import read_results, write_text_atomically

WIDGET = "application/vnd.jupyter.widget-view+json"
ADDED = {"injected-parameters", "papermill-error-cell-tag"}


def own_cells(cells: Iterable[nbformat.NotebookNode]) -> list[nbformat.NotebookNode]:
    """The cells without those that papermill adds."""
    return [c for c in cells if not ADDED & set(c.metadata.get("tags", []))]


def cleaned(notebook: nbformat.NotebookNode) -> str:
    """Return an executed notebook as it is committed: outputs and tags kept, the rest dropped.

    Of a widget its picture is kept: without its kernel JupyterLab would show an error in its place.
    """
    cells = own_cells(notebook.cells)
    for cell in cells:
        for output in cell.get("outputs", []):
            if "image/png" in output.get("data", ()):
                output.data.pop(WIDGET, None)
        cell.metadata = {k: cell.metadata[k] for k in ("tags", "jupyter") if cell.metadata.get(k)}
    clean = nbformat.v4.new_notebook(
        cells=cells,
        metadata={
            "kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"},
            "language_info": {"name": "python"},
        },
    )
    return nbformat.writes(clean) + "\n"


@dataclass(frozen=True)
class Layout:
    """The folders of a workbook; `of_repository` gives the real one."""

    notebooks: Path
    runs: Path
    sources: Path
    data: Path

    @classmethod
    def of_repository(cls) -> Layout:
        """Return the folders of the checkout."""
        root = repo_root()
        return cls(root / "notebooks", root / "runs", root / "affordlib", root / "data")


@dataclass(frozen=True)
class Job:
    """One notebook of a batch: where it comes from, and what it is run with."""

    name: str
    path: Path
    notebook: nbformat.NotebookNode
    overrides: dict[str, Any]
    parameters: dict[str, Any]

    @property
    def results(self) -> Path:
        """The results that the notebook has to write."""
        return repo_root() / self.parameters["out_dir"] / f"{self.name}.json"


class OwnKernelManager(AsyncKernelManager):
    """Starts the running interpreter as kernel, whatever kernels are registered on the machine."""

    @property
    def kernel_spec(self) -> KernelSpec:
        """The kernel of this interpreter, with figures inline whatever MPLBACKEND says."""
        return KernelSpec(
            resource_dir=ipykernel.kernelspec.RESOURCES,
            env={"MPLBACKEND": "module://matplotlib_inline.backend_inline"},
            **ipykernel.kernelspec.get_kernel_dict(),
        )

    async def start_kernel(self, **options: Any) -> None:
        """Start the kernel; what it prints outside its cells stays off our lines."""
        null = subprocess.DEVNULL
        await super().start_kernel(stdout=null, stderr=null, **options)

    @traitlets.default("transport_encryption")
    def _encrypt_if_possible(self) -> str:
        return "auto" if zmq.has("curve") else "disabled"


def make_jobs(
    layout: Layout, profile: str | None, settings: Sequence[str], common: Mapping[str, Any]
) -> list[Job]:
    """Return every notebook with its parameters, all names and types checked.

    `profile` None takes the defaults alone; `common` (seed, out_dir) overrides all.
    """
    paths = notebook_paths(layout.notebooks)
    if not paths:
        raise WorkbookError(f"there is no notebook NN_title.ipynb in {layout.notebooks}")
    loaded = {name: read_notebook(path) for name, path in paths.items()}
    defaults = {name: default_parameters(nb, name) for name, nb in loaded.items()}
    overrides: dict[str, dict[str, Any]] = {name: {} for name in loaded}

    def override(source: str, name: str, parameter: str, value: object, is_text: bool) -> None:
        name = choose(f"{source}: notebook", name, list(loaded))
        known = defaults[name]
        parameter = choose(f"{source}: parameter of {name}", parameter, list(known))
        if parameter in common:
            remedy = {"seed": "--seed", "out_dir": "--out"}[parameter]
            raise WorkbookError(f"{source}: {name}.{parameter} is set for all; use {remedy}")
        value = literal(value, known[parameter]) if is_text else value
        value = fitting(f"{source}: {name}.{parameter}", value, known[parameter])
        overrides[name][parameter] = value

    if profile is not None:
        for name, values in read_profile(layout.notebooks, profile).items():
            choose(f"{profile}.yaml: notebook", name, list(loaded))  # also one without values
            for parameter, value in values.items():
                override(f"{profile}.yaml", name, str(parameter), value, is_text=False)
    for setting in settings:
        override("settings", *parse_setting(setting), is_text=True)
    jobs = []
    for name, notebook in loaded.items():
        own = overrides[name] | common
        jobs.append(Job(name, paths[name], notebook, own, defaults[name] | own))
    return jobs


def fingerprint(job: Job, environment: Mapping[str, str], before: Mapping[str, str | None]) -> str:
    """Return a digest of all that a notebook's results depend on.

    `before` maps each earlier notebook to its fingerprint, or to None if this run lacks it.
    """
    cells = [[c.cell_type, c.source, c.metadata.get("tags", [])] for c in job.notebook.cells]
    content = [job.name, job.parameters, cells, environment, before]
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def environment_of(layout: Layout) -> dict[str, str]:
    """Return the digests of sources and data, and the versions that decide results."""
    libraries = {name: importlib.metadata.version(name) for name in ("torch", "numpy", "pybullet")}
    return {
        "sources": digest_of(layout.sources),
        "experiments": digest_of(layout.sources.parent / "experiments"),
        "exercises": digest_of(layout.notebooks / "exercises"),
        # What the notebooks themselves have written, copied there, is no input of theirs.
        "data": digest_of(layout.data, without="results/[0-9][0-9]_*.json"),
        "python": platform.python_version(),
        **libraries,
    }


@contextlib.contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Hold a run's folder; the lock dies with its process, so a kill leaves none behind."""
    try:
        lock = FileLock(resolve_out_dir(folder) / ".lock").acquire(timeout=0)
    except Timeout:
        raise WorkbookError(
            f"another runner is writing {shown(folder)}; wait for it, or choose another name with "
            "OUT= (--out)"
        ) from None
    with lock:
        yield


def shown(path: Path) -> str:
    """Return a path as the reader knows it: relative to where the command was given."""
    return os.path.relpath(path)


class Batch:
    """A run of the book into one folder; `in_place` also puts the cleaned copies back."""

    def __init__(self, layout: Layout, folder: Path, jobs: Sequence[Job], in_place: bool = False):
        self.layout, self.folder, self.jobs, self.in_place = layout, folder, jobs, in_place

    def copy(self, job: Job) -> Path:
        """The executed copy of a notebook."""
        return self.folder / f"{job.name}.ipynb"

    def record(self, job: Job) -> Path:
        """The record that says, once written, that a notebook is complete."""
        return self.folder / ".complete" / f"{job.name}.json"

    def is_complete(self, job: Job, mark: str) -> bool:
        """Whether the copy, the results and the record of a notebook are there and agree."""
        try:
            if json.loads(self.record(job).read_text(encoding="utf-8"))["fingerprint"] != mark:
                return False
            read_results(job.results)
            copy = read_notebook(self.copy(job))
            return not self.in_place or cleaned(copy) == job.path.read_text(encoding="utf-8")
        except (OSError, ValueError, KeyError, TypeError, RecursionError, WorkbookError):
            return False

    def run(self, only: Sequence[str] = (), force: bool = False, dry: bool = False) -> None:
        """Execute what is not complete, in order; raises WorkbookError at the first failure."""
        environment = environment_of(self.layout)
        before: dict[str, str | None] = {}
        asked = []
        for number, job in enumerate(self.jobs, 1):
            mark = fingerprint(job, environment, before)
            complete = self.is_complete(job, mark)
            if only and job.name not in only:
                before[job.name] = mark if complete else None
            else:
                before[job.name] = mark
                asked.append((number, job, mark, complete and not force))
        for number, job, mark, done in asked:
            print(f"[{number}/{len(self.jobs)}] {job.name}: ", end="", flush=True)
            if done:
                print("skipped: complete", flush=True)
            elif dry:
                print(f"would run with {job.parameters}", flush=True)
            else:
                print(f"{self.execute(job, mark):.1f} s", flush=True)

    def execute(self, job: Job, mark: str) -> float:
        """Execute one notebook, check what it wrote, record it as complete; return the seconds."""
        start = time.monotonic()
        copy, record = self.copy(job), self.record(job)
        record.parent.mkdir(parents=True, exist_ok=True)
        for stale in (record, job.results):
            stale.unlink(missing_ok=True)
        try:
            papermill.execute_notebook(
                shown(job.path),  # papermill writes both paths into the copy
                shown(copy),
                job.overrides,
                kernel_name="python3",
                language="python",
                progress_bar=False,
                start_timeout=120,
                cwd=job.path.parent,
                kernel_manager_class=OwnKernelManager,
                coalesce_streams=True,
            )
        except KeyboardInterrupt:
            # nbclient's task outlives the interrupt, and would log the kernel's end as an error.
            logging.getLogger("asyncio").setLevel(logging.CRITICAL)
            raise
        except Exception as error:
            print("failed", flush=True)
            raise WorkbookError(explained(job, copy, error)) from None
        try:
            read_results(job.results)
        except (OSError, ValueError) as error:
            print("failed", flush=True)
            raise WorkbookError(
                f"{job.name} ran to its end but did not write its numbers: {error}; "
                f"it must call write_results(out_dir, {job.name!r}, ...)"
            ) from None
        if self.in_place:
            write_text_atomically(job.path, cleaned(read_notebook(copy)))
        write_text_atomically(record, json.dumps({"fingerprint": mark}) + "\n")
        return time.monotonic() - start


def explained(job: Job, copy: Path, error: Exception) -> str:
    """Return what failed: notebook, cell as numbered in the committed notebook, and error."""
    if isinstance(error, papermill.PapermillExecutionError):
        reason = f"{error.ename}: {error.evalue}"
    else:
        reason = f"{type(error).__name__}: {error}"
        if isinstance(error, DeadKernelError):
            reason += " (out of memory, or a crash in compiled code)"
    where, kept = "before its first cell", ""
    with contextlib.suppress(WorkbookError):
        cells = own_cells(read_notebook(copy).cells)
        started = [
            i for i, c in enumerate(cells) if c.metadata.get("papermill", {}).get("start_time")
        ]
        if started:
            lines = cells[started[-1]].source.strip().splitlines() or [""]
            where = f"in cell {started[-1] + 1}, which begins `{lines[0].strip()}`"
        kept = f"\nThe executed copy is {shown(copy)}."
    return (
        f"{job.name} failed {where}\n{reason}{kept} "
        "The same command goes on from this notebook once it is mended."
    )


TAKEN = ("lab", "html")


def run_name(profile: str, seed: int, name: str | None) -> str:
    """Return the name of the run's folder under `runs/`."""
    name = name or profile + (f"-seed{seed}" if seed else "")
    if not re.fullmatch(r"\w[\w.-]*", name) or name in TAKEN:
        raise WorkbookError(
            f"OUT (--out) must be a plain folder name under runs/, got {name!r}; 'lab' belongs to "
            "the notebooks opened by hand, 'html' to the book as web pages"
        )
    return name


@command(OSError, WorkbookError)
def main(argv: Sequence[str] | None = None, layout: Layout | None = None) -> int:
    """Execute the notebooks of the book in order, skipping what is complete."""
    parser = argparse.ArgumentParser(prog="python -m affordlib.workbook", description=main.__doc__)
    parser.add_argument("settings", nargs="*", metavar="NN_title.parameter=value")
    parser.add_argument("--profile", default="reader", help="smoke, reader (default) or full")
    parser.add_argument("--seed", type=seed_type, default=0)
    parser.add_argument("--out", metavar="NAME", help="folder under runs/; default: the profile")
    parser.add_argument("--only", default="", metavar="'03 06'", help="run only these notebooks")
    parser.add_argument("--force", action="store_true", help="run also what is complete")
    parser.add_argument("--dry-run", action="store_true", help="say what would run")
    parser.add_argument(
        "--in-place", action="store_true", help="execute the committed notebooks at their defaults"
    )
    options = parser.parse_args(argv)
    layout = layout or Layout.of_repository()
    logging.getLogger("papermill").setLevel(logging.CRITICAL)
    if options.in_place:
        folder = layout.runs / "lab"
        if options.settings or options.seed or options.out:
            raise WorkbookError("--in-place takes the notebooks' own defaults, no settings")
        jobs = make_jobs(layout, None, [], {})
    else:
        folder = layout.runs / run_name(options.profile, options.seed, options.out)
        root = repo_root()
        out_dir = folder.relative_to(root) if folder.is_relative_to(root) else folder
        common = {"seed": options.seed, "out_dir": out_dir.as_posix()}
        jobs = make_jobs(layout, options.profile, options.settings, common)
    names = [job.name for job in jobs]
    only = [
        choose("ONLY: notebook", name, names) for name in re.split(r"[\s,]+", options.only) if name
    ]
    batch = Batch(layout, folder, jobs, options.in_place)
    if options.dry_run:
        batch.run(only, options.force, dry=True)
    else:
        with locked(folder):
            batch.run(only, options.force)
    return 0


if __name__ == "__main__":
    sys.exit(main())
