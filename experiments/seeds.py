"""Combine the results of several runs of the book, which differ in their seed, to one table each.

    python -m experiments.seeds runs/smoke 0 1 2

reads `runs/smoke-seed0/`, …, and writes `runs/smoke-seeds/`: JSON and `index.md`, with the mean of
every number and its standard deviation between seeds (sd) if they differ.
"""

import argparse
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from affordlib import results
from experiments.commands import command
from experiments.runner import plain
from experiments.tables import MARKUP, markdown_table


def over_seeds(tables: Sequence[Sequence[Mapping[str, Any]]]) -> list[dict[str, Any]]:
    """Combine a table of several seeds to one.

    Rows are combined if all their non-numeric values agree, and their order among such rows:
    `seeds` is their number; numbers become means, with standard deviations in columns sd_….
    """
    every = pd.DataFrame([{**row, "seed": k} for k, rows in enumerate(tables) for row in rows])
    if every.empty:
        return []
    numbers = [c for c in every.columns.drop("seed") if every[c].dtype.kind in "iuf"]
    words = [*every.columns.drop(["seed", *numbers])]
    every["place"] = every.groupby(["seed", *words], dropna=False, sort=False).cumcount()
    same = every.groupby([*words, "place"], dropna=False, sort=False)
    columns = {"seeds": ("seed", "size")}
    for c in numbers:
        differs = same[c].nunique().max() > 1
        columns |= {c: (c, "mean"), f"sd_{c}": (c, "std")} if differs else {c: (c, "first")}
    return plain(same.agg(**columns).reset_index().drop(columns="place"))


def gather(folders: Mapping[str, Path], into: Path) -> Path:
    """Write the tables over seeds as JSON and as Markdown, and return the latter's path."""
    page = [f"# Over {len(folders)} seeds", f"Seeds {', '.join(folders)}."]
    page.append("Means over seeds; *sd* is the standard deviation of one seed among them.")
    # Only results of pages; the folders may also contain saved plans.
    paths = [p for folder in folders.values() for p in folder.glob("[0-9A][0-9]_*.json")]
    for name in sorted({path.stem for path in paths}):
        runs = [results.read_results(path)["tables"] for path in paths if path.stem == name]
        together = {}
        page.append(f"## {name}")
        for table in dict.fromkeys(table for run in runs for table in run):
            together[table] = over_seeds([run.get(table, []) for run in runs])
            page.append(f"### {table.replace('_', ' ').translate(MARKUP)}")
            page.append(markdown_table(together[table]) if together[table] else "Empty.")
        results.write_results(into, name, {"seeds": list(folders)}, together)
    results.write_atomically(into / "index.md", "\n\n".join(page) + "\n")
    return into / "index.md"


@command(OSError, ValueError)
def main(argv: Sequence[str] | None = None) -> int:
    """Combine the results of a run's seeds."""
    parser = argparse.ArgumentParser(prog="python -m experiments.seeds", description=main.__doc__)
    parser.add_argument("run", type=Path, help="folders are named RUN-seed0, …")
    parser.add_argument("seeds", nargs="+")
    options = parser.parse_args(argv)
    run = options.run
    folders = {seed: run.with_name(f"{run.name}-seed{seed}") for seed in options.seeds}
    print(f"The tables over seeds are in {gather(folders, run.with_name(f'{run.name}-seeds'))}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
