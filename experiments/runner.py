"""The runner of all experiments: jobs whose results are stored, resumed, and rejected when stale.

A job is a call of a function. Its result, plain values, is stored as a line of
`data/results/raw/<table>.jsonl.gz`, with its arguments and hashes of its other inputs. Stored
results are not computed again, and results of other inputs are rejected. A killed run loses the
running jobs and at most half a minute. Equal results give identical bytes.

    def job(model: str, fold: int) -> Job:
        return Job(cross_validate, {"model": model, "fold": fold}, data=("push",), version=2)

    run([job("film", fold) for fold in range(10)], "effect_prediction")
    results = read("effect_prediction", job)
"""

import argparse
import gzip
import hashlib
import importlib
import inspect
import json
import os
import sys
import time
import zlib
from collections.abc import Callable, Iterable, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass, fields, is_dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from filelock import FileLock
from scipy.stats import binomtest, bootstrap
from tqdm.auto import tqdm

from affordlib.interactions import open_interactions
from affordlib.interactions.store import stored_sha256
from affordlib.planning.skills import REACHABILITY
from affordlib.results import file_at, repo_root, resolve_out_dir, write_atomically, write_results
from affordlib.weights import read_weights, resolve_checkpoint, weights_sha256
from affordlib.workers import spread
from experiments.commands import Main, command, worker_type

FOLDER = "data/results/raw"
WRITE_EVERY_S = 30

open_once = lru_cache(maxsize=4)(open_interactions)  # data sets are kept between jobs
Rows = list[dict[str, Any]]
Tables = Callable[[str], dict[str, Rows]]  # makes all tables of the results in a folder
Result = tuple[dict[str, Any], Any]
"""The arguments of a job and the value that its function returned."""


@dataclass(frozen=True)
class Job:
    """A call of a module's function, and all further inputs that influence its result.

    function: returns plain values. If it has an argument `resume_checkpoint`, it gets a path that
    it may write to while it runs, and from which it resumes after a kill.
    settings: further inputs: nested plain values, dataclasses and functions; names of fields do not
    matter. data, checkpoints: names of data sets and checkpoints that it reads. version: raise it
    when a change of code changes the result and no other input shows it.
    """

    function: Callable[..., Any]
    arguments: dict[str, Any]
    settings: Any = ()
    data: tuple[str, ...] = ()
    checkpoints: tuple[str, ...] = ()
    version: int = 1

    def made_of(self) -> dict[str, Any]:
        """Return version and hashes of all inputs; the hash of a missing data set is None."""
        return {
            "version": self.version,
            "settings": _sha256(_values(self.settings)),
            "data": [hash_of(name, "data") for name in self.data],
            "checkpoints": [hash_of(name, "checkpoint") for name in self.checkpoints],
        }


def _rounded(value: Any) -> Any:
    """Round all floats in nested values to six significant digits."""
    if isinstance(value, dict):
        return {k: _rounded(v) for k, v in value.items()}
    if isinstance(value, list):
        return [_rounded(v) for v in value]
    return float(f"{value:.6g}") if isinstance(value, float) else value


def run(jobs: Sequence[Job], table: str, folder: str | Path = FOLDER, workers: int = 1) -> list:
    """Return the results of jobs, in order; compute missing or stale ones as `spread` does."""
    folder = resolve_out_dir(folder)
    records, keys = _records(table, folder), [_key(job.arguments) for job in jobs]
    tasks: dict[str, tuple[Job, Path]] = {}
    for key, job in zip(keys, jobs, strict=True):
        if key not in records or _stale(records[key], job):
            path = folder / f".{table}-{_sha256([key, job.made_of()])}.pt"
            tasks[key] = replace(job, function=_importable(job.function)), path
    new: dict[str, dict[str, Any]] = {}
    made, last = spread(_record, tasks, workers), 0.0
    bar = tqdm(total=len(tasks), desc=table, disable=not tasks)
    try:
        with closing(made), bar:
            for key, record in made:
                new[key] = record
                bar.update()
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


