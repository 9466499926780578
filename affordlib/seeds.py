"""The same batch for several seeds, and what they say together: a table and a page over seeds.

    python -m affordlib.seeds 0 1 2 --profile smoke --only 06 --workers 2

Every seed is a run of `affordlib.workbook` in a folder of its own, `runs/<name>-seed<k>`; with a
Dask client they run side by side, on workers that share the checkout. What they wrote is gathered
into `runs/<name>-seeds/`: rows that agree in all their words and truths are one row, their numbers
become means, and beside those that differ stands the standard deviation over seeds. The page draws
what differs, a dot a seed.
"""

from __future__ import annotations

import argparse
import base64
import html
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

from nbconvert.filters.markdown_mistune import markdown2html_mistune

from affordlib.paths import repo_root
from affordlib.profiles import WorkbookError
from affordlib.results import markdown_table, read_results, write_results, write_text_atomically
from affordlib.seeds_picture import same_rows, seeds_picture
from affordlib.workbook import run_name

if TYPE_CHECKING:
    from dask.distributed import Client

    Row = Mapping[str, Any]

STYLE = (
    "body{font-family:sans-serif;max-width:70rem;margin:2rem auto;padding:0 1rem;color:#222}"
    "table{border-collapse:collapse;display:block;overflow-x:auto;font-size:.85rem}"
    "th,td{padding:.3rem .7rem;text-align:right;border-bottom:1px solid #ddd}"
    "img{max-width:100%}.anchor-link{display:none}"
)


def command_of(arguments: Sequence[str]) -> list[str]:
    """The command that runs a batch."""
    return [sys.executable, "-m", "affordlib.workbook", *arguments]


def run_seeds(
    seeds: Sequence[int],
    name: str,
    arguments: Sequence[str],
    client: Client | None = None,
    command: Callable[[Sequence[str]], list[str]] = command_of,
) -> None:
    """Run the batch for every seed into `runs/<name>-seed<k>`, one after another or by a client.

    Says of each when it is done. Raises WorkbookError, after all have ended, with what the failed
    ones said.
    """
    batches = [
        (seed, command(["--seed", str(seed), "--out", f"{name}-seed{seed}", *arguments]))
        for seed in seeds
    ]
    if client is None:
        done = (_run(batch) for batch in batches)
    else:
        from dask.distributed import as_completed

        # Whether a batch has to run is for the batch to say: it skips what is complete.
        futures = client.map(_run, batches, pure=False)
        done = (said for _, said in as_completed(futures, with_results=True))
    failed = []
    for seed, code, said, minutes in done:
        print(f"seed {seed}: {'failed' if code else 'done'} after {minutes:.1f} min", flush=True)
        if code:
            failed.append(f"seed {seed}:\n{said.strip()}")
    if failed:
        raise WorkbookError("\n".join(sorted(failed)))


def _run(batch: tuple[int, Sequence[str]]) -> tuple[int, int, str, float]:
    seed, command = batch
    began = time.monotonic()
    done = subprocess.run(
        command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, check=False
    )
    return seed, done.returncode, done.stdout, (time.monotonic() - began) / 60


def over_seeds(tables: Sequence[Sequence[Row]]) -> list[dict[str, Any]]:
    """One table of the same table of several seeds.

    Rows are the same if they agree in all that is no number, and in their place among such rows.
    A number that some seeds do not have is meaned over those that do.
    """
    return [_together(rows) for rows in same_rows(tables)]


def _together(rows: Sequence[Row]) -> dict[str, Any]:
    row: dict[str, Any] = {"seeds": len(rows)}
    for column in dict.fromkeys(name for each in rows for name in each):
        values = [each[column] for each in rows if each.get(column) is not None]
        row[column] = values[0] if values else None
        if len(set(values)) > 1:
            row[column] = statistics.fmean(values)
            row[f"sd_{column}"] = statistics.stdev(values)
    return row


