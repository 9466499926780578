"""What the robot can do: a model for each primitive, and where its arm can act."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from affordlib.interactions import open_interactions
from affordlib.models.checkpoint import load_checkpoint
from affordlib.paths import repo_root
from affordlib.perception import looks_rollable
from affordlib.planning.effect_map import EffectMap, map_effects
from affordlib.planning.reachability import Reachability, learn_reachability
from affordlib.planning.routes import REACH_M, RouteMap
from affordlib.primitives import Drag, Primitive, Push, primitive_named
from affordlib.types import check_within

if TYPE_CHECKING:
    from affordlib.models.protocol import EffectModel

Reachable = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""Which of the positions (n, 2) and directions (n,) the arm can act at."""

CHECKPOINTS = {
    "push": "push_film_x10",
    "drag": "drag_film",
    "grasp": "grasp_film_firm",
    "rotate": "rotate_film",
}


@dataclass(frozen=True)
class Repertoire:
    """Models by the name of their primitive, and the probability that the arm can act.

    reachability: None means that it can act everywhere; threshold: from which probability on an
    action is tried. It is low, since the arm's kinematics has the last word.
    """

    models: dict[str, EffectModel]
    reachability: Reachability | None = None
    threshold: float = 0.2

    def __post_init__(self) -> None:
        for name in self.models:
            primitive_named(name)
        check_within("threshold", self.threshold, 0.0, 1.0)

    @classmethod
    def load(cls) -> Repertoire:
        """The shipped models, and reachability learned from the shipped interactions (3 s)."""
        folder = repo_root() / "data" / "checkpoints"
        models = {
            name: load_checkpoint(folder / f"{file}.safetensors")[0]
            for name, file in CHECKPOINTS.items()
        }
        return cls(models, learn_reachability(open_interactions("reach")))

    def model(self, primitive: type[Primitive]) -> EffectModel:
        """The model of a primitive; raises KeyError naming those that are there."""
        if primitive.name not in self.models:
            raise KeyError(
                f"primitive {primitive.name!r} has no model here, only {sorted(self.models)} have"
            )
        return self.models[primitive.name]

    @staticmethod
    def kind_for(image: np.ndarray) -> type[Push] | type[Drag]:
        """How an object is moved, by its image: what would roll away is caged and dragged."""
        return Drag if looks_rollable(image) else Push

    def effects(self, image: np.ndarray) -> EffectMap:
        """What moving the object in an image (2, 48, 48) does."""
        kind = self.kind_for(image)
        return map_effects(self.model(kind), image, kind)

    def reachable(self, kind: type[Primitive]) -> Reachable | None:
        """Where the arm can act with a primitive, as planners ask it."""
        if self.reachability is None:
            return None

        def judge(xy_m: np.ndarray, direction_rad: np.ndarray) -> np.ndarray:
            return self.reachability.probability(kind.name, xy_m, direction_rad) >= self.threshold

        return judge

    def routes(self, kind: type[Push] | type[Drag]) -> RouteMap:
        """Where the arm can take an object from where, all over the table; made once."""
        if kind not in self._routes:
            judge = self.reachable(kind)

            def allowed(xy_m: np.ndarray, direction_rad: np.ndarray, _: np.ndarray) -> np.ndarray:
                return np.ones(len(xy_m), bool) if judge is None else judge(xy_m, direction_rad)

            self._routes[kind] = RouteMap.of(REACH_M[kind], allowed)
        return self._routes[kind]

    @cached_property
    def _routes(self) -> dict[type[Primitive], RouteMap]:
        return {}
