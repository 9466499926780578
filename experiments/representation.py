"""Studies of learned representations: the latent space, rollability, and the choice of a primitive.

latent: similarity of the codes r of an action and of its effect, and the influence of w₁.
rollability: predicts from the depth image whether an object rolls, with a learned model and with a
rule on curvature. push_and_drag_model: the paper's single model of pushes and drags, which decodes
from the desired effect which of the two an object needs.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import torch
import xarray as xr
from jaxtyping import Float
from torch import Tensor, nn

from affordlib.interactions import InteractionTensors, open_interactions, split_interactions
from affordlib.interactions.dataset import valid_interactions
from affordlib.models.checkpoint import load_checkpoint
from affordlib.models.film import CircularHarmonics, FiLMConfig, dense
from affordlib.models.predictions import about_objects
from affordlib.models.protocol import condition_on_final_effect
from affordlib.models.push_frame import inverse, push_direction, rotate_observations
from affordlib.models.training import final_errors_m, train_model
from affordlib.perception import looks_rollable
from affordlib.types import Observations
from experiments.runner import Rows, study
from experiments.shipped import CHECKPOINT_SPECS

TRAINING = replace(CHECKPOINT_SPECS["film_500"].training, steps=1500)
"""Training of `push_and_drag_model` and `perturbed_world`, shorter than for shipped networks."""

LATENT_MODELS = ("cnp_500", "film_500")
WEIGHTS = (0.25, 0.5, 0.75)
PUSH_START_MIN_RADIUS_M = 0.1
"""Distance [m] of a decoded action's start from the object above which it is a push, not a drag."""


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


class Rollability(nn.Module):
    """Predicts P(rolls) for the object in an image (B, 2, 48, 48); see `learn_rollability`."""

    def __init__(self, image_mean: Tensor, image_std: Tensor, width: int = 32) -> None:
        super().__init__()
        self.harmonics = CircularHarmonics(orders=4)
        self.register_buffer("image_mean", image_mean)
        self.register_buffer("image_std", image_std)
        self.head = nn.Sequential(*dense(self.harmonics.n_features, width, width, 1))

    def image_features(self, image: Float[Tensor, "b 2 48 48"]) -> Float[Tensor, "b f"]:
        """Return the circular harmonics (B, F) of standardised depth and mask."""
        mean, std = (v[:, None, None] for v in (self.image_mean, self.image_std))
        return self.harmonics((image - mean) / std)

    def forward(self, image: Float[Tensor, "b 2 48 48"]) -> Float[Tensor, " b"]:
        """Return P(rolls) (B,)."""
        return torch.sigmoid(self.head(self.image_features(image)).squeeze(1))


def learn_rollability(
    data: xr.Dataset, interactions: np.ndarray, steps: int = 400, seed: int = 0
) -> Rollability:
    """Train on the images of interactions and whether their objects are rollable (in seconds)."""
    images = torch.from_numpy(data["image"].values[interactions])
    rolls = torch.from_numpy(data["rollable"].values[interactions].astype(np.float32))
    if not 0 < rolls.mean() < 1:
        raise ValueError("interactions must be of objects that roll and of objects that do not")
    torch.manual_seed(seed)
    generator = torch.Generator().manual_seed(seed)
    std = images.std(dim=(0, 2, 3)).clamp_min(1e-6)
    model = Rollability(images.mean(dim=(0, 2, 3)), std)
    seen = model.image_features(images)
    optimiser = torch.optim.AdamW(model.parameters(), 3e-3, weight_decay=0.1)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, steps)
    for _ in range(steps):
        rows = torch.randint(len(seen), (128,), generator=generator)
        angle = math.tau * torch.rand(len(rows), generator=generator)
        turned = model.harmonics.rotated(seen[rows], torch.stack([angle.cos(), angle.sin()], dim=1))
        logit = model.head(turned).squeeze(1)
        loss = nn.functional.binary_cross_entropy_with_logits(logit, rolls[rows])
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        schedule.step()
    return model.eval()


ROLLING = ("mixed", "partial", "push_test", "drag", "reach")


@study(*ROLLING)
def rollability() -> Rows:
    """Measure the accuracy of rollability, learned from 400 images of `mixed` and by curvature."""
    mixed = open_interactions("mixed")
    split = split_interactions(mixed.sizes["interaction"])
    model = learn_rollability(mixed, split.train)
    rows = []
    for name in ROLLING:
        data = open_interactions(name)
        chosen = split.test if name == "mixed" else np.arange(data.sizes["interaction"])
        images, rolls = data["image"].values[chosen], data["rollable"].values[chosen]
        with torch.no_grad():
            learned = model(torch.from_numpy(images)).numpy() > 0.5
        rule = np.array([looks_rollable(image) for image in images])
        category = np.array(about_objects(data, chosen)["family"])
        for kind in ("all", *np.unique(category)):
            of = (category == kind) | (kind == "all")
            rows.append(
                {
                    "test": name,
                    "object_class": str(kind),
                    "n": int(of.sum()),
                    "learned_percent": 100 * float((learned == rolls)[of].mean()),
                    "curvature_percent": 100 * float((rule == rolls)[of].mean()),
                }
            )
    return rows


@study("mixed", "partial", settings=(TRAINING, FiLMConfig(), PUSH_START_MIN_RADIUS_M))
def push_and_drag_model() -> Rows:
    """Measure how often a model of pushes and drags decodes the right one from a desired effect.

    The desired effects are random directions with the median length of drags or pushes, for objects
    of `partial`, on which the model was not trained. The primitive is not an input.
    """
    data, other = open_interactions("mixed"), open_interactions("partial")
    split = split_interactions(data.sizes["interaction"])
    model, _ = train_model(data, split, TRAINING, FiLMConfig())
    arrays, rolls = _seen_and_rolls(data, split.train)
    length = arrays.effect[:, -1].norm(dim=-1)
    usual_m = [float(length[torch.from_numpy(rolls == kind)].median()) for kind in (True, False)]
    test, forward = _seen_and_rolls(data, split.test)
    errors = final_errors_m(model, test).numpy()
    new, rolls = _seen_and_rolls(other, np.arange(other.sizes["interaction"]))
    features, start, rows = model.encode(new.image), torch.zeros(len(new), 1), []
    for wanted_m in usual_m:
        wanted = condition_on_final_effect(model, wanted_m * _unit_vectors(len(new)))
        with torch.no_grad():
            action = model.predict(features, wanted, start).action_mean[:, 0]
        pushes = (action.norm(dim=-1) > PUSH_START_MIN_RADIUS_M).numpy()
        for kind in (False, True):
            row = {"rollable": kind, "n": int((rolls == kind).sum()), "wanted_mean_m": wanted_m}
            row["behaviour_right_percent"] = 100 * float((pushes != kind)[rolls == kind].mean())
            row["n_forward"] = int((forward == kind).sum())
            row["final_error_mean_m"] = float(errors[forward == kind].mean())
            rows.append(row)
    return rows


def _seen_and_rolls(data: xr.Dataset, rows: np.ndarray) -> tuple[InteractionTensors, np.ndarray]:
    """Return valid interactions, and whether their objects are rollable."""
    rolls = data["rollable"].values[valid_interactions(data, rows)]
    return InteractionTensors.from_dataset(data, rows), rolls


def _unit_vectors(n: int) -> torch.Tensor:
    angle = math.tau * torch.rand(n, generator=torch.Generator().manual_seed(0))
    return torch.stack([angle.cos(), angle.sin()], dim=-1)
