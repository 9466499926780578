"""How many interactions a second are collected with 1 and with 2 workers of this machine.

The workers have started, imported everything and made a few interactions before the clock runs.
Runs with 1 and with 2 alternate, so a load that comes and goes meets both; the whole of `collect`
counts, with packing. Prints medians, ranges, every sample, and the ratios of neighbouring runs.
"""

import os
import tempfile
import time
from pathlib import Path

import numpy as np
from dask.distributed import Client, LocalCluster

from affordlib.interactions.collect import collect
from affordlib.interactions.recipes import Recipe
from affordlib.interactions.schema import collect_chunk
from experiments.speed.keeping import keep

INTERACTIONS = 200
ROUNDS = 4
TARGET = 1.8


def rate(client, recipe):
    """Interactions a second of one collection from nothing."""
    with tempfile.TemporaryDirectory() as folder:
        began = time.perf_counter()
        collect(recipe, Path(folder, "set.zarr.zip"), client, progress=False)
        return recipe.n_interactions / (time.perf_counter() - began)


def client_of(workers):
    loopback = {"host": "127.0.0.1", "dashboard_address": "127.0.0.1:0"}
    cluster = LocalCluster(n_workers=workers, threads_per_worker=1, **loopback)
    client = Client(cluster)
    client.wait_for_workers(workers)
    client.run(collect_chunk, Recipe(n_interactions=5, seed=3), range(5))
    return client


def main():
    recipe = Recipe(seed=7, n_interactions=INTERACTIONS)
    one, two = client_of(1), client_of(2)
    samples = {1: [], 2: []}
    for _ in range(ROUNDS):
        samples[1].append(rate(one, recipe))
        samples[2].append(rate(two, recipe))
    for client in (one, two):
        client.cluster.close()
        client.close()
    load, cores = os.getloadavg()[0], os.cpu_count()
    print(f"{ROUNDS} runs each of {INTERACTIONS} interactions; {cores} cores, load {load:.1f}")
    for workers, found in samples.items():
        each = " ".join(f"{value:.2f}" for value in found)
        print(
            f"{workers} worker(s)   median {np.median(found):6.2f} a second"
            f"   ({min(found):.2f} to {max(found):.2f}; {each})"
        )
    ratios = np.array(samples[2]) / np.array(samples[1])
    print(
        f"ratio         median {np.median(ratios):6.2f}"
        f"   ({ratios.min():.2f} to {ratios.max():.2f}; target {TARGET})"
    )
    rows = [{"workers": n, "per_second_median": np.median(v)} for n, v in samples.items()]
    keep("collect", [row | {"n": ROUNDS * INTERACTIONS} for row in rows])


if __name__ == "__main__":
    main()
