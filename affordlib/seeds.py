"""The same batch for several seeds, and what they say together: tables over seeds.

    python -m affordlib.seeds 0 1 2 --profile smoke --only 06 --workers 2

Every seed is a run of `affordlib.workbook` in a folder of its own, `runs/<name>-seed<k>`; with a
Dask client they run side by side, on workers that share the checkout. What they wrote is gathered
into `runs/<name>-seeds/`: rows that agree in all their words and truths are one row, their numbers
become means, and beside those that differ stands the standard deviation over seeds. The same tables
stand in `index.md`, with pictures of what differs, a dot a seed.
"""

from __future__ import annotations

import argparse
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from affordlib.commands import command, count_type, seed_type
from affordlib.paths import repo_root
from affordlib.profiles import WorkbookError
from affordlib.results import (
    MARKUP,
    markdown_table,
    read_results,
    write_atomically,
    write_results,
    write_text_atomically,
)
from affordlib.seeds_picture import same_rows, seeds_picture
from affordlib.workbook import run_name
from affordlib.workers import dask_client

if TYPE_CHECKING:
    from dask.distributed import Client

Row = Mapping[str, Any]


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
    """Write the tables over seeds, as JSON, and as Markdown with pictures; returns the latter."""
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
        for number, (table, rows) in enumerate(tables.items()):
            page.append(f"### {table.replace('_', ' ').translate(MARKUP)}")
            page.append(markdown_table(rows) if rows else "Empty.")
            told = [document["tables"].get(table, []) for document in documents]
            if (picture := seeds_picture(told)) is not None:
                file = f"{name}-{number}.png"
                write_atomically(into / file, picture)
                page.append(f"![each seed]({file})")
    path = into / "index.md"
    write_text_atomically(path, "\n\n".join(page) + "\n")
    return path


@command(OSError, ValueError, WorkbookError)
def main(argv: Sequence[str] | None = None) -> int:
    """Run the notebooks for several seeds and gather what they wrote."""
    parser = argparse.ArgumentParser(prog="python -m affordlib.seeds", description=main.__doc__)
    parser.add_argument("seeds", type=seed_type, nargs="+")
    parser.add_argument("--profile", default="reader")
    parser.add_argument("--out", default="", metavar="NAME", help="default: the profile")
    parser.add_argument("--only", default="", metavar="'03 06'")
    parser.add_argument("--settings", nargs="*", default=[], metavar="NN_title.parameter=value")
    parser.add_argument("--workers", type=count_type, default=2, help="seeds side by side here")
    parser.add_argument("--force", action="store_true", help="run also what is complete")
    parser.add_argument("--dry-run", action="store_true", help="say what would run")
    parser.add_argument("--scheduler", help="a Dask scheduler whose workers share the checkout")
    options = parser.parse_args(argv)
    runs = repo_root() / "runs"
    if len(set(options.seeds)) < len(options.seeds):
        raise WorkbookError(f"SEEDS must differ, got {options.seeds}")
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
    with dask_client(min(options.workers, len(options.seeds)), options.scheduler) as client:
        run_seeds(options.seeds, name, arguments, client)
    folders = {seed: runs / f"{name}-seed{seed}" for seed in options.seeds}
    page = gather(folders, runs / f"{name}-seeds")
    print(f"The tables over seeds are in {page.relative_to(repo_root())}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
