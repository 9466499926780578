"""Exercises of appendix A5: variables of a data set, and files with the same data."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from affordlib.interactions import open_interactions
from affordlib.interactions.store import write_interactions
from exercises.checking import Exercise, answered


def _wrong_pairs(same: Callable[..., Any]) -> float:
    """How many of three pairs are judged wrongly: one file, other compression, other data."""
    data = open_interactions("grasp").isel(interaction=slice(3))
    with TemporaryDirectory() as folder:
        file, light, other = (Path(folder) / f"{name}.zarr.zip" for name in ("a", "b", "c"))
        write_interactions(data, file)
        write_interactions(data, light, level=1)
        write_interactions(data.assign(mass=2 * data["mass"]), other)
        judged = [bool(answered(same, file, path)) for path in (file, light, other)]
    return sum(a != b for a, b in zip(judged, (True, True, False), strict=True))


STORAGE: dict[str, Exercise] = {
    "A5.1": Exercise(
        "Compute the median phase at which a push has moved its object by 1 mm.",
        lambda mine: mine,
        expected=0.58,
        within=0.002,
        unit="of the full action",
    ),
    "A5.2": Exercise(
        "Write same(path, other): whether two files contain the same data.",
        _wrong_pairs,
        expected=0.0,
        within=0.0,
        unit="pairs judged wrongly",
    ),
}
