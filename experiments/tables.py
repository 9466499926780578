"""Tables in Markdown, made from the results, and pages that contain them.

A page contains

    <!-- table: data/results/06_planning.json#planning columns=planner,mode,mean_m -->
    <!-- /table -->

and `python -m experiments.tables README.md` fills it; `--check` fails if that would change it. Any
other option, such as `mode=multi_partial`, keeps the rows that have that value.
"""

import argparse
import re
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from affordlib.commands import command
from affordlib.results import columns_of, read_results, results_table, write_atomically

MARKUP = str.maketrans({"&": "&amp;", "<": "&lt;", ">": "&gt;", "[": "&#91;", "|": "\\|"})
"""For `str.translate`: escapes characters that are markup in Markdown or HTML."""

BLOCK = re.compile(
    r"(?P<open>^<!-- table: (?P<what>.*?) -->\n)(?P<body>.*?)(?P<close>^<!-- /table -->$)",
    re.DOTALL | re.MULTILINE,
)


def markdown_table(rows: Sequence[Mapping[str, Any]], columns: Sequence[str] | None = None) -> str:
    """Return rows as a Markdown table with the headings and decimals of `results_table`."""
    frame, lines = results_table(rows, columns), []
    for name in columns_of(rows, columns):
        values = {type(v) for row in rows if (v := row.get(name)) is not None}
        lines.append("---:" if values and values <= {int, float} else "---")
    lines = [list(frame.columns), lines, *frame.values.tolist()]
    lines = [" | ".join(text.translate(MARKUP) for text in line) for line in lines]
    return "".join(f"| {line} |\n" for line in lines)


def fill_tables(text: str) -> str:
    """Return a Markdown page with each of its table blocks filled from its results file."""

    def fill(block):
        source, *options = block["what"].split()
        path, _, name = source.partition("#")
        tables = read_results(path)["tables"]
        if name not in tables:
            raise ValueError(f"table: {path} has no table {name!r}, only {', '.join(tables)}")
        rows, columns = tables[name], None
        for option in options:
            key, _, value = option.partition("=")
            if key == "columns":
                columns = value.split(",")
            else:
                columns_of(rows, [key])
                rows = [row for row in rows if str(row.get(key)) in value.split(",")]
                if not rows:
                    raise ValueError(f"table: no row of {source} has {option}")
        return f"{block['open']}{markdown_table(rows, columns)}{block['close']}"

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
