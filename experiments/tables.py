"""Tables in Markdown, made from the results, and pages that contain them.

A page contains

    <!-- table: data/results/06_planning.json#planning columns=planner,mean_m±sem_m -->
    <!-- /table -->

and `python -m experiments.tables README.md` fills it; `--check` fails if that would change it.
Options: `columns` (`a±b` shows two columns in one, `a(b..c)` a value and its interval, and
`title:a` gives a column another title); `by=mode values=mean_m` gives each mode its own column of
values; `picture=planning:error,median` adds `figures/results/planning.svg`, which shows the columns
with these headings as dots; any other, such as `mode=multi_partial,single_full`, keeps the rows
that have these values, in this order.
"""

import argparse
import hashlib
import io
import re
import shlex
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd

from affordlib import results
from experiments.commands import command

MARKUP = str.maketrans({"&": "&amp;", "<": "&lt;", ">": "&gt;", "[": "&#91;", "|": "\\|"})
"""For `str.translate`: escapes characters that are markup in Markdown or HTML."""

COLUMN = re.compile(r"(?:(?P<title>\w+):)?(\w+)(?:±(\w+)|\((\w+)\.\.(\w+)\))?")
SHOWN = {1: "{}", 2: "{} ± {}", 3: "{} ({} to {})"}
"""How the parts of a column are shown, by their number."""

PICTURES = "figures/results"
COLORS = ("black", "#888888", "#999933", "#8c6d46")
LOOKS = [{"color": c, "fmt": marker, "ms": 5} for c, marker in zip(COLORS, "osD^", strict=True)]

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
    columns = results.columns_of(rows, None) if columns is None else columns
    series, numbers = [], set()
    for column in [*columns, *values]:
        found = COLUMN.fullmatch(column)
        names = [name for name in found.groups()[1:] if name] if found else [column]
        head = results.heading(names[0].replace("_mean", "") if len(names) > 1 else names[0])
        if found and found["title"]:
            _, comma, unit = head.rpartition(", ")
            head = found["title"].replace("_", " ") + (comma and comma + unit)
        cells = results.results_table(rows, names).to_numpy()
        texts = [SHOWN[len(names)].format(*c) if c[0] != "–" else "–" for c in cells]
        series.append(pd.Series(texts, name=head, dtype=object))
        types = {type(v) for row in rows if (v := row.get(names[0])) is not None}
        numbers |= {head} if types and types <= {int, float} else set()
    frame = pd.concat(series, axis=1)
    if by is not None:
        heads = list(frame.columns[len(columns) :])
        frame[by] = [results.cell(by, row.get(by)) for row in rows]
        keys = [*frame.columns[: len(columns)], by]
        wide = frame.set_index(keys)[heads].unstack(by, fill_value="–", sort=False)
        of = {b: f"{by} {b}" if b.isdigit() else b.replace("_", " ") for _, b in wide.columns}
        wide.columns = [f"{of[b]}: {head}" for head, b in wide.columns]
        numbers |= {*wide.columns}
        frame = wide.reset_index()
    rule = ["---:" if name in numbers else "---" for name in frame.columns]
    lines = [list(frame.columns), rule, *frame.to_numpy().tolist()]
    lines = [" | ".join(text.translate(MARKUP) for text in line) for line in lines]
    return "".join(f"| {line} |\n" for line in lines)


def interval_of(text: str) -> tuple[float, ...]:
    """Return the value of a cell, and the ends of its interval; not a number where it is empty."""
    value, *more = map(float, re.findall(r"-?\d+(?:\.\d+)?", text) or ["nan"])
    if "±" in text:
        more = value - more[0], value + more[0]
    return value, *(more or (value, value))


