"""`make data`: collect the shipped data sets again and say whether they are the same.

On the machine that made them they agree bit for bit; elsewhere processors round differently, and
the largest difference is printed.
"""

from __future__ import annotations

import argparse
import os
import sys

import numpy as np
import xarray as xr

from affordlib.interactions.collect import collect
from affordlib.interactions.recipes import RECIPES
from affordlib.interactions.store import SUFFIX, dataset_sha256, open_interactions
from affordlib.paths import repo_root


def compare(old: xr.Dataset, new: xr.Dataset) -> str:
    """One sentence on whether two collections of a recipe are the same."""
    if dataset_sha256(old) == dataset_sha256(new):
        return "the same, bit for bit"
    gap = np.abs(old["rest_effect"].values[:, :2] - new["rest_effect"].values[:, :2]).max()
    return f"not the same: final positions differ by at most {gap * 1000:.3f} mm"


def main() -> int:
    """Collect what `--only` names (default: all) into `--to` (default: data/)."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", nargs="*", choices=sorted(RECIPES), default=sorted(RECIPES))
    parser.add_argument("--to", default=str(repo_root() / "data"))
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    arguments = parser.parse_args()
    for name in arguments.only:
        try:
            old = open_interactions(name)
        except (FileNotFoundError, ValueError) as error:
            old = None
            print(f"{name}: no former data set to compare with ({error})")
        path = collect(RECIPES[name], f"{arguments.to}/{name}{SUFFIX}", workers=arguments.workers)
        new = open_interactions(path)
        print(f"{name}: {new.sizes['interaction']} interactions, sha256 {dataset_sha256(new)}")
        if old is not None:
            print(f"{name}: {compare(old, new)}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
