"""Models of the pushes of one object, fitted to a log of them.

    constant          the mean effect, in the direction of the push
    nearest           the effect of the logged push with the nearest contact point and direction
    ridge             quadratic in contact point and direction
    gaussian_process  of contact point and direction, with reflections if the outline is symmetric
    rate_gp           of contact point, normal, direction and length: the effect per length; for
                      outlines with corners and many pushes
    physics           a quasi-static push with two fitted numbers (`AnalyticPusher`); physics_feet:
                      with the support from `context["feet"]`
    physics_gp        the same, and a Gaussian process of its residuals; physics_feet_gp
    np                the pretrained neural process, fine-tuned; from some 35 pushes on

The baselines that can use `context` get it, if it differs among the logged pushes.
"""

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np
import torch
from sklearn.exceptions import ConvergenceWarning
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, Matern, WhiteKernel
from sklearn.linear_model import RidgeCV
from sklearn.neighbors import KNeighborsRegressor
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import PolynomialFeatures, StandardScaler
from torch import Tensor

from affordlib.geometry import quarter_turn
from affordlib.logs.log import LoggedPushes, Pushes, gyration_radius_m
from affordlib.logs.neural_process import (
    NeuralProcess,
    in_contact_frame,
    load_neural_process,
    train_neural_process,
    transformed,
)
from affordlib.logs.physics import AnalyticPusher
from affordlib.types import check_choice, check_count
from affordlib.weights import read_weights, write_weights

INNER_FOLDS, FEW, MOST_CONTEXT = 3, 100, 64
MOST_FITTED = 250  # pushes from which the kernel of `rate_gp` is learned
FAR = 1.2  # times the length of the log's longest push, beyond which σ is widened
EFFORT = {"few": (100, 1e-4, 8), "many": (600, 3e-4, 8)}
"""Fine-tuning on fewer than `FEW` pushes or on more: steps, learning rate, tasks per step."""
FORMAT = "affordlib model of pushes 1"

Forecast = tuple[np.ndarray, np.ndarray]  # mean and σ (n, 3), as `PushModel.predict` returns them
State = dict[str, np.ndarray]  # what a model learned; it learns what is missing when it predicts


@runtime_checkable
class PushModel(Protocol):
    """A model that predicts the outcomes of pushes."""

    def predict(self, pushes: Pushes) -> Forecast:
        """Mean and σ (n, 3) of displacement [m] and rotation [rad], in the object's frame."""


def push_rows(pushes: Pushes) -> Tensor:
    """Pushes as rows (n, 7) for `neural_process` and `physics`, or (n, 10) with their outcomes."""
    scale = gyration_radius_m(pushes.outline_m)
    lengths = (pushes.contact_m / scale, pushes.length_m[:, None] / scale)
    parts = [lengths[0], pushes.normal, pushes.direction, lengths[1]]
    if isinstance(pushes, LoggedPushes):
        parts += [pushes.displacement_m / scale, pushes.turn_rad[:, None]]
    return torch.from_numpy(np.concatenate(parts, axis=1)).float()


def known_feet(pushes: Pushes) -> Tensor:
    """Known feet (n, k, 3) in units of the radius of gyration; (n, 0, 3) where none are known."""
    known = pushes.context.get("feet", np.zeros((len(pushes), 0, 3)))
    feet = torch.tensor(known, dtype=torch.float32)
    feet[..., :2] /= gyration_radius_m(pushes.outline_m)
    return feet


def in_object_frame(pushes: Pushes, mean: Tensor, std: Tensor) -> Forecast:
    """Convert outcomes (n, 3) from contact frames and unit lengths to object frame and metres."""
    normal = torch.from_numpy(pushes.normal).float()
    axes = torch.stack([normal, quarter_turn(normal)], 1)
    metres = gyration_radius_m(pushes.outline_m)
    xy = (mean[:, None, :2] @ axes)[:, 0] * metres
    spread = (std[:, None, :2].square() @ axes.square())[:, 0].sqrt() * metres
    both = torch.cat([xy, mean[:, 2:]], 1), torch.cat([spread, std[:, 2:]], 1)
    return both[0].double().numpy(), both[1].double().numpy()


@dataclass
class FittedModel:
    """A model of the pushes of one object: its name in `MODELS`, its log, and what it learned."""

    name: str
    data: LoggedPushes
    state: State

    def predict(self, pushes: Pushes) -> Forecast:
        """Mean and σ (n, 3) of displacement [m] and rotation [rad], in the object's frame.

        Raises ValueError for pushes of another object, or with a tool of another radius.
        """
        own, other = (np.append(p.outline_m, p.tool_radius_m) for p in (self.data, pushes))
        if own.shape != other.shape or not np.allclose(own, other, atol=1e-6):
            raise ValueError("pushes: their outline_m or tool_radius_m is not that of the log")
        mean, std = MODELS[self.name](self.data, pushes, self.state)
        far = pushes.length_m / (FAR * self.data.length_m.max())
        if far.max() > 1:
            warnings.warn(
                f"pushes of {pushes.length_m.max():.3g} m are much longer than those of the log, "
                f"at most {self.data.length_m.max():.3g} m; their σ is widened",
                stacklevel=2,
            )
        return mean, std * np.maximum(1, far)[:, None]


