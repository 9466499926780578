"""One way to run experiments: jobs whose results are kept, resumed, and refused when stale.

A job is a call of a function. Its result, plain values, is a line of
`data/results/raw/<table>.jsonl.gz`, beside its arguments and what else decides it. What is there is
not made again, what was made of something else is refused; a kill costs the jobs under way and half
a minute. Equal results give equal bytes.

    def job(model: str, fold: int) -> Job:
        return Job(cross_validate, {"model": model, "fold": fold}, data=("push",), version=2)

    run([job("film", fold) for fold in range(10)], "effect_prediction")
    results = read("effect_prediction", job)
"""

from __future__ import annotations

import argparse
import gzip
import hashlib
import inspect
import json
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, fields, is_dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from filelock import FileLock
from scipy.stats import bootstrap
from tqdm.auto import tqdm

from affordlib.commands import count_type
from affordlib.interactions import open_interactions
from affordlib.interactions.store import stored_sha256
from affordlib.models.checkpoint import NOVELTY, read_weights, resolve_checkpoint, weights_sha256
from affordlib.paths import repo_root, resolve_out_dir
from affordlib.planning.reachability import SHIPPED as REACHABILITY
from affordlib.results import write_atomically, write_results
from affordlib.workers import dask_client

FOLDER = "data/results/raw"
WRITE_EVERY_S = 30
NOT_DECISIVE = ("device", "max_minutes", "sigma_scale")
"""Options of trainings and networks that belong to the machine, or are fitted afterwards."""


@lru_cache(maxsize=4)
def open_once(name: str) -> xarray.Dataset:
    """A data set by its name, kept open from job to job; workers import it by its own name."""
    return open_interactions(name)


Rows = list[dict[str, Any]]
Result = tuple[dict[str, Any], Any]
"""The arguments of a job, and what its function returned."""


@dataclass(frozen=True)
class Job:
    """A call of a function of a module, and what decides its result beside the arguments.

    function: returns plain values. If it has an argument `resume_checkpoint`, it gets a path there,
    which it may write while it works and from which it resumes after a kill.
    settings: what is decided elsewhere: plain values, dataclasses and functions, nested; names of
    fields do not count. data, checkpoints: names of what is read. version: raise it when the code
    changes a result and nothing else tells so.
    """

    function: Callable[..., Any]
    arguments: dict[str, Any]
    settings: Any = ()
    data: tuple[str, ...] = ()
    checkpoints: tuple[str, ...] = ()
    version: int = 1

    def made_of(self) -> dict[str, Any]:
        """What decides the result; the hash of a data set that is not here is None."""
        return {
            "version": self.version,
            "settings": _sha256(_values(self.settings)),
            "data": [hash_of(name, "data") for name in self.data],
            "checkpoints": [hash_of(name, "checkpoint") for name in self.checkpoints],
        }

    def record(self, resume_checkpoint: Path) -> dict[str, Any]:
        """Call the function; a line of the table."""
        takes = inspect.signature(self.function).parameters
        more = {k: v for k, v in {"resume_checkpoint": resume_checkpoint}.items() if k in takes}
        result = _rounded(self.function(**self.arguments, **more))
        return {"arguments": self.arguments, "made_of": self.made_of(), "result": result}


def _rounded(value: Any) -> Any:
    """The same, with six significant digits of every float."""
    if isinstance(value, dict):
        return {k: _rounded(v) for k, v in value.items()}
    if isinstance(value, list):
        return [_rounded(v) for v in value]
    return float(f"{value:.6g}") if isinstance(value, float) else value


STUDIES: dict[str, tuple[Callable[..., Any], dict[str, Any]]] = {}
"""Functions of rows by name, and what decides them; `experiments.studies` imports all."""


