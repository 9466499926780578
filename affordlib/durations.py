"""How long a batch will take: what each notebook took before, here or where the book was made."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterable, Mapping
from pathlib import Path

import yaml

from affordlib.paths import repo_root
from affordlib.results import write_text_atomically

MEASURED = "minutes.yaml"
"""In the folder of the notebooks: {profile: {notebook: minutes}}, measured on two cores."""


def recorded_minutes(folder: Path) -> dict[str, float]:
    """Minutes that the notebooks of a run took, from its records."""
    minutes = {}
    for path in sorted((folder / ".complete").glob("*.json")):
        try:
            minutes[path.stem] = float(json.loads(path.read_text(encoding="utf-8"))["seconds"]) / 60
        except (ValueError, KeyError, TypeError):
            continue  # a record from before durations were kept
    return minutes


def expected_minutes(notebooks: Path, profile: str | None, folder: Path) -> dict[str, float]:
    """Minutes by notebook: as last recorded in the run's folder, else as measured for a profile."""
    path = notebooks / MEASURED
    measured = yaml.safe_load(path.read_text(encoding="utf-8")) if path.is_file() else {}
    return {**(measured or {}).get(profile, {}), **recorded_minutes(folder)}


def minutes_in_words(names: Iterable[str], minutes: Mapping[str, float]) -> str:
    """How long these notebooks will take together, as far as is known; empty if nothing is."""
    names = list(names)
    known = [minutes[name] for name in names if name in minutes]
    if not known:
        return ""
    more = len(names) - len(known)
    others = f", and {more} more of unknown length" if more else ""
    return f"about {max(1, round(sum(known)))} min{others}"


def main(argv: list[str] | None = None) -> int:
    """Keep the minutes that the runs `runs/<profile>` took in notebooks/minutes.yaml."""
    parser = argparse.ArgumentParser(prog="python -m affordlib.durations", description=main.__doc__)
    parser.add_argument("profiles", nargs="+")
    path = repo_root() / "notebooks" / MEASURED
    kept = yaml.safe_load(path.read_text(encoding="utf-8")) if path.is_file() else {}
    for profile in parser.parse_args(argv).profiles:
        minutes = recorded_minutes(repo_root() / "runs" / profile)
        kept[profile] = kept.get(profile, {}) | {k: round(v, 1) for k, v in minutes.items()}
    head = "# What each notebook takes, in minutes on two cores; written by affordlib.durations.\n"
    write_text_atomically(path, head + yaml.safe_dump(kept, sort_keys=True))
    return 0


if __name__ == "__main__":
    sys.exit(main())
