"""Where measured times go: `data/results/speed.json`, a table a benchmark, drawn in the README."""

from __future__ import annotations

import os
import sys
from typing import Any

from affordlib.paths import repo_root
from affordlib.results import read_results, write_results

FOLDER, NAME = "data/results", "speed"


def keep(table: str, rows: list[dict[str, Any]]) -> None:
    """Put a benchmark's rows beside those of the others, if the command says `--keep`."""
    if "--keep" not in sys.argv:
        return
    tables: dict[str, Any] = {}
    if (repo_root() / FOLDER / f"{NAME}.json").is_file():
        tables = read_results(f"{FOLDER}/{NAME}.json")["tables"]
    row = {"load": os.getloadavg()[0], "cores": os.cpu_count()}
    tables |= {table: rows, f"{table}_machine": [row]}
    print(write_results(FOLDER, NAME, {}, dict(sorted(tables.items()))))