def study(*data: str, **decides: Any) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Make a study of the function below: the data that it reads, and more fields of its `Job`."""

    def register(rows: Callable[..., Any]) -> Callable[..., Any]:
        STUDIES[rows.__name__] = rows, {"data": data} | decides
        return rows

    return register


def run(
    jobs: Sequence[Job],
    table: str,
    client: dask.distributed.Client | None = None,
    folder: str | Path = FOLDER,
    progress: bool = True,
) -> list[Any]:
    """The results of jobs, in order; what is missing or stale is made, here or by a Dask client."""
    folder = resolve_out_dir(folder)
    records, keys = _records(table, folder), [_key(job.arguments) for job in jobs]
    tasks = {
        key: (job, folder / f".{table}-{_sha256([key, job.made_of()])}.pt")
        for key, job in zip(keys, jobs, strict=True)
        if key not in records or _stale(records[key], job)
    }
    made, last = (
        tqdm(_made([*tasks.values()], client), table, len(tasks), disable=not (progress and tasks)),
        0.0,
    )
    new: dict[str, dict[str, Any]] = {}
    try:
        for record in made:
            new[_key(record["arguments"])] = record
            if time.monotonic() - last > WRITE_EVERY_S:
                _add(new, table, folder)
                last = time.monotonic()
    finally:
        if new:
            _add(new, table, folder)
        for key in new:
            for path in folder.glob(f"{tasks[key][1].name}*"):
                path.unlink()
    return [(records | new)[key]["result"] for key in keys]


def read(
    table: str, job: Callable[..., Job], folder: str | Path = FOLDER, accept: bool = False
) -> list[Result]:
    """All results of a table; ValueError names one that `job(**arguments)` would not give now.

    accept: take the results for those of the jobs as they are now, after a change that changed no
    number, such as another name in a checkpoint.
    """
    folder = resolve_out_dir(folder)
    records = _records(table, folder)
    for record in records.values():
        now = job(**record["arguments"])
        if (what := _stale(record, now)) and not accept:
            raise ValueError(
                f"{table}: the result of {record['arguments']} was made of another {what}; run the "
                "job again, or, if no number changed, `experiments.runner.read(..., accept=True)`"
            )
        then, record["made_of"] = record["made_of"], now.made_of()
        known = zip(record["made_of"]["data"], then["data"], strict=True)
        record["made_of"]["data"] = [new or old for new, old in known]
    if accept:
        _add(records, table, folder)
    return [(record["arguments"], record["result"]) for record in records.values()]


def frame(results: Iterable[Result], part: str) -> pd.DataFrame:
    """A part of many results, a dict of columns or a list of rows; arguments become columns."""
    tables = [pd.DataFrame(r[part]).assign(**about) for about, r in results if r.get(part)]
    return pd.concat(tables, ignore_index=True) if tables else pd.DataFrame()


def plain(table: pd.DataFrame | Rows) -> Rows:
    """The rows of a table as plain values, None for what is missing."""
    table = pd.DataFrame(table)
    return table.astype(object).where(table.notna(), None).to_dict("records")


def interval(
    off: Sequence[float] | np.ndarray, draws: int = 9999, rng: int | np.random.Generator = 0
) -> tuple[Any, Any, Any]:
    """Mean of differences (n, ...), and the ends of its bootstrapped 95 % interval."""
    off = np.asarray(off)
    how = {"axis": 0, "n_resamples": draws, "method": "percentile", "rng": rng}
    return off.mean(axis=0), *bootstrap((off,), np.mean, **how).confidence_interval


def parser(table: str, description: str | None) -> argparse.ArgumentParser:
    """A parser of the options that the commands of all tables share."""
    shared = argparse.ArgumentParser(prog=f"python -m experiments.{table}", description=description)
    shared.add_argument("--raw", default=FOLDER, help="the folder of the jobs' results")
    shared.add_argument("--out", default="data/results")
    only = "the jobs with these arguments alone, such as fold=0,1"
    shared.add_argument("--only", nargs="+", default=[], metavar="NAME=VALUE,…", help=only)
    shared.add_argument("--scheduler", help="address of a Dask scheduler")
    shared.add_argument("--workers", type=count_type, default=1, help="processes of this machine")
    return shared


def make(
    jobs: Sequence[Job],
    table: str,
    options: argparse.Namespace,
    tables: Callable[[str], dict[str, Rows]] | None = None,
) -> int:
    """Run the jobs of a command that are missing or stale, then write its tables."""
    for only in options.only:
        name, _, values = only.partition("=")
        values, known = values.split(","), {str(job.arguments.get(name)) for job in jobs}
        if unknown := sorted({*values} - known):
            there = ", ".join(sorted(known))
            raise ValueError(f"--only: no job has {name} = {unknown[0]!r:.40}, but {there}")
        jobs = [job for job in jobs if str(job.arguments.get(name)) in values]
    with dask_client(options.workers, options.scheduler) as client:
        run(jobs, table, client, options.raw)
    if tables is not None:
        print(write_results(options.out, table, {}, tables(options.raw)))
    return 0


def _made(
    tasks: list[tuple[Job, Path]], client: dask.distributed.Client | None
) -> Iterator[dict[str, Any]]:
    if client is None:
        yield from (job.record(path) for job, path in tasks)
        return
    from dask.distributed import as_completed

    futures = [client.submit(Job.record, *task, pure=False) for task in tasks]
    try:
        yield from (future.result() for future in as_completed(futures))
    finally:
        client.cancel(futures)


def _key(arguments: dict[str, Any]) -> str:
    return json.dumps(arguments, sort_keys=True)


def _records(table: str, folder: Path) -> dict[str, dict[str, Any]]:
    """The lines of a table by their arguments."""
    hash_of.cache_clear()
    path = folder / f"{table}.jsonl.gz"
    lines = gzip.decompress(path.read_bytes()).splitlines() if path.is_file() else []
    return {_key(record["arguments"]): record for record in map(json.loads, lines)}


def _add(new: dict[str, dict[str, Any]], table: str, folder: Path) -> None:
    with FileLock(folder / f".{table}.lock"):
        every = sorted((_records(table, folder) | new).items())
        lines = [json.dumps(record, allow_nan=False, separators=(",", ":")) for _, record in every]
        text = "\n".join([*lines, ""])
        write_atomically(folder / f"{table}.jsonl.gz", gzip.compress(text.encode(), mtime=0))


def _stale(record: dict[str, Any], job: Job) -> str | None:
    """What a result was made of that its job is not; data that are not here are not compared."""
    then, now = record["made_of"], job.made_of()
    if None in now["data"]:
        then = then | {"data": now["data"]}
    return next((name for name in now if then[name] != now[name]), None)


@lru_cache
def hash_of(name: str, kind: str) -> str | None:
    """Of what is shipped: a kind "data" or "checkpoint" by its name; None where it is not here."""
    if name == "reachability":  # a checkpoint of another kind, which has no description
        return weights_sha256(read_weights(repo_root() / REACHABILITY, "learn it again")[0], "")
    if kind == "checkpoint":
        return checkpoint_sha256(name)
    try:
        return stored_sha256(name)
    except FileNotFoundError:
        return None


def checkpoint_sha256(name_or_path: str | Path) -> str:
    """Hash of all that decides a checkpoint's answers: weights, configuration, scales, domain."""
    tensors, description = read_weights(resolve_checkpoint(name_or_path), "train it again")
    tensors.pop(NOVELTY, None)  # does not change what it answers
    decisive = {key: description[key] for key in ("model", "config", "scaler", "domain")}
    return weights_sha256(tensors, json.dumps(decisive))


def _values(settings: Any) -> Any:
    if is_dataclass(settings):
        names = [f.name for f in fields(settings) if f.name not in NOT_DECISIVE]
        return [_values(getattr(settings, name)) for name in names]
    if isinstance(settings, dict):
        return [[_values(k), _values(v)] for k, v in settings.items()]
    if isinstance(settings, tuple | list):
        return [_values(v) for v in settings]
    return getattr(settings, "__name__", settings)


def _sha256(plain: Any) -> str:
    return hashlib.sha256(json.dumps(plain).encode()).hexdigest()
