"""Novelty detection: does a model recognise objects that are unlike its training objects?

σ covers the noise in the training data, not the novelty of an object. `Novelty` is the distance of
an image to its nearest training image (Sun et al., Out-of-distribution detection with deep nearest
neighbors, ICML 2022) in circular harmonics, since learned features discard what training did not
need. Object categories that no model has seen are used: some to choose the novelty score and the
growth of σ, the others only to test them. Their pushes are collected into runs/strangers.
"""

import hashlib
import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from itertools import product
from typing import Any, ClassVar

import numpy as np
import pybullet
import torch
from scipy.spatial import ConvexHull, Delaunay
from torch import Tensor

from affordlib.geometry import xy_columns
from affordlib.interactions import InteractionTensors, open_interactions, split_interactions
from affordlib.interactions.collect import collect
from affordlib.interactions.recipes import Recipe
from affordlib.models import EffectNetwork, load_checkpoint
from affordlib.models import evaluation as c
from affordlib.models.film import CircularHarmonics
from affordlib.results import resolve_out_dir, write_atomically
from affordlib.types import Observations, Prediction
from affordlib.world import CATEGORIES, TabletopObject
from experiments.runner import Rows
from experiments.shipped import data_of

N_PUSHES = 150
FOLDER = "runs/strangers"


def solid(outline: Any, low: float = 0, high: float = 1, top: Any = None) -> np.ndarray:
    """Return corners of a convex solid over an outline (n, 2), with another one as top if given."""
    levels = (outline, low), (outline if top is None else top, high)
    return np.vstack([np.insert(np.array(points, float), 2, z, axis=1) for points, z in levels])


def box(x0: float, x1: float, y0: float, y1: float) -> list[tuple[float, float]]:
    """Return the corners of a rectangle."""
    return [(x, y) for x in (x0, x1) for y in (y0, y1)]


def ring(radii: Any, turns: Any) -> np.ndarray:
    """Return points (n, 2) around the centre at angles given in full turns."""
    angle = 2 * math.pi * np.array(turns)
    return (radii * np.stack([np.cos(angle), np.sin(angle)])).T


def boxes(*each: tuple[float, float, float, float]) -> list[np.ndarray]:
    """Return boxes of full height over rectangles."""
    return [solid(box(*edges)) for edges in each]


SQUARE, CIRCLE = box(-0.5, 0.5, -0.5, 0.5), np.arange(24) / 24
KITE, CORNERS = np.array([0, -0.1, 0, 0.1]), ring(math.sqrt(0.5), np.arange(0.125, 1, 0.25))
PARTS = {
    "house": [solid([(-0.5, -0.5), (0.5, -0.5), (0.5, 0.2), (0.0, 0.5), (-0.5, 0.2)])],
    "t_shape": boxes((-0.5, 0.5, 0.15, 0.5), (-0.17, 0.17, -0.5, 0.15)),
    "wedge": [solid(SQUARE, top=box(-0.5, -0.4, -0.5, 0.5))],
    "l_shape": boxes((-0.5, 0.5, -0.5, -0.1), (-0.5, -0.1, -0.1, 0.5)),
    "cross": boxes((-0.5, 0.5, -0.17, 0.17), (-0.17, 0.17, -0.5, -0.17), (-0.17, 0.17, 0.17, 0.5)),
    "star": [solid(ring([0, 0.25, 0.5, 0.25], KITE + k / 5)) for k in range(5)],
    "mug": [solid(ring(0.35, CIRCLE)), solid(box(0.3, 0.55, -0.07, 0.07), 0.2, 0.8)],
    "step": [*boxes((-0.5, 0, -0.5, 0.5)), solid(box(0, 0.5, -0.5, 0.5), 0, 0.5)],
    "pyramid": [solid(CORNERS, top=0.3 * CORNERS)],
    "u_shape": boxes((-0.5, 0.5, -0.5, -0.2), (-0.5, -0.2, -0.2, 0.5), (0.2, 0.5, -0.2, 0.5)),
    "z_shape": boxes(
        (-0.5, 0.15, 0.17, 0.5), (-0.17, 0.17, -0.17, 0.17), (-0.15, 0.5, -0.5, -0.17)
    ),
    "arrow": [solid([(-0.5, 0), (0.5, 0), (0, 0.5)]), *boxes((-0.2, 0.2, -0.5, 0))],
    "cone": [solid(ring(0.5, CIRCLE), top=ring(0.1, CIRCLE))],
    "roof": [solid(SQUARE, top=box(-0.05, 0.05, -0.5, 0.5))],
    "dumbbell": boxes((-0.5, -0.2, -0.5, 0.5), (-0.2, 0.2, -0.15, 0.15), (0.2, 0.5, -0.5, 0.5)),
}
"""Convex parts of each category, which are scaled to length, width and height."""
CHOOSE = ("house", "t_shape", "wedge", "prism")
FIRST = ("l_shape", "cross", "star", "mug", "step", "pyramid")
SECOND = ("u_shape", "z_shape", "arrow", "cone", "roof", "dumbbell")
ROLL = ("lying_cylinder", "sphere")
"""CHOOSE: to choose the score and the growth of σ; FIRST: on these a first choice, linear growth,
failed; SECOND: to test the later choice; ROLL: rollable ones, whose rolling no score predicts."""


