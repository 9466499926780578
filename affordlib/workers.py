"""Worker processes: those of a Dask scheduler, or new ones on this machine."""

import logging
from collections.abc import Iterator
from contextlib import contextmanager

_LOOPBACK = {"host": "127.0.0.1", "dashboard": False, "dashboard_address": "127.0.0.1:0"}


@contextmanager
def dask_client(workers: int = 1, scheduler: str | None = None) -> "Iterator[Client | None]":
    """Connect to the Dask scheduler at an address, or start `workers` processes on this machine.

    Yields the client, or None for one worker (this process). New processes listen on this machine.
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
    quiet = logging.CRITICAL  # a task's exception is raised in this process as well
    # A worker ends if it cannot reach its scheduler for this long, as after a kill.
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