def _record(task: tuple[Job, Path]) -> dict[str, Any]:
    """Call a job's function and return a line of the table."""
    job, resume_checkpoint = task
    takes = "resume_checkpoint" in inspect.signature(job.function).parameters
    more = {"resume_checkpoint": resume_checkpoint} if takes else {}
    result = _rounded(job.function(**job.arguments, **more))
    return {"arguments": job.arguments, "made_of": job.made_of(), "result": result}


def read(table: str, job: Callable[..., Job], folder: str | Path = FOLDER) -> list[Result]:
    """Return all results of a table; raises ValueError for one whose `job` has other inputs now."""
    records = _records(table, resolve_out_dir(folder))
    for record in records.values():
        if what := _stale(record, job(**record["arguments"])):
            raise ValueError(
                f"{table}: the result of {record['arguments']} was made of another {what}; run the "
                "job again"
            )
    return [(record["arguments"], record["result"]) for record in records.values()]


def frame(results: Iterable[Result], part: str) -> pd.DataFrame:
    """Concatenate a part of all results (columns or rows), with the arguments as columns."""
    tables = [pd.DataFrame(r[part]).assign(**about) for about, r in results if r.get(part)]
    return pd.concat(tables, ignore_index=True) if tables else pd.DataFrame()


def shares(k: int, n: int) -> tuple[float | None, ...]:
    """Return k of n in per cent with the ends of its 95 % interval (Wilson); None where n is 0."""
    ends = binomtest(k, n).proportion_ci(method="wilson") if n else (None, None)
    return tuple(share and 100 * share for share in (k / n if n else None, *ends))


def plain(table: pd.DataFrame | Rows) -> Rows:
    """Return the rows of a table as plain values, None for missing ones."""
    table = pd.DataFrame(table)
    return table.astype(object).where(table.notna(), None).to_dict("records")


def interval(
    off: Sequence[float] | np.ndarray, draws: int = 9999, rng: int | np.random.Generator = 0
) -> tuple[Any, Any, Any]:
    """Return the mean of differences (n, ...) and the ends of its bootstrap 95 % interval."""
    off = np.asarray(off)
    how = {"axis": 0, "n_resamples": draws, "method": "percentile", "rng": rng}
    return off.mean(axis=0), *bootstrap((off,), np.mean, **how).confidence_interval


def parser(table: str, description: str | None) -> argparse.ArgumentParser:
    """Return a parser with the options that the commands of all tables share."""
    shared = argparse.ArgumentParser(prog=f"python -m experiments.{table}", description=description)
    shared.add_argument("--raw", default=FOLDER, help="the folder of the jobs' results")
    shared.add_argument("--out", default="data/results")
    only = "run only jobs with these arguments, such as fold=0,1"
    shared.add_argument("--only", nargs="+", default=[], metavar="NAME=VALUE,…", help=only)
    shared.add_argument("--workers", type=worker_type, default=1, help="processes on this machine")
    return shared


def make(
    jobs: Sequence[Job], table: str, options: argparse.Namespace, tables: Tables | None = None
) -> int:
    """Run the missing or stale jobs of a command, then write its tables."""
    all_jobs = {_key(job.arguments) for job in jobs}
    for only in options.only:
        name, _, values = only.partition("=")
        values, known = values.split(","), {str(job.arguments.get(name)) for job in jobs}
        if unknown := sorted({*values} - known):
            there = ", ".join(sorted(known))
            raise ValueError(f"--only: no job has {name} = {unknown[0]!r:.40}, but {there}")
        jobs = [job for job in jobs if str(job.arguments.get(name)) in values]
    run(jobs, table, options.raw, options.workers)
    if tables is None:
        return 0
    try:
        made = tables(options.raw)
    except Exception:  # of tables that need jobs which `--only` left out
        left = all_jobs - _records(table, resolve_out_dir(options.raw)).keys()
        if not left:
            raise
        print(f"{table}: results are stored; its tables need {len(left)} jobs more")
        return 0
    print(write_results(options.out, table, {}, made))
    return 0


