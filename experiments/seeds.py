"""The notebooks for several seeds, side by side, and what they say together: tables over seeds.

    python -m experiments.seeds 0 1 2 --profile smoke --only 06 --workers 2

Every seed is a run of `affordlib.workbook` into `runs/<name>-seed<k>`. In `runs/<name>-seeds/`
stand the tables over seeds, as JSON and, with a picture of what differs, in `index.md`: the mean of
every number, and its standard deviation between seeds (sd) where they differ.
"""

from __future__ import annotations

import argparse
import io
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pandas as pd
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from affordlib.commands import command, count_type, seed_type
from affordlib.paths import repo_root
from affordlib.results import (
    MARKUP,
    factor,
    heading,
    markdown_table,
    read_results,
    write_atomically,
    write_results,
    write_text_atomically,
)
from affordlib.workbook import WorkbookError, run_name
from affordlib.workers import dask_client

if TYPE_CHECKING:
    from dask.distributed import Client

PANELS = 4
"""Columns that are drawn at most."""


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

    Raises WorkbookError, after all have ended, with what the failed ones printed.
    """
    batches = [
        (seed, command(["--seed", str(seed), "--out", f"{name}-seed{seed}", *arguments]))
        for seed in seeds
    ]
    if client is None:
        done = map(_run, batches)
    else:
        from dask.distributed import as_completed

        # A batch skips by itself what is complete: it is given out even if it was run before.
        futures = client.map(_run, batches, pure=False)
        done = (result for _, result in as_completed(futures, with_results=True))
    failed = []
    for seed, code, printed, minutes in done:
        print(f"seed {seed}: {'failed' if code else 'done'} after {minutes:.1f} min", flush=True)
        if code:
            failed.append(f"seed {seed}:\n{printed.strip()}")
    if failed:
        raise WorkbookError("\n".join(sorted(failed)))


def _run(batch: tuple[int, Sequence[str]]) -> tuple[int, int, str, float]:
    seed, command = batch
    began = time.monotonic()
    done = subprocess.run(
        command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, check=False
    )
    return seed, done.returncode, done.stdout, (time.monotonic() - began) / 60


def _stacked(tables: Sequence[Sequence[Mapping[str, Any]]]) -> tuple[pd.DataFrame, list[str]]:
    """The rows of all seeds with the columns `seed` and `row`, and which columns hold numbers.

    Rows with the same `row` agree in all that is no number, and in their place among such rows.
    """
    every = pd.DataFrame([{**row, "seed": k} for k, rows in enumerate(tables) for row in rows])
    own = every.columns.drop("seed")
    numbers = [name for name in own if every[name].dtype.kind in "iuf"]
    words = [name for name in own if name not in numbers]
    every["place"] = every.groupby(["seed", *words], dropna=False, sort=False).cumcount()
    every["row"] = every.groupby([*words, "place"], dropna=False, sort=False).ngroup()
    return every.drop(columns="place"), numbers


def over_seeds(tables: Sequence[Sequence[Mapping[str, Any]]]) -> list[dict[str, Any]]:
    """One table of the same table of several seeds: means, and sd where seeds differ.

    A number that some seeds do not have is averaged over those that do.
    """
    if not any(tables):
        return []
    every, numbers = _stacked(tables)
    rows = []
    for _, same in every.groupby("row", sort=False):
        row: dict[str, Any] = {"seeds": len(same)}
        for name in every.columns.drop(["seed", "row"]):
            values = same[name].dropna()
            row[name] = values.iloc[0] if len(values) else None
            if name in numbers and values.nunique() > 1:
                row |= {name: values.mean(), f"sd_{name}": values.std()}
        rows.append(row)
    return rows


def seeds_picture(tables: Sequence[Sequence[Mapping[str, Any]]]) -> bytes | None:
    """The first columns that differ between seeds, a dot for every seed, as a PNG; None if none."""
    if not any(tables):
        return None
    every, numbers = _stacked(tables)
    spread = every.groupby("row")[numbers].nunique().max()
    differ = list(spread.index[spread > 1][:PANELS])
    if not differ:
        return None
    words = every.columns.drop([*numbers, "seed", "row"])
    names = (
        every.drop_duplicates("row").sort_values("row")[words].astype(str).agg(", ".join, axis=1)
    )
    figure = Figure(
        figsize=(2.6 * len(differ) + 3.4, 0.28 * len(names) + 1.1), layout="constrained"
    )
    FigureCanvasAgg(figure)
    axes = figure.subplots(1, len(differ), sharey=True, squeeze=False)[0]
    for ax, name in zip(axes, differ, strict=True):
        ax.plot(factor(name) * every[name], every["row"], "o", color="gray", ms=4, alpha=0.7)
        means = factor(name) * every.groupby("row")[name].mean()
        ax.plot(means, means.index, "|", color="black", ms=12)
        ax.set_xlabel(heading(name))
        ax.set_yticks(range(len(names)), [text[:48] for text in names])
        ax.grid(alpha=0.3)
    axes[0].invert_yaxis()
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=90)
    return buffer.getvalue()


def gather(folders: Mapping[int, Path], into: Path) -> Path:
    """Write the tables over seeds, as JSON, and as Markdown with pictures; returns the latter."""
    # Only results of notebooks: beside them lie plans that were saved.
    there = [path for folder in folders.values() for path in folder.glob("[0-9][0-9]_*.json")]
    page = [f"# Over {len(folders)} seeds", f"Seeds {', '.join(map(str, folders))}."]
    page.append("Means over seeds; *sd* is the standard deviation of one seed among them.")
    for name in sorted({path.stem for path in there}):
        documents = [read_results(path)["tables"] for path in there if path.stem == name]
        by_table = {
            table: [tables.get(table, []) for tables in documents]
            for table in dict.fromkeys(table for tables in documents for table in tables)
        }
        together = {table: over_seeds(tables) for table, tables in by_table.items()}
        write_results(into, name, {"seeds": list(folders)}, together)
        page.append(f"## {name}")
        for number, (table, rows) in enumerate(together.items()):
            page.append(f"### {table.replace('_', ' ').translate(MARKUP)}")
            page.append(markdown_table(rows) if rows else "Empty.")
            if (picture := seeds_picture(by_table[table])) is not None:
                write_atomically(into / f"{name}-{number}.png", picture)
                page.append(f"![each seed]({name}-{number}.png)")
    path = into / "index.md"
    write_text_atomically(path, "\n\n".join(page) + "\n")
    return path


@command(OSError, ValueError, WorkbookError)
def main(argv: Sequence[str] | None = None) -> int:
    """Run the notebooks for several seeds and gather what they wrote."""
    parser = argparse.ArgumentParser(prog="python -m experiments.seeds", description=main.__doc__)
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
    if len(set(options.seeds)) < len(options.seeds):
        raise WorkbookError(f"SEEDS must differ, got {options.seeds}")
    name = run_name(options.profile, 0, options.out)
    arguments = ["--profile", options.profile, "--only", options.only]
    arguments += ["--force"] * options.force + ["--", *options.settings]
    # What would run is said in any case; it is also where wrong settings are refused.
    for seed in options.seeds:
        own = ["--seed", str(seed), "--out", f"{name}-seed{seed}", "--dry-run"]
        _, code, printed, _ = _run((seed, command_of(own + arguments)))
        if code:
            raise WorkbookError(printed.strip())
        print(f"seed {seed}: {printed.strip()}", flush=True)
    if options.dry_run:
        return 0
    with dask_client(min(options.workers, len(options.seeds)), options.scheduler) as client:
        run_seeds(options.seeds, name, arguments, client)
    runs = repo_root() / "runs"
    page = gather(
        {seed: runs / f"{name}-seed{seed}" for seed in options.seeds}, runs / f"{name}-seeds"
    )
    print(f"The tables over seeds are in {page.relative_to(repo_root())}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
