"""Work in several processes of this machine, or wherever joblib is told to."""

import os
import signal
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing, nullcontext
from functools import partial
from typing import Any

from joblib import Parallel, delayed, parallel_config

MOST_WORKERS = 256


def spread(
    function: Callable[[Any], Any], tasks: Mapping[str, Any], workers: int = 1
) -> Iterator[tuple[str, Any]]:
    """Yield the name of each task and function(task) as soon as it is computed.

    In this process for one worker, unless joblib.parallel_config says otherwise; else in new
    processes, which end with this one. Raises RuntimeError that names a task that fails, or those
    that were running when a process died.
    """
    running = []

    def calls():
        for name, task in tasks.items():
            running.append(name)
            yield delayed(_attempt)(function, name, task)

    start = partial(_end_with, os.getpid())
    new = parallel_config("loky", inner_max_num_threads=1, initializer=start)
    with new if workers > 1 else nullcontext():
        parallel = Parallel(
            max(1, min(workers, len(tasks))) if workers > 1 else None,
            return_as="generator_unordered",
            batch_size=1,
            pre_dispatch="n_jobs",
        )
    with closing(parallel(calls())) as results:
        try:
            for name, result, error in results:
                running.remove(name)
                if error is not None:
                    break
                yield name, result
            else:
                return
        except Exception as lost:
            name, error = " or ".join(running), lost
    raise RuntimeError(f"{name} failed: {type(error).__name__}: {error}") from error


def _attempt(
    function: Callable[[Any], Any], name: str, task: Any
) -> tuple[str, Any, Exception | None]:
    try:
        return name, function(task), None
    except Exception as error:
        return name, None, error


def _end_with(parent: int) -> None:
    """Leave Ctrl-C to the parent process, and end this one within a second of its end."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)

    def watch():
        while os.getppid() == parent:
            time.sleep(0.5)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
