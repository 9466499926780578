"""`make data`: collect the shipped data sets again and say whether they are the same.

On the machine that made them they agree bit for bit. Elsewhere processors round differently, and
contact magnifies that: now and then an object tips over the other way. So single pushes may differ,
and the sets agree when the median difference of the final positions is within `TOLERANCE_M`.
"""

from __future__ import annotations

import argparse
import os
import sys

import numpy as np
import xarray as xr

from affordlib.commands import command, count_type
from affordlib.interactions.collect import collect
from affordlib.interactions.recipes import RECIPES, SHIPPED
from affordlib.interactions.store import SUFFIX, dataset_sha256, open_interactions
from affordlib.paths import repo_root
from affordlib.workers import dask_client

TOLERANCE_M = 0.00005
"""Median distance between the final positions of two collections that still are the same set.

With NumPy's vector instructions turned off, as on another processor, 150 pushes ended 0.0005 mm
from where they had in the median, and 0.05 mm at most.
"""


def compare(old: xr.Dataset, new: xr.Dataset) -> tuple[bool, str]:
    """Whether two collections of a recipe agree, and a sentence on how well."""
    if dataset_sha256(old) == dataset_sha256(new):
        return True, "the same, bit for bit"
    before, after = (data["rest_effect"].values[:, :2] for data in (old, new))
    if before.shape != after.shape:
        return False, f"not the same: {len(after)} interactions, formerly {len(before)}"
    gap_m = np.linalg.norm(before - after, axis=1)
    median_m = float(np.median(gap_m))
    agree = median_m <= TOLERANCE_M
    return agree, (
        f"{'the same within the tolerance' if agree else 'NOT the same'}: final positions differ "
        f"by {median_m * 1000:.3f} mm in the median (tolerance {TOLERANCE_M * 1000:g} mm) and by "
        f"at most {gap_m.max() * 1000:.3f} mm"
    )


@command(OSError, ValueError, RuntimeError)
def main(argv: list[str] | None = None) -> int:
    """Collect what `--only` names (default: what is shipped) into `--to` (default: data/).

    Returns 1 if a set and its predecessor differ by more than the tolerance, otherwise 0.
    """
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", nargs="+", choices=sorted(RECIPES), default=list(SHIPPED))
    parser.add_argument("--to", default=str(repo_root() / "data"), help="a folder")
    where = parser.add_mutually_exclusive_group()
    where.add_argument(
        "--workers", type=count_type, default=os.cpu_count() or 1, help="processes here"
    )
    where.add_argument("--scheduler", help="a Dask scheduler: tcp://…")
    arguments = parser.parse_args(argv)
    agree = True
    with dask_client(arguments.workers, arguments.scheduler) as client:
        for name in arguments.only:
            try:
                old = open_interactions(name)
            except (FileNotFoundError, ValueError) as error:
                old = None
                print(f"{name}: no former data set to compare with ({error})")
            target = f"{arguments.to}/{name}{SUFFIX}"
            path = collect(RECIPES[name], target, client, replace=True)
            new = open_interactions(path)
            print(f"{name}: {new.sizes['interaction']} interactions, sha256 {dataset_sha256(new)}")
            if old is not None:
                same, sentence = compare(old, new)
                print(f"{name}: {sentence}")
                agree &= same
    return 0 if agree else 1


if __name__ == "__main__":
    sys.exit(main())
