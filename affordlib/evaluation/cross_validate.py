"""Cross-validation of models on a user's own log, always with baselines for comparison.

    constant          the mean effect, in the direction of the push
    nearest           the effect of the training push with the nearest contact point and direction
    ridge             quadratic in contact point and direction
    gaussian_process  of contact point and direction, with reflections if the outline is symmetric
    physics           a quasi-static push with two fitted numbers (`AnalyticPusher`); physics_feet:
                      with the support from `context["feet"]`
    physics_gp        the same, and a Gaussian process of its residuals; physics_feet_gp

All baselines that can use `context` get it, if it differs among the training pushes.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable, Sequence

import numpy as np
import pandas as pd
import torch
from scipy.stats import norm

from affordlib.interactions.log import PushLog
from affordlib.models.fit import MODELS, fit, folds_of, gyration_radius_m, push_rows, told_feet
from affordlib.models.neural_process import transformed
from affordlib.models.quasi_static import AnalyticPusher
from affordlib.types import check_count

MOST_PUSHES = 3000
"""Maximum number of pushes: the time of a Gaussian process grows with its cube."""
WITHIN = ("group", "all", "others")

Forecast = tuple[np.ndarray, np.ndarray]
"""Mean and σ (n, 3) of displacement [m] and rotation [rad], in the object's frame."""


def cross_validate(
    data: PushLog,
    models: Sequence[str] = tuple(MODELS),
    folds: int = 5,
    within: str = "group",
    seed: int = 0,
) -> pd.DataFrame:
    """Errors and coverage of models and of all baselines, by group and over all pushes.

    models: names for `fit`; folds: number of folds of each group, each tested once; within: "group"
    trains on the other folds of the same group, "all" on those of all groups, "others" on the other
    groups. Returns one row per model and group, and group "all": n_train, n, mean, standard error
    and median of the position error [m], mean and standard error of the yaw error [rad], and the
    share of x, y and yaw inside the 50 and 90 % intervals.
    """
    errors = push_errors(data, models, folds, within, seed)
    named = errors[errors["group"] != "all"]  # the default name means all pushes
    parts = [*named.groupby(["model", "group"], sort=False)]
    parts += [((name, "all"), part) for name, part in errors.groupby("model", sort=False)]
    return pd.DataFrame(
        {"model": model, "group": group, "n_train": round(part["n_train"].mean())} | summary(part)
        for (model, group), part in parts
    )


def push_errors(
    data: PushLog, models: Sequence[str], folds: int = 5, within: str = "group", seed: int = 0
) -> pd.DataFrame:
    """One row per model and push, with the push's index; `cross_validate` summarises it."""
    check_count("folds", folds, 2)
    check_count("seed", seed, least=0)
    if unknown := set(models) - set(MODELS):
        raise ValueError(f"models must be among {sorted(MODELS)}, got {sorted(map(str, unknown))}")
    names, counts = np.unique(data.groups, return_counts=True)
    if within not in WITHIN or (within == "others" and len(names) < 2):
        raise ValueError(
            f"within must be one of {WITHIN}, got {within!r}; data has {len(names)} groups"
        )
    if counts.min() < 2 * folds or len(data) > MOST_PUSHES:
        raise ValueError(
            f"data must hold at least {2 * folds} interactions of each group for {folds} folds and "
            f"at most {MOST_PUSHES}, got {dict(zip(names.tolist(), counts.tolist(), strict=True))}"
        )
    fold = folds_of(data.groups, folds, seed)
    jobs = [(data.groups == name, k) for name in names for k in range(folds)]
    if within == "all":
        jobs = [(np.ones(len(data), dtype=bool), k) for k in range(folds)]
    tests = [g if within == "others" else g & (fold == k) for g, k in jobs]
    tests = tests[:: folds if within == "others" else 1]
    pool = [~t if within == "others" else g for t, (g, _) in zip(tests, jobs, strict=False)]
    from joblib import Parallel, delayed  # sets variables of the environment when it is imported

    parts = Parallel(n_jobs=min(len(tests), os.cpu_count()))(
        delayed(errors_of)(data, g & ~t, t, (*BASELINES, *models), seed)
        for g, t in zip(pool, tests, strict=True)
    )
    return pd.concat(parts, ignore_index=True)