def gather(folders: Mapping[int, Path], into: Path) -> Path:
    """Write the tables over seeds and the page that shows them; returns the page."""
    seeds = list(folders)
    # Of notebooks: beside them lie plans that were saved.
    there = [path for folder in folders.values() for path in folder.glob("[0-9][0-9]_*.json")]
    names = sorted({path.stem for path in there})
    page = [f"# Over {len(seeds)} seeds", f"Seeds {', '.join(map(str, seeds))}."]
    page.append("Means over seeds; *sd* is the standard deviation of one seed among them.")
    for name in names:
        documents = [
            read_results(folder / f"{name}.json")
            for folder in folders.values()
            if (folder / f"{name}.json").is_file()
        ]
        tables = {
            table: over_seeds([document["tables"].get(table, []) for document in documents])
            for table in dict.fromkeys(t for document in documents for t in document["tables"])
        }
        write_results(into, name, {"seeds": seeds}, tables)
        page.append(f"## {name}")
        for table, rows in tables.items():
            page += [f"### {table.replace('_', ' ')}", markdown_table(rows) if rows else "Empty."]
            told = [document["tables"].get(table, []) for document in documents]
            if (picture := seeds_picture(told)) is not None:
                data = base64.b64encode(picture).decode()
                page.append(f"![each seed of {table}](data:image/png;base64,{data})")
    text = markdown2html_mistune("\n\n".join(page))
    head = f"<!DOCTYPE html><meta charset='utf-8'><title>{html.escape(into.name)}</title>"
    path = into / "index.html"
    write_text_atomically(path, f"{head}<style>{STYLE}</style>{text}\n")
    return path


def main(argv: Sequence[str] | None = None) -> int:
    """Run the notebooks for several seeds and gather what they wrote."""
    parser = argparse.ArgumentParser(prog="python -m affordlib.seeds", description=main.__doc__)
    parser.add_argument("seeds", type=int, nargs="+")
    parser.add_argument("--profile", default="reader")
    parser.add_argument("--out", default="", metavar="NAME", help="default: the profile")
    parser.add_argument("--only", default="", metavar="'03 06'")
    parser.add_argument("--settings", nargs="*", default=[], metavar="NN_title.parameter=value")
    parser.add_argument("--workers", type=int, default=2, help="seeds side by side on this machine")
    parser.add_argument("--force", action="store_true", help="run also what is complete")
    parser.add_argument("--dry-run", action="store_true", help="say what would run")
    parser.add_argument("--scheduler", help="a Dask scheduler whose workers share the checkout")
    options = parser.parse_args(argv)
    runs = repo_root() / "runs"
    try:
        if len(set(options.seeds)) < len(options.seeds) or min(options.seeds) < 0:
            raise WorkbookError(f"SEEDS must differ and be 0 or more, got {options.seeds}")
        name = run_name(options.profile, 0, options.out or None)
        arguments = ["--profile", options.profile, "--only", options.only]
        arguments += ["--force"] * options.force + ["--", *options.settings]
        # What would run is said in any case; it is also where wrong settings are refused.
        for seed in options.seeds:
            own = ["--seed", str(seed), "--out", f"{name}-seed{seed}", "--dry-run"]
            _, code, said, _ = _run((seed, command_of(own + arguments)))
            if code:
                raise WorkbookError(said.strip())
            print(f"seed {seed}: {said.strip()}", flush=True)
        if options.dry_run:
            return 0
        with ExitStack() as stack:
            client = None
            if options.scheduler or min(options.workers, len(options.seeds)) > 1:
                from dask.distributed import Client, LocalCluster

                cluster = options.scheduler or stack.enter_context(
                    LocalCluster(options.workers, threads_per_worker=1, dashboard_address=None)
                )
                client = stack.enter_context(Client(cluster))
            run_seeds(options.seeds, name, arguments, client)
        folders = {seed: runs / f"{name}-seed{seed}" for seed in options.seeds}
        page = gather(folders, runs / f"{name}-seeds")
    except (WorkbookError, OSError, ValueError) as error:
        print(f"seeds: {error}", file=sys.stderr)
        return 1
    print(f"The page over seeds is {page.relative_to(repo_root())}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