def command_of(
    table: str, about: str, jobs: Callable[[], Sequence[Job]], tables: Tables | None = None
) -> Main:
    """Return the `main` of a command that does as `make` does; about: the module's docstring."""

    @command(OSError, ValueError, name=table)
    def main(argv: Sequence[str] | None = None) -> int:
        return make(jobs(), table, parser(table, about.splitlines()[0]).parse_args(argv), tables)

    return main


def _importable(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return the same function of the imported module; a worker has another `__main__`."""
    if isinstance(function, partial):
        return partial(_importable(function.func), *function.args, **function.keywords)
    spec = sys.modules["__main__"].__spec__
    if function.__module__ != "__main__" or spec is None:
        return function
    return getattr(importlib.import_module(spec.name), function.__name__)


def _key(arguments: dict[str, Any]) -> str:
    return json.dumps(arguments, sort_keys=True)


def _records(table: str, folder: Path) -> dict[str, dict[str, Any]]:
    """Return the lines of a table by their arguments."""
    hash_of.cache_clear()
    path = folder / f"{table}.jsonl.gz"
    if not os.path.lexists(path):
        return {}
    try:
        content = file_at(path).read_bytes()
        lines = gzip.decompress(content or b"?").splitlines()  # nothing would be no results
        return {_key(record["arguments"]): record for record in map(json.loads, lines)}
    except (OSError, EOFError, zlib.error, ValueError, KeyError, TypeError) as error:
        raise ValueError(
            f"{path} is damaged, or holds no results ({error!r}); fetch it again, or delete it to "
            "run its jobs again"
        ) from error


def _add(new: dict[str, dict[str, Any]], table: str, folder: Path) -> None:
    with FileLock(folder / f".{table}.lock"):
        every = sorted((_records(table, folder) | new).items())
        lines = [json.dumps(record, allow_nan=False, separators=(",", ":")) for _, record in every]
        text = "\n".join([*lines, ""])
        write_atomically(folder / f"{table}.jsonl.gz", gzip.compress(text.encode(), mtime=0))


def _stale(record: dict[str, Any], job: Job) -> str | None:
    """Return the name of an input that differs from the job's; missing data are not compared."""
    then, now = record["made_of"], job.made_of()
    if None in now["data"]:
        then = then | {"data": now["data"]}
    return next((name for name in now if then[name] != now[name]), None)


@lru_cache
def hash_of(name: str, kind: str) -> str | None:
    """Return the hash of a shipped file of kind "data" or "checkpoint", None for missing data."""
    if name == "reachability":  # a checkpoint without a description
        return weights_sha256(read_weights(repo_root() / REACHABILITY, "learn it again")[0], "")
    if kind == "checkpoint":
        return checkpoint_sha256(name)
    with suppress(FileNotFoundError):
        return stored_sha256(name)
    return None


def checkpoint_sha256(name_or_path: str | Path) -> str:
    """Return a hash of a checkpoint's weights, configuration, scales and domain."""
    tensors, description = read_weights(resolve_checkpoint(name_or_path), "train it again")
    decisive = {key: description[key] for key in ("model", "config", "scaler", "domain")}
    return weights_sha256(tensors, json.dumps(decisive))


def _values(settings: Any) -> Any:
    if is_dataclass(settings):
        names = [f.name for f in fields(settings) if f.name != "device"]  # has no influence
        return [_values(getattr(settings, name)) for name in names]
    if isinstance(settings, dict):
        return [[_values(k), _values(v)] for k, v in settings.items()]
    if isinstance(settings, tuple | list):
        return [_values(v) for v in settings]
    return getattr(settings, "__name__", settings)


def _sha256(plain: Any) -> str:
    return hashlib.sha256(json.dumps(plain).encode()).hexdigest()
