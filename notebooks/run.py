"""Execute one page of the book with papermill; make calls this.

    python notebooks/run.py notebooks/06_planning.ipynb runs/smoke/06_planning.ipynb

The copy of a page is written last, so one that exists is complete.
"""

import os
import re
import resource
import shutil
import signal
import sys
import tempfile
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

import ipykernel.kernelspec
import nbformat
import papermill
from jupyter_client.kernelspec import KernelSpec
from jupyter_client.manager import AsyncKernelManager
from pages import cleaned, own_cells, parameters_of_pages

from affordlib.results import read_results, write_atomically

ENDED_BY = signal.SIGINT, signal.SIGTERM


class OwnKernel(AsyncKernelManager):
    """Kernels of the running interpreter, reached through files that only this user can open."""

    kernel_spec = KernelSpec(
        env={"MPLBACKEND": "module://matplotlib_inline.backend_inline"},
        **ipykernel.kernelspec.get_kernel_dict(),
    )

    async def start_kernel(self, **options: Any) -> None:
        """Start a kernel in its own process group, and keep what it prints outside of cells."""
        folder = Path(os.environ["IPYTHONDIR"])
        self.transport, self.connection_file = "ipc", str(folder / "kernel.json")
        later: list[int] = []  # signals that arrive before the kernel's group is known
        ends = {n: signal.signal(n, lambda n, _: later.append(n)) for n in ENDED_BY}
        try:
            with (folder / "printed").open("wb") as printed:
                await super().start_kernel(stdout=printed, stderr=printed, **options)
            (folder / "group").write_text(str(self.provisioner.pgid))
        finally:
            for number, end in ends.items():
                signal.signal(number, end)
            for number in later:
                os.kill(os.getpid(), number)


def execute(path: Path, copy: Path) -> None:
    """Execute a page, check its results, and write its copy. What failed has another name."""
    start, results = time.monotonic(), copy.with_suffix(".json")
    failed = copy.with_suffix(".failed.ipynb")
    left = failed.absolute()  # papermill works in the page's folder
    folder = Path(tempfile.mkdtemp(prefix="page-"))
    os.environ["IPYTHONDIR"] = str(folder)

    def end(number: int, _: object = None) -> None:
        """End the kernel with all processes that it has started; a signal ends this process too."""
        with suppress(OSError):
            os.killpg(int((folder / "group").read_text()), signal.SIGKILL)
        shutil.rmtree(folder, ignore_errors=True)
        if number:
            left.unlink(missing_ok=True)
            print(f"{path.stem}: interrupted; the same command continues", flush=True)
            os._exit(128 + number)

    for number in ENDED_BY:
        signal.signal(number, end)
    results.unlink(missing_ok=True)
    copy.unlink(missing_ok=True)
    print(f"{path.stem} …", flush=True)
    try:
        notebook = papermill.execute_notebook(
            path,
            failed,
            parameters_of_pages()[path.stem],
            kernel_name="python3",
            language="python",
            progress_bar=False,
            start_timeout=30,
            cwd=path.parent,
            kernel_manager_class=OwnKernel,
            coalesce_streams=True,
        )
        read_results(results.resolve())
    except Exception as error:
        raise RuntimeError(explained(path, failed, error, folder / "printed")) from None
    finally:
        end(0)
    notebook.metadata.papermill["output_path"] = str(copy)
    if os.environ.get("IN_PLACE") and cleaned(notebook) != path.read_text("utf-8"):
        write_atomically(path, cleaned(notebook))
    os.utime(results)
    write_atomically(copy, nbformat.writes(notebook))
    failed.unlink()
    print(f"{path.stem}: {time.monotonic() - start:.1f} s", flush=True)


def explained(path: Path, copy: Path, error: Exception, printed: Path) -> str:
    """Describe a failure: page, cell number in the committed page, and reason."""
    where, said = "", printed.read_text(errors="replace") if printed.is_file() else ""
    cells = own_cells(nbformat.read(copy, as_version=4)) if copy.is_file() else []
    for number, cell in enumerate(cells, 1):
        if cell.metadata.get("papermill", {}).get("start_time"):
            line = cell.source.strip().partition("\n")[0]
            where = f" in cell {number}, which begins `{line}`; the executed copy is {copy}"
            said = "".join(o.text for o in cell.get("outputs", []) if o.get("name") == "stderr")
    reason = f"{type(error).__name__}: {error}"
    if isinstance(error, papermill.PapermillExecutionError) and error.evalue:
        reason = f"{error.ename}: {error.evalue}"
    elif found := re.search(r"^\w[\w.]*(Error|Exception)\b.*", said, re.MULTILINE):
        reason = found[0]  # of a kernel without memory or files left to say it properly
    if 0 < (limit := resource.getrlimit(resource.RLIMIT_AS)[0]) < 8 << 30:
        reason += f" (ulimit -v leaves {limit >> 20} MB of address space)"
    return f"{path.stem} failed{where}\n{reason}"


if __name__ == "__main__":
    try:
        execute(*map(Path, sys.argv[1:]))
    except (OSError, ValueError, RuntimeError) as problem:
        sys.exit(str(problem))
