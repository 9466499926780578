"""Real pushes of one object: errors of models by number of training pushes and known context.

    python -m experiments.real_pushes --logs FOLDER

makes `data/results/real_pushes.json`. FOLDER contains the logs of seven conditions, as published
(or compressed with xz): github.com/robinzhoucmu/Pushing, icra_data_proc/SensorLogs (Apache License
2.0; Zhou, Paolini, Bagnell and Mason, A convex polynomial force-motion model for planar sliding,
ICRA 2016).
"""

import itertools
import lzma
from collections.abc import Iterator, Sequence
from functools import lru_cache, partial
from pathlib import Path

import numpy as np
import pandas as pd

from affordlib.logs import Log, LoggedPushes, fit, planar
from affordlib.logs.cross_validate import errors_of, forecast_errors, summary
from affordlib.logs.fit import BASELINES, EFFORT, folds_of
from affordlib.logs.neural_process import PRETRAINED
from experiments import runner
from experiments.commands import command
from experiments.runner import FOLDER, Job, Rows, frame, interval, read

TABLE = "real_pushes"
CHOSEN_ON = ("hardboard_3points1", "plywood_3points3")
"""Conditions on which steps and rates of tuning were chosen; the other five are for testing."""
SHOTS = (0, 5, 10)
CORNERS_MM = ((0, 0), (150, 0), (0, 150))
SUPPORTS_MM = {
    "3points1": ((30, 30), (63.33, 43.33), (43.33, 63.33)),
    "3points2": ((10, 10), (130, 10), (10, 130)),
    "3points3": ((30, 30), (90, 30), (30, 90)),
    "3points4": ((10, 10), (90, 30), (10, 130)),
    "patch": None,
}
CONDITIONS = (
    *(f"hardboard_{support}" for support in ("3points1", "3points2", "3points3", "patch")),
    *(f"plywood_{support}" for support in ("3points1", "3points3", "3points4")),
)


def feet_of(support: str) -> np.ndarray:
    """Return feet (12, 3): x, y [m] from the centroid, share of weight; a face has 12 points."""
    feet = np.zeros((12, 3))
    if SUPPORTS_MM[support] is None:
        cells = [(i + 1 / 3, j + 1 / 3) for i in range(4) for j in range(4 - i)]
        cells = np.array([(0.5, 0.5), (3, 0.5), (0.5, 3), *cells[1:9], cells[0]])
        feet[:, :2], feet[:, 2] = cells / 4 * 150 - 50, 1 / 12
        feet[:, :2] -= feet[:, :2].mean(axis=0)
    else:
        points = np.array(SUPPORTS_MM[support]) - 50
        feet[:3, :2] = points
        feet[:3, 2] = np.linalg.solve(np.vstack([points.T, np.ones(3)]), (0, 0, 1))
    return feet * (1e-3, 1e-3, 1)


def pushes_of(path: Path) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Yield for each push of a file: poses (2, 7) before and after, times, positions of the tool.

    A pose is x, y, z and a quaternion w, i, j, k. Raises ValueError if the file is damaged.
    """

    def take(columns: int, rows: int | None = None) -> np.ndarray:
        rows = int(next(values)) if rows is None else rows
        return np.array([next(values) for _ in range(rows * columns)]).reshape(rows, columns)

    packed = path.read_bytes()
    try:
        text = (lzma.decompress(packed) if path.suffix == ".xz" else packed).decode()
        values = iter([float(word) for word in text.split()])
        for _ in range(int(next(values))):
            poses, _forces, tool = take(7, rows=2), take(3), take(8)
            yield poses, tool[:, 0], tool[:, 1:3]
    except (lzma.LZMAError, StopIteration, ValueError) as error:
        raise ValueError(f"{path} is damaged, or is not a log of pushes: {error!r}") from error


@lru_cache
def read_logs(folder: str | Path, feet: bool = True) -> LoggedPushes:
    """Read all pushes of the seven conditions; feet: include the feet as context."""
    log = Log(unit="mm", outline=CORNERS_MM)
    for name in CONDITIONS:
        found = sorted(Path(folder).glob(f"{name}.txt*"))
        if not found:
            raise FileNotFoundError(f"--logs: there is no {name}.txt or {name}.txt.xz in {folder}")
        context = {"feet": feet_of(name.split("_")[1])} if feet else {}
        for poses, t, xy in pushes_of(found[0]):
            log.add(t, xy, planar(poses, "wxyz"), context=context, group=name)
    return log.pushes()


def from_some(
    n: int, data: LoggedPushes, names: tuple[str, ...], seed: int, fold: int
) -> pd.DataFrame:
    """Return errors on a fold of each condition, trained on n of the condition's other pushes."""
    tested, parts = folds_of(data.groups, 5, seed) == fold, []
    rng, every = np.random.default_rng([seed, fold]), np.arange(len(data))
    for name in CONDITIONS:
        of_group = data.groups == name
        trained = np.isin(every, rng.permutation(np.flatnonzero(of_group & ~tested))[:n])
        parts.append(errors_of(data, trained, of_group & tested, names, seed))
    return pd.concat(parts)


def pooled(data: LoggedPushes, names: tuple[str, ...], seed: int, fold: int) -> pd.DataFrame:
    """Return errors on a fold of all conditions, trained on the other folds of all conditions."""
    tested = folds_of(data.groups, 5, seed) == fold
    return errors_of(data, ~tested, tested, names, seed)