def body_of(parts: Iterable[tuple[Any, np.ndarray]]) -> dict[str, Any]:
    """Write corners and triangles of convex parts to one file, of which Bullet makes one body."""
    lines, n = [], 1
    for corners, triangles in parts:
        lines += ["o part", *(f"v {x:.6f} {y:.6f} {z:.6f}" for x, y, z in corners)]
        lines += [f"f {i} {j} {k}" for i, j, k in triangles + n]
        n += len(corners)
    text = "\n".join(lines)
    path = resolve_out_dir(FOLDER) / f"{hashlib.sha256(text.encode()).hexdigest()}.obj"
    write_atomically(path, text)
    return {"shapeType": pybullet.GEOM_MESH, "fileName": str(path)}


@dataclass(frozen=True)
class Stranger(TabletopObject):
    """A rigid object of convex parts; its origin is on the vertical through its centre of mass."""

    length: float
    width: float
    height: float

    parts: ClassVar[list[np.ndarray]]

    def solids(self, inset_m: float = 0.0) -> tuple[list[np.ndarray], float]:
        """Return the corners of the parts, with faces inset, and their total volume [m³]."""
        parts = [part * (self.length, self.width, self.height) for part in self.parts]
        corners = np.concatenate([part[Delaunay(part).simplices] for part in parts])
        volumes = np.abs(np.linalg.det(corners[:, 1:] - corners[:, :1])) / 6
        centre = np.average(corners.mean(axis=1), axis=0, weights=volumes)
        centre[2] = self.height / 2
        middles = [(part.min(axis=0) + part.max(axis=0)) / 2 for part in parts]
        shares = [1 - 2 * inset_m / np.ptp(part, axis=0) for part in parts]
        found = zip(parts, middles, shares, strict=True)
        return [(p - at) * k + at - centre for p, at, k in found], float(volumes.sum())

    volume_m3 = property(lambda self: self.solids()[1])
    footprint_m = property(lambda self: np.vstack(self.solids()[0])[:, :2])

    def shape(self) -> dict[str, Any]:
        parts = self.solids(0.001)[0]
        felt = body_of((part, ConvexHull(part).simplices) for part in parts)
        return felt | {"seen": self.solids()[0]}


NOVELTY_GAIN = 0.0167  # c of `NoveltyAware`, chosen by `novelty_gain`


class Novelty:
    """Distance (N,) of images to their nearest training image, in units of `limit`.

    references: spectra (n, f) of the first 500 training images. limit: 99 % of them are closer than
    this to their nearest other reference.
    """

    def __init__(self, images: Tensor) -> None:
        self.harmonics = CircularHarmonics()
        self.references = references = self.spectra(images[:500])
        spread = references.std(dim=0).reshape(2, -1)
        # A spread below 1 % of the largest spread of its image channel is pixel noise.
        self.spread = spread.maximum(0.01 * spread.amax(dim=1, keepdim=True)).flatten()
        self.limit = self.distances(references, 2)[:, 1].quantile(0.99)

    def spectra(self, images: Tensor) -> Tensor:
        """Norms (n, f) of the harmonics' pairs of cosine and sine, invariant to rotation."""
        pairs = self.harmonics(images).reshape(-1, *self.harmonics.layout)
        return pairs.norm(dim=2).flatten(1)

    def distances(self, spectra: Tensor, n: int = 1) -> Tensor:
        """Distances (N, n) to the nearest n references."""
        a, b = spectra / self.spread, self.references / self.spread
        exact = "donot_use_mm_for_euclid_dist"
        return torch.cdist(a, b, compute_mode=exact).topk(n, largest=False).values

    @torch.no_grad()
    def __call__(self, image: Tensor) -> Tensor:
        return self.distances(self.spectra(image))[:, 0] / self.limit


