"""What differs between seeds, drawn: a dot for every seed, a line at their mean."""

from __future__ import annotations

import io
import statistics
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from affordlib.results import factor, heading

Row = Mapping[str, Any]

PANELS = 4
"""Columns of numbers that are drawn at most."""

LABEL = 48


def is_number(value: object) -> bool:
    """Whether a value is a number, and no truth value."""
    return isinstance(value, int | float) and not isinstance(value, bool)


def same_rows(tables: Sequence[Sequence[Row]]) -> list[list[Row]]:
    """The rows of several seeds' tables that are the same: in words, and in place among those.

    Nothing (None) is no word: where one seed has no number, others may.
    """
    same: dict[tuple, list[Row]] = {}
    for rows in tables:
        seen: Counter = Counter()
        for row in rows:
            words = tuple((k, v) for k, v in row.items() if v is not None and not is_number(v))
            seen[words] += 1
            same.setdefault((words, seen[words]), []).append(row)
    return list(same.values())


def seeds_picture(tables: Sequence[Sequence[Row]]) -> bytes | None:
    """The first columns that differ between seeds, as a PNG; None where none does.

    A panel is a column, a line of it a row of the table, named by the words that tell it from the
    others.
    """
    rows = [same for same in same_rows(tables) if len(same) > 1]
    columns = dict.fromkeys(key for same in rows for key in same[0])
    differ = [key for key in columns if any(_differ(same, key) for same in rows)][:PANELS]
    if not differ:
        return None
    names = _names(rows)
    size = (2.6 * len(differ) + 3.4, 0.28 * len(rows) + 1.1)
    figure = Figure(figsize=size, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(1, len(differ), sharey=True, squeeze=False)[0]
    for ax, key in zip(axes, differ, strict=True):
        for at, same in enumerate(rows):
            values = [factor(key) * row[key] for row in same if is_number(row.get(key))]
            if values:
                ax.plot(values, [at] * len(values), "o", color="gray", ms=4, alpha=0.7)
                ax.plot(statistics.fmean(values), at, "|", color="black", ms=12)
        ax.set_xlabel(heading(key))
        ax.set_yticks(range(len(rows)), names)
        ax.grid(alpha=0.3)
    axes[0].set_ylim(len(rows) - 0.5, -0.5)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=90)
    return buffer.getvalue()


def _differ(same: Sequence[Row], key: str) -> bool:
    values = [row.get(key) for row in same]
    return all(map(is_number, values)) and len(set(values)) > 1


def _names(rows: Sequence[Sequence[Row]]) -> list[str]:
    """What tells the rows apart: their words, column by column as long as one tells more apart."""
    names = [""] * len(rows)
    for key in dict.fromkeys(key for same in rows for key in same[0]):
        if any(is_number(same[0].get(key)) for same in rows):
            continue
        told = [str(same[0].get(key, "")) for same in rows]
        further = [", ".join(filter(None, both)) for both in zip(names, told, strict=True)]
        if len(set(further)) > len(set(names)):
            names = further
    return [name if len(name) <= LABEL else f"{name[: LABEL - 1]}…" for name in names]
