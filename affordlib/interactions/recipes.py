"""A recipe says how a data set is made; interaction i is a pure function of (recipe, i)."""

from __future__ import annotations

import json
import math
from dataclasses import asdict, dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from affordlib.primitives import primitive_named
from affordlib.world import Tabletop, WorldConfig, family_named

if TYPE_CHECKING:
    from affordlib.types import Interaction
    from affordlib.world.objects import Cuboid, UprightCylinder


@dataclass(frozen=True)
class Recipe:
    """What is collected: a primitive on objects of some families, in a world, from a seed."""

    primitive: str = "push"
    n_interactions: int = 500
    seed: int = 0
    families: tuple[str, ...] = ("cuboid", "upright_cylinder")
    world: WorldConfig = field(default_factory=WorldConfig)

    def __post_init__(self) -> None:
        primitive_named(self.primitive)
        if not self.families:
            raise ValueError("families must name at least one object family, got none")
        for name in self.families:
            family_named(name)
        for name, low in (("n_interactions", 1), ("seed", 0)):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int) or value < low:
                raise ValueError(f"{name} must be a whole number of at least {low}, got {value!r}")
        object.__setattr__(self, "families", tuple(self.families))

    def to_json(self) -> str:
        """The recipe as JSON with sorted keys."""
        return json.dumps(asdict(self), sort_keys=True)

    @classmethod
    def from_json(cls, text: str) -> Recipe:
        """The recipe that `to_json` wrote."""
        fields = json.loads(text)
        fields["world"] = WorldConfig(**fields["world"])
        fields["families"] = tuple(fields["families"])
        return cls(**fields)


RECIPES: dict[str, Recipe] = {
    "push": Recipe(),
    "push_test": replace(Recipe(), n_interactions=1000, seed=1_000_003),
}
"""The shipped data sets: the paper's 500 pushes, and a fixed test set no model trains on."""


def draw_scene(
    recipe: Recipe, index: int
) -> tuple[Cuboid | UprightCylinder, float, np.random.Generator]:
    """Object and yaw [rad] of interaction `index`, and the generator to draw its action from."""
    rng = np.random.default_rng(np.random.SeedSequence(recipe.seed, spawn_key=(index,)))
    family = family_named(recipe.families[rng.integers(len(recipe.families))])
    return family.sample(rng), float(rng.uniform(-math.pi, math.pi)), rng


def interact(
    recipe: Recipe, index: int, world: Tabletop
) -> tuple[Cuboid | UprightCylinder, Interaction]:
    """Carry out interaction `index` of a recipe: the same bits in every process and order."""
    thing, yaw, rng = draw_scene(recipe, index)
    world.place(thing, (0.0, 0.0), yaw)
    action = primitive_named(recipe.primitive)(float(rng.uniform(0, 2 * math.pi)))
    return thing, world.interact(action)