class NoveltyAware:
    """A model of pushes whose σ grows with an object's novelty; satisfies `EffectModel`.

    σ² grows by (c m s)² n. n: novelty in excess of 1 (0 for known objects); m: predicted distance
    moved, in scales of x and y; s: the scale of the channel; c: `NOVELTY_GAIN`.
    """

    def __init__(self, model: EffectNetwork, novelty: Novelty) -> None:
        self.model, self.novelty = model, novelty
        self.action_channels, self.effect_channels = model.action_channels, model.effect_channels

    def encode(self, image: Tensor) -> Tensor:
        """Features (B, F + 1) of images (B, 2, 48, 48): those of the model, and √n."""
        root = (self.novelty(image) - 1).clamp_min(0).sqrt()
        return torch.cat([self.model.encode(image), root[:, None]], dim=1)

    def predict(self, features: Tensor, observations: Observations, t_target: Tensor) -> Prediction:
        """The model's prediction, with σ of the effect increased by novelty."""
        p = self.model.predict(features[:, :-1], observations, t_target)
        plane, scale = xy_columns(self.effect_channels), self.model.effect_scale
        moved = (p.effect_mean[..., plane] / scale[plane]).norm(dim=-1, keepdim=True)
        more = NOVELTY_GAIN * features[:, -1:, None] * moved * scale
        return replace(p, effect_std=torch.hypot(p.effect_std, more))


def novelty_of(name: str) -> Novelty:
    """Return the novelty for a shipped checkpoint, from the images that it was trained on."""
    data = open_interactions(data_of(name))
    split = split_interactions(data.sizes["interaction"])
    return Novelty(InteractionTensors.from_dataset(data, split.train).image)


MODELS = ("film_500", "film_5000", "cnp_500", "lstm_500")
SETTINGS = (N_PUSHES, *CHOOSE, *ROLL, *FIRST, *SECOND)


def tensors(data: Any, model: Any) -> InteractionTensors:
    """Return tensors of all interactions with a model's channels."""
    return InteractionTensors.from_dataset(data, None, model.action_channels, model.effect_channels)


def strangers(category: str, model: Any) -> InteractionTensors:
    """Collect pushes of a category, without objects that are too small for a model."""
    if category not in CATEGORIES:
        about = {"category": category, "parts": PARTS[category]}
        CATEGORIES[category] = type(category, (Stranger,), about)
    recipe = Recipe(("push",), N_PUSHES, 1_000_025, (category,), size_range_m=(0.05, 0.08))
    path = resolve_out_dir(FOLDER) / f"{category}.zarr.zip"
    every = tensors(open_interactions(collect(recipe, path, progress=False)), model)
    return every.select(every.image[:, 1].mean(dim=(1, 2)) > model.domain.mask_share[0] / 2)


def final(model: Any, pushes: InteractionTensors) -> tuple[Tensor, Tensor, Tensor]:
    """Return ground truth, mean and σ (N, 2) of x and y at t = 1."""
    return tuple(value[:, 0, :2] for value in c.effects_at(model, pushes, (1.0,)))


def novelty_gain() -> Rows:
    """Fit the gain of σ's growth so that at most 1 % of any category and model are beyond 2σ."""
    needed = []
    for name, category in product(MODELS[:3], CHOOSE):
        model = load_checkpoint(name)[0]
        pushes = strangers(category, model)
        beyond = (novelty_of(name)(pushes.image) - 1).clamp_min(0)
        truth, mean, std = final(model, pushes)
        lacking = (mean - truth).square().sum(dim=1) / 4 - std.square().sum(dim=1)
        each = (lacking.clamp_min(0) / 2).sqrt() / (beyond.sqrt() * mean.norm(dim=1))
        needed.append(float(each.quantile(0.99)))
    return [{"gain": max(needed)}]


def novelty_judged() -> Rows:
    """Evaluate σ, unchanged and grown, on known objects and on unused categories."""
    rows, categories = [], ("known", *FIRST, *SECOND, *ROLL)
    parts = {k: (k,) for k in categories} | {"first_six": FIRST, "second_six": SECOND}
    for name in MODELS:
        model, novelty_by, found = load_checkpoint(name)[0], novelty_of(name), {}
        known = tensors(open_interactions("push_test"), model)
        for category in categories:
            pushes = known if category == "known" else strangers(category, model)
            novelty, (truth, mean, std) = novelty_by(pushes.image), final(model, pushes)
            aware = final(NoveltyAware(model, novelty_by), pushes)[2]
            found[category] = novelty, truth, mean, std, aware
        for objects, members in parts.items():
            every = zip(*(found[member] for member in members), strict=True)
            novelty, truth, mean, std, aware = map(torch.cat, every)
            row = {"model": name, "objects": objects, "n": len(novelty), "auc": None}
            if objects != "known":
                above = found["known"][0][:, None] < novelty
                row["auc"] = float(above.double().mean())
            off = (mean - truth).norm(dim=1)
            row["error_mean_m"] = float(off.mean())
            for kind, sigma in (("", std), ("aware_", aware)):
                row[f"{kind}sigma_median_m"] = float(sigma.norm(dim=1).median())
                for k in (50, 90):
                    row[f"{kind}coverage_{k}"] = c.coverage(truth, mean, sigma, k / 100)
                beyond = (off > 2 * sigma.norm(dim=1)).double()
                row[f"{kind}beyond_2_sigma_percent"] = 100 * float(beyond.mean())
            rows.append(row)
    return rows
