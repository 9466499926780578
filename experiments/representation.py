"""A study of the latent space: similarity of the codes r of an action and of its effect, and w₁."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from affordlib.interactions import InteractionTensors, open_interactions
from affordlib.models.checkpoint import load_checkpoint
from affordlib.models.push_frame import inverse, push_direction, rotate_observations
from affordlib.types import Observations
from experiments.runner import Rows, study

LATENT_MODELS = ("cnp_500", "film_500")
WEIGHTS = (0.25, 0.5, 0.75)


def cka(a: torch.Tensor, b: torch.Tensor) -> float | None:
    """Return the linear centred kernel alignment (CKA) of codes (N, D) and (N, E).

    It is 1 for codes that are equal up to rotation, None if all codes are equal, as for actions in
    the push frame. Kornblith et al., Similarity of neural network representations revisited, 2019.
    """
    if min(v.std(dim=0).norm() / v.mean(dim=0).norm() for v in (a, b)) < 1e-3:
        return None
    a, b = (v - v.mean(dim=0) for v in (a.double(), b.double()))
    return float((a.T @ b).square().sum() / ((a.T @ a).norm() * (b.T @ b).norm()))


def _seen_by(arrays: InteractionTensors, observed: str, weight: float) -> Observations:
    """Return a context of the action at t = 0 and 1, the effect at t = 0.8 and 1, or both."""
    last = len(arrays.phase) - 1
    ends, late = torch.tensor([0, last]), torch.tensor([round(0.8 * last), last])
    action = None if observed == "effect" else arrays.action_at(ends)
    effect = None if observed == "action" else arrays.effect_at(late)
    return Observations.of(arrays, action, effect, torch.full((len(arrays),), weight))


def _code(model: Any, observed: Observations) -> Tensor:
    """Return a model's code (B, D) of observations, in its frame."""
    channels = model.action_channels, model.effect_channels
    if model.config.frame == "push":
        back = inverse(push_direction(observed, *channels))
        observed = rotate_observations(observed, back, *channels)
    return model.represent(observed)


@study("push_test", checkpoints=LATENT_MODELS, settings=WEIGHTS)
@torch.no_grad()
def latent() -> Rows:
    """Measure the alignment of the codes r on `push_test`, and errors of predictions from them."""
    data, rows = open_interactions("push_test"), []
    for name in LATENT_MODELS:
        model, _ = load_checkpoint(name)
        arrays = InteractionTensors.from_dataset(
            data, None, model.action_channels, model.effect_channels
        )
        features, ends = model.encode(arrays.image), torch.tensor([[0.0, 1.0]] * len(arrays))
        r_a, r_e = (_code(model, _seen_by(arrays, *one)) for one in (("action", 1), ("effect", 0)))
        for what, weight in (("action", 1.0), ("effect", 0.0), *(("both", w) for w in WEIGHTS)):
            observed = _seen_by(arrays, what, weight)
            predicted = model.predict(features, observed, ends)
            start = predicted.action_mean[:, 0, :2] - arrays.action[:, 0, :2]
            end = predicted.effect_mean[:, 1, :2] - arrays.effect[:, -1, :2]
            row = {"model": name, "observed": what, "w_1": weight, "n": len(arrays)}
            alike = torch.cosine_similarity(_code(model, observed), r_a)
            row["cosine_to_action"] = float(alike.mean())
            row["cka_action_effect"] = cka(r_a, r_e)
            row["action_start_mean_m"] = float(start.norm(dim=-1).mean())
            rows.append(row | {"final_error_mean_m": float(end.norm(dim=-1).mean())})
    return rows
