"""Processes that share work: those of a Dask scheduler, or some of this machine."""

import logging
from collections.abc import Iterator
from contextlib import contextmanager

_LOOPBACK = {"host": "127.0.0.1", "dashboard": False, "dashboard_address": "127.0.0.1:0"}


@contextmanager
def dask_client(workers: int = 1, scheduler: str | None = None) -> "Iterator[Client | None]":
    """A client of the scheduler at an address, or else of `workers` new processes of this machine.

    None for one worker, which is this process. The new processes listen on this machine only.
    """
    if scheduler is None and workers == 1:
        yield None
        return
    from dask.distributed import Client, Scheduler, SpecCluster
    from distributed.deploy.subprocess import SubprocessWorker

    if scheduler is not None:
        with Client(scheduler) as client:
            yield client
        return
    quiet = logging.CRITICAL  # what a task raises is raised here as well
    # A worker that finds no scheduler for this long ends: its collector was killed.
    more = {"nthreads": 1, "silence_logs": quiet, "death_timeout": "30 s"}
    options = {"worker_kwargs": _LOOPBACK | more}
    with (
        SpecCluster(
            {k: {"cls": SubprocessWorker, "options": options} for k in range(workers)},
            {"cls": Scheduler, "options": _LOOPBACK | {"port": 0}},
            silence_logs=quiet,
        ) as cluster,
        Client(cluster) as client,
    ):
        yield client
