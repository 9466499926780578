"""Recipes define how data sets are collected; interaction i is a pure function of (recipe, i)."""

import json
import math
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Self

import numpy as np

from affordlib.geometry import rotated
from affordlib.primitives import PRIMITIVES, Primitive, primitive_named
from affordlib.types import TABLE_X_M, TABLE_Y_M, Interaction, check_count, check_field, check_range
from affordlib.world import (
    CATEGORIES,
    Tabletop,
    TabletopObject,
    WorldConfig,
    category_named,
)

_TABLE_MARGIN_M = 0.08


@dataclass(frozen=True)
class Variation:
    """Parameters of a perturbed world, which are sampled separately for every interaction.

    Frictions, density and the gripper's height error are sampled uniformly from ranges; com_offset:
    largest offset of the centre of mass as a share of the half extents (that of a round object is
    turned downwards: there it lies at rest); bias_sd_m: standard deviation of the error of the
    object's estimated position, in addition to the camera's.
    """

    table_friction: tuple[float, float] = (0.35, 0.65)
    object_friction: tuple[float, float] = (0.35, 0.65)
    finger_friction: tuple[float, float] = (0.6, 1.2)
    density_kg_m3: tuple[float, float] = (300.0, 1200.0)
    tip_offset_m: tuple[float, float] = (-0.003, 0.01)
    com_offset: float = 0.15
    bias_sd_m: float = 0.001
    camera: str = "kinect"

    def __post_init__(self) -> None:
        for name in _VARIED:
            low, high, _ = WorldConfig.ranges[name]
            object.__setattr__(self, name, check_range(name, getattr(self, name), low, high))
        check_field(self, "com_offset", 0.0, 0.5)
        check_field(self, "bias_sd_m", 0.0, 0.02, "m")

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
            com_offset_m=tuple(float(v) for v in offset),
            camera=self.camera,
            bias_m=tuple(float(v) for v in rng.normal(0, self.bias_sd_m, size=2)),
            noise_seed=int(rng.integers(2**31)),
        )


_VARIED = ("table_friction", "object_friction", "finger_friction", "density_kg_m3", "tip_offset_m")


@dataclass(frozen=True)
class Recipe:
    """The definition of a data set: primitives, object categories, world and seed.

    Each interaction uses one of the primitives that suit its object. height_range_m defaults to
    size_range_m. anywhere: objects lie all over the table, within reach or not, not at its centre.
    partial: actions stop at a random phase. variation: a new world for each interaction.
    """

    primitives: tuple[str, ...] = ("push",)
    n_interactions: int = 500
    seed: int = 0
    categories: tuple[str, ...] = ("cuboid", "upright_cylinder")
    size_range_m: tuple[float, float] = (0.04, 0.08)
    height_range_m: tuple[float, float] | None = None
    anywhere: bool = False
    partial: bool = False
    world: WorldConfig = field(default_factory=WorldConfig)
    variation: Variation | None = None

    def __post_init__(self) -> None:
        for name, known in (("primitives", PRIMITIVES), ("categories", CATEGORIES)):
            values = tuple(getattr(self, name))
            if not values or not set(values) <= set(known):
                raise ValueError(f"{name} must be some of {sorted(known)}, got {values!r}")
            object.__setattr__(self, name, values)
        for name in ("size_range_m", "height_range_m"):
            if getattr(self, name) is not None:
                sizes = check_range(name, getattr(self, name), 0.005, 0.3)
                object.__setattr__(self, name, sizes)
        check_count("n_interactions", self.n_interactions)
        check_count("seed", self.seed, least=0)

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


_FILE = Path(__file__).with_name("recipes.json")
_PLAIN = json.loads(_FILE.read_text(encoding="utf-8"))
_SHIPPED = {name: Recipe.from_json(json.dumps(fields)) for name, fields in _PLAIN.items()}
_TEN_TIMES = {
    f"{name}_x10": replace(recipe, n_interactions=10 * recipe.n_interactions, seed=recipe.seed + 10)
    for name, recipe in _SHIPPED.items()
    if name not in ("push_test", "partial", "reach")
}
_FIRM = replace(_TEN_TIMES["grasp_x10"], seed=18, world=WorldConfig())

SHIPPED = tuple(_SHIPPED)
RECIPES: dict[str, Recipe] = _SHIPPED | _TEN_TIMES | {"grasp_firm_x10": _FIRM}
"""Recipes by name: the paper's sets; a test set for no model's training; partial executions, for
tests only; a perturbed world; objects all over the table, within reach or not; sets of ten times
the size (_x10); and grasps with the friction of the pushes, with which objects slip less."""


def _generator(recipe: Recipe, index: int, *part: int) -> np.random.Generator:
    return np.random.default_rng(np.random.SeedSequence(recipe.seed, spawn_key=(index, *part)))


def sample_scene(recipe: Recipe, index: int) -> tuple[TabletopObject, float, np.random.Generator]:
    """Sample object and yaw [rad] of interaction `index`; return them and the random generator."""
    rng = _generator(recipe, index)
    category = category_named(recipe.categories[rng.integers(len(recipe.categories))])
    obj = category.sample(rng, recipe.size_range_m, recipe.height_range_m)
    return obj, float(rng.uniform(-math.pi, math.pi)), rng


def sample_world(recipe: Recipe, index: int, obj: TabletopObject) -> WorldConfig:
    """Return the world parameters of interaction `index`."""
    if recipe.variation is None:
        return recipe.world
    return recipe.variation.sample(obj, _generator(recipe, index, 3))


def _sample_action(
    recipe: Recipe, obj: TabletopObject, yaw: float, rng: np.random.Generator
) -> Primitive:
    """Sample a primitive that suits the object, and its parameters."""
    kinds = [primitive_named(name) for name in recipe.primitives]
    kinds = [kind for kind in kinds if kind.rollable in (None, obj.rollable)] or kinds
    kind = kinds[rng.integers(len(kinds)) if len(kinds) > 1 else 0]
    return kind.sample(rotated(obj.footprint_m, yaw), rng)


def interact(
    recipe: Recipe, index: int, world: Tabletop, stop_phase: float | None = None
) -> tuple[TabletopObject, Interaction]:
    """Execute interaction `index` of a recipe; bit-identical in every process and order.

    stop_phase: phase at which the action stops (default: the recipe's).
    """
    obj, yaw, rng = sample_scene(recipe, index)
    action = _sample_action(recipe, obj, yaw, rng)
    config, xy_m, stop = sample_world(recipe, index, obj), (0.0, 0.0), 1.0
    if recipe.anywhere:
        low = np.array([TABLE_X_M[0], TABLE_Y_M[0]]) + _TABLE_MARGIN_M
        high = np.array([TABLE_X_M[1], TABLE_Y_M[1]]) - _TABLE_MARGIN_M
        xy_m = tuple(_generator(recipe, index, 1).uniform(low, high).tolist())
    if recipe.partial:
        stop = float(_generator(recipe, index, 2).uniform(0.05, 1.0))
    world.place(obj, xy_m, yaw, tool=action.tool, config=config)
    stop = stop if stop_phase is None else stop_phase
    return obj, world.execute_primitive(action, stop, record_unreachable=True)