def unseen(data: LoggedPushes, names: tuple[str, ...], seed: int, fold: int) -> pd.DataFrame:
    """Return errors on a condition, trained on the six others and its first 0, 5 and 10 pushes, or,
    with the first pushes as context of the neural process, on the others only.
    """
    of_group = data.groups == CONDITIONS[fold]
    order = np.random.default_rng(seed).permutation(np.flatnonzero(of_group))
    tested, parts = np.isin(np.arange(len(data)), order[max(SHOTS) :]), []
    fitted = fit(data.select(~of_group), "np", seed) if names == ("np",) else None
    for shots in SHOTS:
        given = np.concatenate([np.flatnonzero(~of_group), order[:shots]])
        if fitted is None:
            trained = np.isin(np.arange(len(data)), given)
            errors = errors_of(data, trained, tested, names, seed)
        else:
            fitted.data = data.select(given)
            errors = forecast_errors(fitted, data.select(tested))
            errors = errors.assign(model="np", push=np.flatnonzero(tested))
        parts.append(errors.assign(shots=shots))
    return pd.concat(parts)


PROTOCOLS = {f"from_{n}": (partial(from_some, n), 5) for n in (10, 20, 40)}
PROTOCOLS |= {"pooled": (pooled, 5), "unseen": (unseen, len(CONDITIONS))}
COLUMNS = ["model", "shots", "push", "position_m", "yaw_rad", "inside_50", "inside_90"]


def measure(logs: str, protocol: str, predictor: str, feet: bool, seed: int, fold: int) -> dict:
    """Return the errors per push of one fold."""
    names = (predictor,)
    if predictor == "baselines":  # only physics_feet… use known feet
        names = tuple(name for name in BASELINES if name.startswith("physics_feet") == feet)
    errors = PROTOCOLS[protocol][0](read_logs(logs, feet), names, seed, fold)
    return {"errors": errors.reindex(columns=COLUMNS).fillna({"shots": -1}).to_dict("list")}


def job(protocol: str, predictor: str, feet: bool, seed: int, fold: int, logs: str = "") -> Job:
    """Return the job of one fold of a protocol; the path of the logs is not part of its key."""
    arguments = {"protocol": protocol, "predictor": predictor, "feet": feet}
    arguments |= {"seed": seed, "fold": fold}
    if predictor == "np":
        return Job(partial(measure, logs), arguments, EFFORT, checkpoints=(PRETRAINED,), version=3)
    return Job(partial(measure, logs), arguments, version=2)


def tables(folder: str | Path = FOLDER) -> dict[str, Rows]:
    """Return errors, means of a push over seeds, and paired differences to the best baseline."""
    every = frame(read(TABLE, job, folder), "errors").drop(columns=["fold", "predictor"])
    keys = ["protocol", "feet", "shots", "model"]
    seeds = every.groupby(keys)["seed"].nunique()
    pushes = every.groupby([*keys, "push"]).mean(numeric_only=True).reset_index()
    pushes["condition"] = np.array(CONDITIONS)[pushes["push"] // 50]
    found, others = {}, pushes[~pushes["condition"].isin(CHOSEN_ON)]
    for name, part in (("errors", pushes), ("other_conditions", others)):
        rows = summary(part, keys)
        found[name] = [row | {"seeds": int(seeds[*(row[key] for key in keys)])} for row in rows]
    found["differences"] = [
        {"protocol": protocol, "shots": shots} | row
        for (protocol, shots), part in pushes.groupby(["protocol", "shots"])
        for row in differences(part.pivot(index="push", columns=["model", "feet"]))
    ]
    for row in (row for rows in found.values() for row in rows):
        row["shots"] = int(row["shots"]) if row["shots"] >= 0 else None
    return found


def differences(errors: pd.DataFrame) -> Rows:
    """Return differences, neural process minus best baseline, over pushes predicted by both.

    errors: (pushes, columns of each model and its context). The best baseline, with and without
    known feet, has the least mean position error. Intervals are over pushes, not over seeds.
    """
    mean, rows = errors["position_m"].mean(), []
    for _, feet in (key for key in mean.index if key[0] == "np"):
        for baseline_feet in sorted(set(mean[list(BASELINES)].index.get_level_values("feet"))):
            best = mean[list(BASELINES)].xs(baseline_feet, level="feet").idxmin()
            row = {"feet": feet, "baseline": best, "baseline_feet": baseline_feet}
            for column, unit in (("position", "m"), ("yaw", "rad")):
                each = errors[f"{column}_{unit}"]
                off = (each["np", feet] - each[best, baseline_feet]).dropna()
                names = [f"{column}_{what}_{unit}" for what in ("mean", "low", "high")]
                row |= {"n": len(off)} | dict(zip(names, interval(off), strict=True))
            rows.append(row)
    return rows


@command(OSError, ValueError)
def main(argv: Sequence[str] | None = None) -> int:
    """Run missing jobs and make the tables."""
    parser = runner.parser(TABLE, __doc__.splitlines()[0])
    parser.add_argument("--logs", help="folder of the published logs; without it, only tables")
    options = parser.parse_args(argv)
    jobs = [
        job(protocol, predictor, feet, seed, fold, options.logs)
        for protocol, (_, folds) in PROTOCOLS.items()
        for predictor, feet in itertools.product(("baselines", "np"), (False, True))
        for seed, fold in itertools.product(range(3 if predictor == "np" else 1), range(folds))
        # Within one condition, the feet are the same for all pushes.
        if predictor == "baselines" or not feet or not protocol.startswith("from")
    ]
    return runner.make(jobs if options.logs else [], TABLE, options, tables)


if __name__ == "__main__":
    raise SystemExit(main())