def _in_metres(pushes: Pushes, mean: np.ndarray, std: np.ndarray) -> Forecast:
    scale = [*[gyration_radius_m(pushes.outline_m)] * 2, 1.0]
    return mean * scale, np.broadcast_to(std, mean.shape) * scale


def _features(pushes: Pushes, like: Pushes, of_rows: Sequence[int] = (0, 1, 4, 5)) -> np.ndarray:
    """Contact point and direction (n, 4 + c), and length and context if they differ in `like`."""
    columns = [push_rows(pushes)[:, list(of_rows)].double().numpy()]
    if like.length_m.std() > 0.05 * like.length_m.mean():
        columns.append(pushes.length_m[:, None] / gyration_radius_m(pushes.outline_m))
    for name in sorted(like.context.keys() - {"feet"}):
        given, seen = (p.context[name].reshape(len(p), -1).T for p in (pushes, like))
        for values, known in zip(given, map(np.unique, seen), strict=True):
            if len(known) > 1 and values.dtype.kind == "U":
                columns.append((values[:, None] == known).astype(float))
            elif len(known) > 1:
                columns.append(((values - known.mean()) / known.std())[:, None])
    return np.hstack(columns)


def _outcome(data: LoggedPushes) -> np.ndarray:
    return push_rows(data)[:, 7:].double().numpy()


def _turned(direction: np.ndarray, outcome: np.ndarray) -> np.ndarray:
    """Rotate outcomes (n, 3) so that their x axis becomes the directions (n, 2)."""
    (c, s), (x, y, turn) = direction.T, outcome.T
    return np.column_stack([c * x - s * y, s * x + c * y, turn])


def _constant(data: LoggedPushes, pushes: Pushes, state: State) -> Forecast:
    ahead = _turned(data.direction * [1, -1], _outcome(data))
    mean, (x, y, turn) = ahead.mean(axis=0), ahead.std(axis=0)
    of_all = _turned(pushes.direction, np.tile(mean, (len(pushes), 1)))
    return _in_metres(pushes, of_all, np.array([*[np.hypot(x, y) / 2**0.5] * 2, turn]))


def _nearest(data: LoggedPushes, pushes: Pushes, state: State) -> Forecast:
    known, outcome = _features(data, data), _outcome(data)
    nearest = KNeighborsRegressor(1).fit(known, outcome)
    std = (outcome[nearest.kneighbors(return_distance=False)[:, 0]] - outcome).std(axis=0)
    return _in_metres(pushes, nearest.predict(_features(pushes, data)), std)


def _ridge(data: LoggedPushes, pushes: Pushes, state: State) -> Forecast:
    parts = PolynomialFeatures(2), StandardScaler(), RidgeCV(np.logspace(-3, 2, 11))
    known, outcome = _features(data, data), _outcome(data)
    ridge = make_pipeline(*parts).fit(known, outcome)
    std = (outcome - ridge.predict(known)).std(axis=0)
    return _in_metres(pushes, ridge.predict(_features(pushes, data)), std)


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


@lru_cache(maxsize=6)
def _process(known: bytes, target: bytes, theta: tuple[float, ...] = (), rate: bool = False) -> Any:
    """A Gaussian process of a target (n,) on inputs (n, c); theta: its parameters, if known."""
    each = np.frombuffer(target)
    inputs = np.frombuffer(known).reshape(len(each), -1)
    widths = [1.0] * inputs.shape[1], (1e-2, 1e4)
    smooth = Matern(*widths, nu=2.5) if rate else RBF(*widths)
    noise = WhiteKernel(0.01, (1e-8, 1.0)) if rate else WhiteKernel(0.1)
    prior, about = ConstantKernel() * smooth + noise, {"normalize_y": True}
    if theta:
        prior, about = prior.clone_with_theta(np.array(theta)), about | {"optimizer": None}
    return GaussianProcessRegressor(prior, **about).fit(inputs, each)