def summary(errors: pd.DataFrame) -> dict[str, float]:
    """Summarise errors per push as one row of `cross_validate`."""
    position, yaw = errors["position_m"], errors["yaw_rad"]
    return {
        "n": len(errors),
        "position_mean_m": position.mean(),
        "position_sem_m": position.sem(),
        "position_median_m": position.median(),
        "yaw_mean_rad": yaw.mean(),
        "yaw_sem_rad": yaw.sem(),
        "coverage_50": errors["inside_50"].mean(),
        "coverage_90": errors["inside_90"].mean(),
    }


def errors_of(
    data: PushLog, trained: np.ndarray, tested: np.ndarray, names: Sequence[str], seed: int = 0
) -> pd.DataFrame:
    """One row per predictor and tested push, after training; trained, tested: masks (n,)."""
    torch.set_num_threads(1)
    train, test = data.select(trained), data.select(tested)
    scale, frames = [*[gyration_radius_m(data.outline_m)] * 2, 1.0], []
    for name in names:
        if name.startswith("physics_feet") and "feet" not in data.context:
            continue
        if name in BASELINES:
            forecast = tuple(v * scale for v in BASELINES[name](train, test))
        else:
            forecast = fit(train, name, seed).predict(test)
        frames.append(forecast_errors(forecast, test).assign(model=name))
    table = pd.concat(frames, ignore_index=True)
    return table.assign(push=np.tile(np.flatnonzero(tested), len(frames)), n_train=trained.sum())


def forecast_errors(forecast: Forecast, test: PushLog) -> pd.DataFrame:
    """One row per push: errors, and the shares of x, y and yaw in the 50 and 90 % intervals."""
    mean, std = forecast
    off = np.abs(mean - np.column_stack([test.displacement_m, test.turn_rad]))
    inside = {f"inside_{p}": (off < norm.ppf(0.5 + p / 200) * std).mean(axis=1) for p in (50, 90)}
    errors = {"position_m": np.hypot(off[:, 0], off[:, 1]), "yaw_rad": off[:, 2]}
    return pd.DataFrame({"group": test.groups} | errors | inside)


def mirrors(outline_m: np.ndarray) -> list[np.ndarray]:
    """Matrices (2, 2) of the reflections that map an outline (k, 2) to itself."""
    corners = outline_m @ np.array([1, 1j])
    found = []
    for corner in corners:
        turn = corners[0] * corner / abs(corners[0]) / abs(corner)
        gaps = np.abs((turn * corners.conj())[:, None] - corners).min(axis=1)
        if gaps.max() < 0.01 * np.abs(corners).max():
            found.append(np.array([[turn.real, turn.imag], [turn.imag, -turn.real]]))
    return found


def _features(log: PushLog, like: PushLog) -> np.ndarray:
    """Contact point and direction (n, 4 + c), and length and context if they differ in `like`."""
    columns = [push_rows(log)[:, [0, 1, 4, 5]].double().numpy()]
    if like.length_m.std() > 0.05 * like.length_m.mean():
        columns.append(log.length_m[:, None] / gyration_radius_m(log.outline_m))
    for name, values in log.context.items():
        known = np.unique(like.context[name]) if name != "feet" else ()
        if len(known) > 1 and values.dtype.kind in "US":
            columns.append((values[:, None] == known).astype(float))
        elif len(known) > 1:
            columns.append(((values - known.mean()) / known.std())[:, None])
    return np.hstack(columns)


def _outcome(log: PushLog) -> np.ndarray:
    return push_rows(log)[:, 7:].double().numpy()


def _constant(train: PushLog, test: PushLog) -> Forecast:
    ahead = _turned(train.direction * [1, -1], _outcome(train))
    mean, spread = ahead.mean(axis=0), ahead.std(axis=0)
    of_test = _turned(test.direction, np.tile(mean, (len(test), 1)))
    return of_test, np.tile([np.hypot(*spread[:2]) / 2**0.5] * 2 + [spread[2]], (len(test), 1))


def _turned(direction: np.ndarray, outcome: np.ndarray) -> np.ndarray:
    """Rotate outcomes (n, 3) so that their x axis becomes the directions (n, 2)."""
    (c, s), (x, y, turn) = direction.T, outcome.T
    return np.column_stack([c * x - s * y, s * x + c * y, turn])


