"""Studies in addition to the cross-validation: ablations, representations, uncertainty, limits.

    python -m experiments.studies --only study=latent,ablation

computes missing or stale results in `data/results/raw/studies.jsonl.gz`. The tables are written by
`experiments.effect_prediction`.
"""

from __future__ import annotations

import importlib
import inspect
import sys
from collections.abc import Sequence
from pathlib import Path

from experiments import runner
from experiments.commands import command
from experiments.runner import FOLDER, STUDIES, Job, Rows, read

NAME = "studies"
MODULES = ("ablation", "representation", "uncertainty", "limits", "literal", "novelty")
for module in MODULES:
    importlib.import_module(f"experiments.{module}")


def job(study: str) -> Job:
    """Return the job that makes the rows of a study."""
    return Job(make_rows, {"study": study}, **STUDIES[study][1])


def make_rows(study: str, resume_checkpoint: Path) -> Rows:
    """Make the rows of a study."""
    rows, _ = STUDIES[study]
    return rows(resume_checkpoint) if inspect.signature(rows).parameters else rows()


def tables(table: str, folder: str | Path = FOLDER) -> dict[str, Rows]:
    """Return the rows of the studies that belong to a table; raises ValueError for stale ones."""
    made = {arguments["study"]: rows for arguments, rows in read(NAME, job, folder)}
    here = [name for name in STUDIES if (name == "tuning") == (table == "lever_up")]
    return {name: made[name] for name in here if name in made}


@command(OSError, ValueError)
def main(argv: Sequence[str] | None = None) -> int:
    """Run missing or stale studies."""
    options = runner.parser(NAME, main.__doc__).parse_args(argv)
    return runner.make([job(name) for name in STUDIES], NAME, options)


if __name__ == "__main__":
    sys.exit(main())