def _processes(
    data: LoggedPushes, target: np.ndarray, pushes: Pushes, state: State, rate: bool = False
) -> tuple[np.ndarray, np.ndarray]:
    """Mean and σ (n, 3) of Gaussian processes of a target, learned from mirrored pushes as well.

    rate: of the target per length, with a rougher kernel, and of the normal too.
    """
    columns = [0, 1, 2, 3, 4, 5] if rate else [0, 1, 4, 5]
    rows, known = push_rows(data), [_features(data, data, columns)]
    rows[:, 7:], targets = torch.from_numpy(target), [target]
    for mirror in mirrors(data.outline_m):
        image = transformed(rows[None], torch.from_numpy(mirror)[None].float())[0].double()
        known.append(np.hstack([image[:, columns].numpy(), known[0][:, len(columns) :]]))
        targets.append(image[:, 7:].numpy())
    per = [push_rows(p)[:, 6:7].double().numpy() if rate else 1.0 for p in (data, pushes)]
    known, targets = np.vstack(known), np.vstack([each / per[0] for each in targets]).T
    if "theta" not in state:
        some = slice(None, None, 1 + len(known) // MOST_FITTED if rate else 1)
        with warnings.catch_warnings():  # the length scale of an irrelevant feature hits its bound
            warnings.simplefilter("ignore", ConvergenceWarning)
            free = [_process(known[some].tobytes(), t[some].tobytes(), (), rate) for t in targets]
        state["theta"] = np.stack([process.kernel_.theta for process in free])
    queried, found = _features(pushes, data, columns), []
    for theta, each in zip(state["theta"], targets, strict=True):
        process = _process(known.tobytes(), each.tobytes(), tuple(theta.tolist()), rate)
        found.append(process.predict(queried, return_std=True))
    mean, std = (np.column_stack(v) for v in zip(*found, strict=True))
    return mean * per[1], std * per[1]


def _gaussian_process(
    data: LoggedPushes, pushes: Pushes, state: State, rate: bool = False
) -> Forecast:
    return _in_metres(pushes, *_processes(data, _outcome(data), pushes, state, rate))


def _physics(
    data: LoggedPushes, pushes: Pushes, state: State, feet: bool = False, process: bool = False
) -> Forecast:
    """A pusher fitted to each group, or to all pushes for a group that is not in the log."""
    means = [np.zeros((len(log), 3)) for log in (data, pushes)]
    for log, mean in zip((data, pushes), means, strict=True):
        for group in np.unique(log.groups):
            if (key := f"pusher {group}") not in state:
                known = data.groups == group
                fitted = data.select(known if known.any() else ~known)
                rows, support = push_rows(fitted), known_feet(fitted)[0] if feet else None
                found = AnalyticPusher.fitted(rows[:, :7], rows[:, 7:], support)
                state[key] = np.array([found.friction, found.size])
            some = log.select(log.groups == group)
            pusher = AnalyticPusher(*state[key].tolist())
            support = known_feet(some)[0] if feet else None
            mean[log.groups == group] = pusher.predict(push_rows(some)[:, :7], support).numpy()
    left = _outcome(data) - means[0]
    if not process:
        return _in_metres(pushes, means[1], np.sqrt((left**2).mean(axis=0)))
    beyond, std = _processes(data, left, pushes, state)
    return _in_metres(pushes, means[1] + beyond, std)


def _neural_process(data: LoggedPushes, pushes: Pushes, state: State) -> Forecast:
    """The pretrained neural process, fine-tuned on a log, which is also its context.

    Each of `INNER_FOLDS` copies is fine-tuned on all but one fold of the log. Predictions are the
    mean over the copies; their residuals on the held-out folds scale σ.
    """
    members = torch.nn.ModuleList(load_neural_process() for _ in range(INNER_FOLDS))
    if "sigma_scale" not in state:
        seed = int(state["seed"])
        fold = folds_of(data.groups, INNER_FOLDS, seed)
        off = [_tuned(model, data, fold != k, seed) for k, model in enumerate(members)]
        state["sigma_scale"] = sigma_scale(torch.cat(off)).numpy()
        state |= {f"member {name}": v.numpy() for name, v in members.state_dict().items()}
    learned = {name: torch.from_numpy(state[f"member {name}"]) for name in members.state_dict()}
    members.load_state_dict(learned)
    both = [_predicted(model, data, pushes) for model in members]
    mean, std = (torch.stack(v).mean(0) for v in zip(*both, strict=True))
    return in_object_frame(pushes, mean, std * torch.from_numpy(state["sigma_scale"]))


def _tuned(model: NeuralProcess, data: LoggedPushes, kept: np.ndarray, seed: int) -> Tensor:
    """Fine-tune on the kept part (n,) of a log; residuals of the rest, in units of σ."""
    rows, feet = push_rows(data), known_feet(data)
    some = [kept & (data.groups == group) for group in np.unique(data.groups)]
    if some := [of_group for of_group in some if of_group.sum() > 1]:
        of_tasks = torch.stack([feet[of_group][0] for of_group in some])
        tasks, generator = [rows[of_group] for of_group in some], torch.Generator()
        effort = EFFORT["few" if len(data) < FEW else "many"]
        train_neural_process(model, tasks, of_tasks, effort, generator.manual_seed(seed))
    mean, std = _predicted(model, data.select(kept), data.select(~kept))
    return (in_contact_frame(rows[~kept], rows[~kept, 7:]) - mean) / std


def _predicted(model: NeuralProcess, data: LoggedPushes, pushes: Pushes) -> tuple[Tensor, Tensor]:
    """Mean and σ (n, 3) in the contact frames, given the pushes of the same group as context."""
    rows, feet, log = push_rows(pushes), known_feet(pushes), push_rows(data)
    mean, std = torch.zeros(len(rows), 3), torch.zeros(len(rows), 3)
    for group in np.unique(pushes.groups):
        known = np.flatnonzero(data.groups == group)
        few = np.linspace(0, len(known) - 1, min(len(known), MOST_CONTEXT)).round().astype(int)
        query = torch.from_numpy(pushes.groups == group)
        mean[query], std[query] = model.predict(rows[query, :7], log[known[few]], feet[query][0])
    return mean, std


def sigma_scale(off: Tensor) -> Tensor:
    """Factors (3,) on σ that match the 50 and 90 % intervals of residuals (n, 3), in units of σ."""
    both = off[:, :2].abs().flatten(), off[:, 2].abs()
    xy, turn = ((z.quantile(0.5) / 0.6745 * z.quantile(0.9) / 1.6449).sqrt() for z in both)
    return torch.stack([xy, xy, turn])


def folds_of(groups: np.ndarray, k: int, seed: int) -> np.ndarray:
    """Fold (n,) of each push, drawn at random within its group."""
    rng, fold = np.random.default_rng(seed), np.zeros(len(groups), dtype=int)
    for group in np.unique(groups):
        of_group = groups == group
        fold[of_group] = rng.permutation(of_group.sum()) % k
    return fold


MODELS: dict[str, Callable[[LoggedPushes, Pushes, State], Forecast]] = {
    "constant": _constant,
    "nearest": _nearest,
    "ridge": _ridge,
    "gaussian_process": _gaussian_process,
    "rate_gp": partial(_gaussian_process, rate=True),
    "physics": _physics,
    "physics_gp": partial(_physics, process=True),
    "physics_feet": partial(_physics, feet=True),
    "physics_feet_gp": partial(_physics, feet=True, process=True),
    "np": _neural_process,
}
BASELINES = tuple(name for name in MODELS if name not in ("rate_gp", "np"))


def fit(data: LoggedPushes, model: str = "np", seed: int = 0) -> FittedModel:
    """Fit a model to a log, by its name in `MODELS`; "np" takes 6 to 20 s for 40 pushes.

    Raises ValueError for an unknown name, for fewer than eight pushes in all, and for a model that
    needs feet without `context["feet"]`.
    """
    check_choice("model", model, MODELS)
    if len(data) < 8 or ("feet" in model and "feet" not in data.context):
        raise ValueError(
            f"data must hold at least 8 pushes to learn from, got {len(data)}, and context['feet'] "
            "for a model with feet"
        )
    fitted = FittedModel(model, data, {"seed": np.array(check_count("seed", seed, 0, 2**31))})
    fitted.predict(data)  # and so learn
    return fitted


def save_model(model: FittedModel, path: str | Path) -> Path:
    """Write a fitted model and its log to a .safetensors file atomically; returns its path."""
    arrays = {f"data.{f.name}": getattr(model.data, f.name) for f in fields(model.data)}
    for prefix, values in (("context", arrays.pop("data.context")), ("state", model.state)):
        arrays |= {f"{prefix}.{name}": value for name, value in values.items()}
    texts = {n: v.tolist() for n, v in arrays.items() if np.asarray(v).dtype.kind == "U"}
    numbers = {n: torch.tensor(v) for n, v in arrays.items() if n not in texts}
    return write_weights(path, numbers, {"format": FORMAT, "model": model.name, "texts": texts})


def load_model(path: str | Path) -> FittedModel:
    """Load what `save_model` wrote, which predicts the same; ValueError if it is damaged."""

    def made(tensors, about):
        if about.get("format") != FORMAT:
            raise ValueError("it holds no model of pushes; give one that save_model wrote")
        arrays = {name: value.numpy() for name, value in tensors.items()}
        arrays |= {name: np.array(values) for name, values in about["texts"].items()}
        parts: dict[str, State] = {"data": {}, "context": {}, "state": {}}
        for name, values in arrays.items():
            part, _, name = name.partition(".")
            parts[part][name] = values
        radius_m = float(parts["data"].pop("tool_radius_m"))
        data = LoggedPushes(**parts["data"], context=parts["context"], tool_radius_m=radius_m)
        return FittedModel(check_choice("model", about["model"], MODELS), data, parts["state"])

    return read_weights(path, "fit the model to its log again", made)