def _nearest(train: PushLog, test: PushLog) -> Forecast:
    known, outcome = _features(train, train), _outcome(train)
    gap = np.linalg.norm(known[:, None] - known, axis=-1) + np.diag([np.inf] * len(known))
    std = (outcome[gap.argmin(axis=1)] - outcome).std(axis=0)
    found = np.linalg.norm(_features(test, train)[:, None] - known, axis=-1).argmin(axis=1)
    return outcome[found], np.tile(std, (len(test), 1))


def _ridge(train: PushLog, test: PushLog) -> Forecast:
    from sklearn.linear_model import RidgeCV
    from sklearn.pipeline import make_pipeline
    from sklearn.preprocessing import PolynomialFeatures, StandardScaler

    model = make_pipeline(PolynomialFeatures(2), StandardScaler(), RidgeCV(np.logspace(-3, 2, 11)))
    known, outcome = _features(train, train), _outcome(train)
    std = (outcome - model.fit(known, outcome).predict(known)).std(axis=0)
    return model.predict(_features(test, train)), np.tile(std, (len(test), 1))


def _gaussian_process(train: PushLog, test: PushLog, target: np.ndarray | None = None) -> Forecast:
    """Fit to target (n, 3), by default the outcome."""
    from sklearn.exceptions import ConvergenceWarning
    from sklearn.gaussian_process import GaussianProcessRegressor
    from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel

    known, target = _features(train, train), _outcome(train) if target is None else target
    rows = push_rows(train)
    rows[:, 7:] = torch.from_numpy(target)
    known, target = [known], [target]
    for mirror in mirrors(train.outline_m):
        copy = transformed(rows[None], torch.from_numpy(mirror)[None].float())[0].double().numpy()
        known.append(np.hstack([copy[:, [0, 1, 4, 5]], known[0][:, 4:]]))
        target.append(copy[:, 7:])
    known, target = np.vstack(known), np.vstack(target)
    prior = ConstantKernel() * RBF([1.0] * known.shape[1], (1e-2, 1e4)) + WhiteKernel(0.1)
    with warnings.catch_warnings():  # the length scale of an irrelevant feature hits its bound
        warnings.simplefilter("ignore", ConvergenceWarning)
        both = [
            GaussianProcessRegressor(prior, normalize_y=True)
            .fit(known, column)
            .predict(_features(test, train), return_std=True)
            for column in target.T
        ]
    mean, std = (np.column_stack(v) for v in zip(*both, strict=True))
    return mean, std


def _physics(feet: bool, process: bool) -> Callable[[PushLog, PushLog], Forecast]:
    """A quasi-static pusher fitted to each group, or to all pushes for a group not in training."""

    def predicted(train, test):
        means = [np.zeros((len(log), 3)) for log in (train, test)]
        for group in np.unique(np.concatenate([train.groups, test.groups])):
            known = train.groups == group
            fitted = train.select(known if known.any() else known | True)
            rows, chosen = push_rows(fitted), test.select(test.groups == group)
            told = [told_feet(log)[0] if feet and len(log) else None for log in (fitted, chosen)]
            pusher = AnalyticPusher(rows[:, :7], rows[:, 7:], told[0])
            for mean, log, support in zip(means, (train, test), told, strict=True):
                if (of_group := log.groups == group).any():
                    pusher.feet = support
                    mean[of_group] = pusher.predict(push_rows(log)[of_group, :7]).numpy()
        left = _outcome(train) - means[0]
        if process:
            mean, std = _gaussian_process(train, test, left)
            return means[1] + mean, std
        return means[1], np.tile(np.sqrt((left**2).mean(axis=0)), (len(test), 1))

    return predicted


BASELINES: dict[str, Callable[[PushLog, PushLog], Forecast]] = {
    "constant": _constant,
    "nearest": _nearest,
    "ridge": _ridge,
    "gaussian_process": _gaussian_process,
    "physics": _physics(False, False),
    "physics_gp": _physics(False, True),
    "physics_feet": _physics(True, False),
    "physics_feet_gp": _physics(True, True),
}