def dots(table: str, columns: Sequence[str], about: str) -> bytes:
    """Draw columns of a Markdown table as dots with intervals, as SVG.

    columns: their headings without unit; about: the description in the file. A row is named by its
    first columns, as many as tell all rows apart.
    """
    head, _, *rows = ([c.strip(" |") for c in line.split(" | ")] for line in table.splitlines())
    shown = {name.rpartition(", ")[0]: k for k, name in enumerate(head)}
    units = {head[shown[name]].rpartition(", ")[2] for name in columns if name in shown}
    if len(units) != 1 or not shown.keys() >= {*columns}:
        raise ValueError(f"picture: {columns} must be headings of one unit, from {head}")
    names = [[" ".join(row[:k]) for row in rows] for k in range(1, len(head))]
    names = next(some for some in names if len({*some}) == len(rows))
    with plt.rc_context({"svg.hashsalt": "dots", "svg.fonttype": "none"}):
        figure, ax = plt.subplots(figsize=(8, 1.2 + 0.28 * len(rows)), layout="constrained")
        for n, name in enumerate(columns):
            value, low, high = np.array([interval_of(row[shown[name]]) for row in rows]).T
            y = np.arange(len(rows)) + 0.16 * (n - (len(columns) - 1) / 2)
            ax.errorbar(value, y, xerr=(value - low, high - value), **LOOKS[n], label=name)
        ax.set(yticks=range(len(rows)), yticklabels=names, xlabel=f"[{units.pop()}]")
        least, most = ax.dataLim.intervalx
        if "%" not in ax.get_xlabel() and 0 < 20 * least < most:
            ax.set_xscale("log")
            ax.xaxis.set_major_formatter("{x:g}")
        ax.invert_yaxis()
        ax.grid(axis="x", color="#dddddd")
        figure.legend(loc="outside upper center", ncols=len(columns), frameon=False)
        buffer = io.BytesIO()
        figure.savefig(buffer, format="svg", metadata={"Date": None, "Description": about})
    plt.close(figure)
    return buffer.getvalue()


def fill_tables(text: str) -> str:
    """Return a Markdown page with each of its table blocks filled from its results file."""

    def fill(block):
        source, *options = shlex.split(block["what"])
        path, _, name = source.partition("#")
        tables = results.read_results(path)["tables"]
        if name not in tables:
            raise ValueError(f"table: {path} has no table {name!r}, only {', '.join(tables)}")
        rows, shape, link = tables[name], {}, ""
        for option in options:
            key, _, value = option.partition("=")
            if key in ("columns", "values", "by"):
                shape[key] = value if key == "by" else value.split(",")
            elif key == "picture":
                file, _, drawn = value.partition(":")
                alt = ", ".join(drawn.split(",")).replace("_", " ")
                link = f"\n![For each row as a dot: {alt}.]({PICTURES}/{file}.svg)\n"
            else:
                results.columns_of(rows, [key])
                rows = [row for one in value.split(",") for row in rows if str(row.get(key)) == one]
                if not rows:
                    raise ValueError(f"table: no row of {source} has {option}")
        return f"{block['open']}{markdown_table(rows, **shape)}{link}{block['close']}"

    filled, count = BLOCK.subn(fill, text)
    if count != text.count("<!-- table:") or count != text.count("<!-- /table -->"):
        raise ValueError("table: a block is not closed; each ends with the line <!-- /table -->")
    return filled


def stale_pictures(text: str) -> Iterator[tuple[Path, Callable[[], bytes]]]:
    """Yield file and drawing of each picture whose hash is not that of its table on a page."""
    for block in BLOCK.finditer(text):
        table = block["body"].partition("\n\n")[0]
        for name, columns in re.findall(r" picture=([^:]+):(\S+)", block["what"]):
            heads = columns.replace("_", " ").split(",")
            path = results.from_root(f"{PICTURES}/{name}.svg")
            about = hashlib.sha256(f"{table}{heads}".encode()).hexdigest()
            if not path.exists() or about not in path.read_text():
                yield path, partial(dots, table, heads, about)


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
        filled = fill_tables(text)
        pictures = dict(stale_pictures(filled))
        outdated = filled != text or pictures
        if outdated and options.check:
            print(f"out of date; run: python -m experiments.tables {page}", file=sys.stderr)
            stale = True
        elif outdated:
            for path, draw in pictures.items():
                results.write_atomically(path, draw(), b"<?xml")
            results.write_atomically(page, filled)
    return int(stale)


if __name__ == "__main__":
    raise SystemExit(main())
