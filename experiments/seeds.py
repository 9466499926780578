"""Run the notebooks for several seeds in parallel, and make tables over seeds.

    python -m experiments.seeds 0 1 2 --profile smoke --only 06 --workers 2

Every seed is a run of `affordlib.workbook` into `runs/<name>-seed<k>`. The tables over seeds are
written to `runs/<name>-seeds/`, as JSON and as `index.md` with plots of differing columns: the mean
of every number, and its standard deviation between seeds (sd) if they differ.
"""

from __future__ import annotations

import argparse
import io
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd
from matplotlib.figure import Figure

from affordlib import results
from affordlib.commands import command, count_type, seed_type
from affordlib.paths import repo_root
from affordlib.workbook import WorkbookError, run_name
from affordlib.workers import dask_client
from experiments.runner import plain
from experiments.tables import MARKUP, markdown_table

PANELS = 4
"""Largest number of plotted columns."""

Table = Sequence[Mapping[str, Any]]


def run_all(
    commands: Mapping[int, Sequence[str]], client: dask.distributed.Client | None = None
) -> None:
    """Run the command of each seed, in sequence or with a Dask client, and print its output.

    Raises WorkbookError, after all have ended, with the output of those that failed.
    """
    lines, failed = list(commands.values()), []
    # Not pure, because a batch must run again; it skips complete notebooks itself.
    some = client.map(_run, lines, pure=False) if client else []
    done = (future.result() for future in some) if client else map(_run, lines)
    for seed, (code, printed) in zip(commands, done, strict=True):
        print(f"seed {seed}: {'failed' if code else printed.strip() or 'done'}", flush=True)
        failed += [f"seed {seed}:\n{printed.strip()}"] * bool(code)
    if failed:
        raise WorkbookError("\n".join(failed))


def _run(line: Sequence[str]) -> tuple[int, str]:
    done = subprocess.run(line, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    return done.returncode, done.stdout


def over_seeds(tables: Sequence[Table]) -> tuple[list[dict[str, Any]], bytes | None]:
    """Combine a table of several seeds to one, and plot the columns that differ (PNG).

    Rows are combined if all their non-numeric values agree, and their order among such rows:
    `seeds` is their number; numbers become means, with standard deviations in columns sd_….
    """
    every = pd.DataFrame([{**row, "seed": k} for k, rows in enumerate(tables) for row in rows])
    if every.empty:
        return [], None
    numbers = [c for c in every.columns.drop("seed") if every[c].dtype.kind in "iuf"]
    words = [*every.columns.drop(["seed", *numbers])]
    every["place"] = every.groupby(["seed", *words], dropna=False, sort=False).cumcount()
    same = every.groupby([*words, "place"], dropna=False, sort=False)
    differ = [c for c in numbers if same[c].nunique().max() > 1]
    columns = {"seeds": ("seed", "size")}
    for c in numbers:
        columns |= {c: (c, "mean"), f"sd_{c}": (c, "std")} if c in differ else {c: (c, "first")}
    table = same.agg(**columns).reset_index().drop(columns="place")
    return plain(table), _picture(every.assign(row=same.ngroup()), words, differ[:PANELS])


def _picture(every: pd.DataFrame, words: list[str], columns: list[str]) -> bytes | None:
    """Plot a dot per seed and a bar for the mean; return None if no columns differ."""
    if not columns:
        return None
    names = every.drop_duplicates("row").sort_values("row")[words].astype(str)
    size = 2.6 * len(columns) + 3.4, 0.28 * len(names) + 1.1
    figure = Figure(figsize=size, layout="constrained")
    axes = figure.subplots(1, len(columns), sharey=True, squeeze=False)[0]
    axes[0].set_yticks(range(len(names)), [text[:48] for text in names.agg(", ".join, axis=1)])
    for ax, name in zip(axes, columns, strict=True):
        numbers = results.factor(name) * every.set_index("row")[name]
        means = numbers.groupby("row").mean()
        ax.plot(numbers, numbers.index, "o", color="gray", ms=4, alpha=0.7)
        ax.plot(means, means.index, "|", color="black", ms=12)
        ax.set_xlabel(results.heading(name))
        ax.grid(alpha=0.3)
    axes[0].invert_yaxis()
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=90)
    return buffer.getvalue()


def gather(folders: Mapping[int, Path], into: Path) -> Path:
    """Write the tables over seeds as JSON and as Markdown with plots; return the latter's path."""
    into.mkdir(parents=True, exist_ok=True)
    page = [f"# Over {len(folders)} seeds", f"Seeds {', '.join(map(str, folders))}."]
    page.append("Means over seeds; *sd* is the standard deviation of one seed among them.")
    # Only results of notebooks; the folders may also contain saved plans.
    paths = [path for folder in folders.values() for path in folder.glob("[0-9][0-9]_*.json")]
    for name in sorted({path.stem for path in paths}):
        runs = [results.read_results(path)["tables"] for path in paths if path.stem == name]
        together = {}
        page.append(f"## {name}")
        for number, table in enumerate(dict.fromkeys(table for run in runs for table in run)):
            together[table], picture = over_seeds([run.get(table, []) for run in runs])
            page.append(f"### {table.replace('_', ' ').translate(MARKUP)}")
            page.append(markdown_table(together[table]) if together[table] else "Empty.")
            if picture:
                results.write_atomically(into / f"{name}-{number}.png", picture)
                page.append(f"![each seed]({name}-{number}.png)")
        results.write_results(into, name, {"seeds": list(folders)}, together)
    results.write_atomically(into / "index.md", "\n\n".join(page) + "\n")
    return into / "index.md"


@command(OSError, ValueError, WorkbookError)
def main(argv: Sequence[str] | None = None) -> int:
    """Run the notebooks for several seeds and combine their results."""
    parser = argparse.ArgumentParser(prog="python -m experiments.seeds", description=main.__doc__)
    parser.add_argument("seeds", type=seed_type, nargs="+")
    parser.add_argument("--profile", default="reader")
    parser.add_argument("--out", default="", metavar="NAME", help="default: the profile")
    parser.add_argument("--only", default="", metavar="'03 06'")
    parser.add_argument("--settings", nargs="*", default=[], metavar="NN_title.parameter=value")
    parser.add_argument("--workers", type=count_type, default=2, help="seeds run in parallel here")
    parser.add_argument("--force", action="store_true", help="also run complete notebooks")
    parser.add_argument("--dry-run", action="store_true", help="only print what would be run")
    parser.add_argument("--scheduler", help="a Dask scheduler whose workers share the checkout")
    options = parser.parse_args(argv)
    if len(set(options.seeds)) < len(options.seeds):
        raise WorkbookError(f"SEEDS must differ, got {options.seeds}")
    runs, name = repo_root() / "runs", run_name(options.profile, 0, options.out)
    folders = {seed: runs / f"{name}-seed{seed}" for seed in options.seeds}
    book = [sys.executable, "-m", "affordlib.workbook", "--profile", options.profile]
    book += ["--only", options.only, *["--force"] * options.force]
    book += ["--dry-run"] * options.dry_run
    ends = {seed: ["--seed", str(seed), "--out", folder.name] for seed, folder in folders.items()}
    commands = {seed: [*book, *end, "--", *options.settings] for seed, end in ends.items()}
    workers = 1 if options.dry_run else min(options.workers, len(folders))
    with dask_client(workers, options.scheduler) as client:
        run_all(commands, client)
    if not options.dry_run:
        print(f"The tables over seeds are in {gather(folders, runs / f'{name}-seeds')}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
