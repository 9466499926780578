"""Tables in Markdown, made from the results, and pages that contain them.

A page contains

    <!-- table: data/results/06_planning.json#planning columns=planner,mean_m±sem_m -->
    <!-- /table -->

and `python -m experiments.tables README.md` fills it; `--check` fails if that would change it.
Options: `columns` (`a±b` shows two columns in one, `a(b..c)` a value and its interval, and
`title:a` gives a column another title);
`by=mode values=mean_m` gives each mode its own column of values; any other, such as
`mode=multi_partial,single_full`, keeps the rows that have these values, in this order.
"""

import argparse
import re
import shlex
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from affordlib.results import (
    cell,
    columns_of,
    heading,
    read_results,
    results_table,
    write_atomically,
)
from experiments.commands import command

MARKUP = str.maketrans({"&": "&amp;", "<": "&lt;", ">": "&gt;", "[": "&#91;", "|": "\\|"})
"""For `str.translate`: escapes characters that are markup in Markdown or HTML."""

COLUMN = re.compile(r"(?:(?P<title>\w+):)?(\w+)(?:±(\w+)|\((\w+)\.\.(\w+)\))?")
SHOWN = {1: "{}", 2: "{} ± {}", 3: "{} ({} to {})"}
"""How the parts of a column are shown, by their number."""

BLOCK = re.compile(
    r"(?P<open>^<!-- table: (?P<what>.*?) -->\n)(?P<body>.*?)(?P<close>^<!-- /table -->$)",
    re.DOTALL | re.MULTILINE,
)


def markdown_table(
    rows: Sequence[Mapping[str, Any]],
    columns: Sequence[str] | None = None,
    by: str | None = None,
    values: Sequence[str] = (),
) -> str:
    """Return rows as a Markdown table with the headings and decimals of `results_table`."""
    columns = columns_of(rows, None) if columns is None else columns
    series, numbers = [], set()
    for column in [*columns, *values]:
        found = COLUMN.fullmatch(column)
        names = [name for name in found.groups()[1:] if name] if found else [column]
        head = heading(names[0].replace("_mean", "") if len(names) > 1 else names[0])
        if found and found["title"]:
            _, comma, unit = head.rpartition(", ")
            head = found["title"].replace("_", " ") + (comma and comma + unit)
        cells = results_table(rows, names).to_numpy()
        texts = [SHOWN[len(names)].format(*c) if c[0] != "–" else "–" for c in cells]
        series.append(pd.Series(texts, name=head, dtype=object))
        types = {type(v) for row in rows if (v := row.get(names[0])) is not None}
        numbers |= {head} if types and types <= {int, float} else set()
    frame = pd.concat(series, axis=1)
    if by is not None:
        heads = list(frame.columns[len(columns) :])
        frame[by] = [cell(by, row.get(by)) for row in rows]
        keys = [*frame.columns[: len(columns)], by]
        wide = frame.set_index(keys)[heads].unstack(by, fill_value="–", sort=False)
        of = {b: f"{by} {b}" if b.isdigit() else b.replace("_", " ") for _, b in wide.columns}
        wide.columns = [f"{of[b]}: {head}" for head, b in wide.columns]
        numbers |= {*wide.columns}
        frame = wide.reset_index()
    lines = ["---:" if name in numbers else "---" for name in frame.columns]
    lines = [list(frame.columns), lines, *frame.to_numpy().tolist()]
    lines = [" | ".join(text.translate(MARKUP) for text in line) for line in lines]
    return "".join(f"| {line} |\n" for line in lines)


def fill_tables(text: str) -> str:
    """Return a Markdown page with each of its table blocks filled from its results file."""

    def fill(block):
        source, *options = shlex.split(block["what"])
        path, _, name = source.partition("#")
        tables = read_results(path)["tables"]
        if name not in tables:
            raise ValueError(f"table: {path} has no table {name!r}, only {', '.join(tables)}")
        rows, shape = tables[name], {}
        for option in options:
            key, _, value = option.partition("=")
            if key in ("columns", "values"):
                shape[key] = value.split(",")
            elif key == "by":
                shape[key] = value
            else:
                columns_of(rows, [key])
                rows = [row for one in value.split(",") for row in rows if str(row.get(key)) == one]
                if not rows:
                    raise ValueError(f"table: no row of {source} has {option}")
        return f"{block['open']}{markdown_table(rows, **shape)}{block['close']}"

    filled, count = BLOCK.subn(fill, text)
    if count != text.count("<!-- table:") or count != text.count("<!-- /table -->"):
        raise ValueError("table: a block is not closed; each ends with the line <!-- /table -->")
    return filled


@command(OSError, ValueError)
def main(argv: Sequence[str] | None = None) -> int:
    """Fill the tables of Markdown pages, or with `--check` print which pages are out of date."""
    parser = argparse.ArgumentParser(prog="python -m experiments.tables", description=main.__doc__)
    parser.add_argument("pages", nargs="+", type=Path)
    parser.add_argument("--check", action="store_true", help="only fail if a page is out of date")
    options = parser.parse_args(argv)
    stale = False
    for page in options.pages:
        text = page.read_text(encoding="utf-8")
        if (filled := fill_tables(text)) == text:
            continue
        if options.check:
            print(f"out of date; run: python -m experiments.tables {page}", file=sys.stderr)
            stale = True
        else:
            write_atomically(page, filled)
    return int(stale)


if __name__ == "__main__":
    sys.exit(main())
