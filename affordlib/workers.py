"""Tasks in worker processes, which never outlive the process that started them.

A worker imports this module first, so it imports little: from then on it ends with its parent.
"""

import os
import signal
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing, nullcontext
from functools import partial
from typing import Any

from joblib.parallel import Parallel, delayed, mp, parallel_config


def spread(
    function: Callable[[Any], Any], tasks: Mapping[str, Any], workers: int = 1
) -> Iterator[tuple[str, Any]]:
    """Yield the name of each task and function(task) as soon as it is computed.

    In this process for one worker, unless joblib.parallel_config says otherwise; else in new
    processes, which end with this one. Raises RuntimeError that names a task that fails.
    """
    own = {"inner_max_num_threads": 1, "initializer": partial(_end_with, os.getpid())}
    many = workers > 1 and mp is not None  # joblib warns where /dev/shm allows no processes
    with parallel_config("loky", **own) if many else nullcontext():
        n_jobs = max(1, min(workers, len(tasks))) if many else None
        parallel = Parallel(
            n_jobs, return_as="generator_unordered", batch_size=1, pre_dispatch="n_jobs"
        )
    calls = (delayed(_named)(function, name, task) for name, task in tasks.items())
    with closing(parallel(calls)) as results:
        yield from results


def _named(function: Callable[[Any], Any], name: str, task: Any) -> tuple[str, Any]:
    try:
        return name, function(task)
    except Exception as error:
        raise RuntimeError(f"{name} failed: {type(error).__name__}: {error}") from error


def _end_with(parent: int) -> None:
    """Leave Ctrl-C to the parent process, and end this one within a second of its end."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)

    def watch():
        while os.getppid() == parent:
            time.sleep(0.5)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
