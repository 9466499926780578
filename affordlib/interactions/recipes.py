"""Recipes define how data sets are collected; interaction i is a pure function of (recipe, i)."""

import json
import math
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Self

import numpy as np

from affordlib.geometry import rotated
from affordlib.primitives import PRIMITIVES, primitive_named
from affordlib.types import TABLE_X_M, TABLE_Y_M, Checked, Interaction, count, number, span
from affordlib.world import CATEGORIES, Tabletop, TabletopObject, WorldConfig, category_named

_TABLE_MARGIN_M = 0.08


@dataclass(frozen=True)
class Variation(Checked):
    """A perturbed world: ranges of its parameters, sampled separately for every interaction."""

    table_friction: tuple[float, float] = span(0.01, 2.0, (0.35, 0.65))
    object_friction: tuple[float, float] = span(0.01, 2.0, (0.35, 0.65))
    finger_friction: tuple[float, float] = span(0.01, 2.0, (0.6, 1.2))
    density_kg_m3: tuple[float, float] = span(50.0, 10_000.0, (300.0, 1200.0))
    tip_offset_m: tuple[float, float] = span(-0.008, 0.1, (-0.003, 0.01))
    # Largest offset of the centre of mass, as a share of the half extents
    com_offset: float = number(0.0, 0.5, default=0.15)
    # Standard deviation of the estimated position, in addition to the camera's
    bias_sd_m: float = number(0.0, 0.02, "m", 0.001)
    camera: str = "kinect"

    def sample(self, obj: TabletopObject, rng: np.random.Generator) -> WorldConfig:
        """Sample the world parameters for one interaction with this object."""
        drawn = {name: float(rng.uniform(*getattr(self, name))) for name in _VARIED}
        half = np.array([*np.ptp(obj.footprint_m, axis=0), obj.height_m]) / 2
        offset = self.com_offset * half * rng.uniform(-1, 1, size=3)
        if obj.rollable:
            # Placed with its centre of mass higher, it would roll before anything touches it.
            along = np.array([offset[0] if obj.has_yaw else 0.0, 0.0, 0.0])
            offset = along - (0.0, 0.0, np.linalg.norm(offset - along))
        return WorldConfig(
            **drawn,
            com_offset_m=tuple(offset.tolist()),
            camera=self.camera,
            bias_m=tuple(rng.normal(0, self.bias_sd_m, size=2).tolist()),
            noise_seed=int(rng.integers(2**31)),
        )


_VARIED = ("table_friction", "object_friction", "finger_friction", "density_kg_m3", "tip_offset_m")


@dataclass(frozen=True)
class Recipe(Checked):
    """The definition of a data set: primitives, object categories, world and seed."""

    primitives: tuple[str, ...] = ("push",)  # an interaction uses one that suits its object
    n_interactions: int = count(500)
    seed: int = count(0, 0)
    categories: tuple[str, ...] = ("cuboid", "upright_cylinder")
    size_range_m: tuple[float, float] = span(0.005, 0.3, (0.04, 0.08))
    height_range_m: tuple[float, float] | None = span(0.005, 0.3, None)  # None: size_range_m
    anywhere: bool = False  # objects lie all over the table, within reach or not
    partial: bool = False  # actions stop at a random phase
    world: WorldConfig = field(default_factory=WorldConfig)
    variation: Variation | None = None  # a new world for each interaction

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, known in (("primitives", PRIMITIVES), ("categories", CATEGORIES)):
            values = tuple(getattr(self, name))
            if not values or not set(values) <= set(known):
                raise ValueError(f"{name} must be some of {sorted(known)}, got {values!r}")
            object.__setattr__(self, name, values)

    def to_json(self) -> str:
        """Return the recipe as JSON with sorted keys; categories are called families there."""
        fields = asdict(self)
        fields["families"] = fields.pop("categories")
        return json.dumps(fields, sort_keys=True)

    @classmethod
    def from_json(cls, text: str) -> Self:
        """Return the recipe from the text that `to_json` returned."""
        fields = json.loads(text)
        if "families" in fields:
            fields["categories"] = fields.pop("families")
        for name, kind in (("world", WorldConfig), ("variation", Variation)):
            if fields.get(name) is not None:
                fields[name] = kind(**fields[name])
        return cls(**fields)


_PLAIN = json.loads(Path(__file__).with_name("recipes.json").read_text(encoding="utf-8"))
RECIPES = {name: Recipe.from_json(json.dumps(fields)) for name, fields in _PLAIN.items()}
"""Recipes of the shipped sets by name: the paper's; a test set for no model's training; partial
executions, for tests only; a perturbed world; objects all over the table, within reach or not."""


def _generator(recipe: Recipe, index: int, *part: int) -> np.random.Generator:
    return np.random.default_rng(np.random.SeedSequence(recipe.seed, spawn_key=(index, *part)))


def sample_scene(recipe: Recipe, index: int) -> tuple[TabletopObject, float, np.random.Generator]:
    """Sample object and yaw [rad] of interaction `index`; return them and the random generator."""
    rng = _generator(recipe, index)
    category = category_named(recipe.categories[rng.integers(len(recipe.categories))])
    obj = category.sample(rng, recipe.size_range_m, recipe.height_range_m)
    return obj, float(rng.uniform(-math.pi, math.pi)), rng


def interact(
    recipe: Recipe, index: int, world: Tabletop, stop_phase: float | None = None
) -> tuple[TabletopObject, Interaction]:
    """Execute interaction `index` of a recipe, up to a phase (default: the recipe's).

    It is bit-identical in every process and order.
    """
    obj, yaw, rng = sample_scene(recipe, index)
    kinds = [primitive_named(name) for name in recipe.primitives]
    kinds = [kind for kind in kinds if kind.rollable in (None, obj.rollable)] or kinds
    kind = kinds[rng.integers(len(kinds)) if len(kinds) > 1 else 0]
    action = kind.sample(rotated(obj.footprint_m, yaw), rng)
    config, xy_m, stop = recipe.world, (0.0, 0.0), 1.0
    if recipe.variation is not None:
        config = recipe.variation.sample(obj, _generator(recipe, index, 3))
    if recipe.anywhere:
        low, high = np.transpose([TABLE_X_M, TABLE_Y_M])
        inside = low + _TABLE_MARGIN_M, high - _TABLE_MARGIN_M
        xy_m = tuple(_generator(recipe, index, 1).uniform(*inside).tolist())
    if recipe.partial:
        stop = float(_generator(recipe, index, 2).uniform(0.05, 1.0))
    world.place(obj, xy_m, yaw, tool=action.tool, config=config)
    stop = stop if stop_phase is None else stop_phase
    return obj, world.execute_primitive(action, stop, record_unreachable=True)
