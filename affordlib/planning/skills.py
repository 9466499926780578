"""The skills of a robot: a model for each primitive, and where its arm can act."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import ClassVar, Self

import numpy as np

from affordlib.models.base import EffectModel
from affordlib.models.checkpoint import load_checkpoint
from affordlib.perception import looks_rollable
from affordlib.planning.effect_map import EffectMap, checked_image
from affordlib.planning.free_space import FreeSpace
from affordlib.planning.grasp_rotate import PosePlanner
from affordlib.planning.problem import PlanMode, PlanningProblem, Reachable, everywhere
from affordlib.planning.reachability import Reachability
from affordlib.primitives import Grasp, Move, Primitive, Rotate, move_for, primitive_named
from affordlib.types import Goal, Obstacle, Step

CHECKPOINTS = {
    "push": "film_5000",
    "drag": "drag_film_500",
    "grasp": "grasp_film_1000_firm",
    "rotate": "rotate_film_1000",
}
_KEPT = {"default_factory": dict, "init": False, "repr": False, "compare": False}


@dataclass(frozen=True)
class Skills:
    """Models by the name of their primitive, and the probability that the arm can act.

    reachability: None means that the arm can act everywhere. threshold: minimum probability of an
    action to be planned; it is low, since the arm's kinematics is checked afterwards.
    """

    models: dict[str, EffectModel]
    reachability: Reachability | None = None
    threshold: ClassVar[float] = 0.2
    _last: dict[bytes, tuple[EffectMap, PosePlanner | None]] = field(**_KEPT)

    def __post_init__(self) -> None:
        for name in self.models:
            primitive_named(name)

    @classmethod
    def load(cls) -> Self:
        """Load the shipped models, and the reachability learned from the shipped interactions."""
        models = {primitive: load_checkpoint(name)[0] for primitive, name in CHECKPOINTS.items()}
        return cls(models, Reachability.load())

    def model(self, primitive: type[Primitive]) -> EffectModel:
        """Return the model of a primitive; KeyError, with the names of those present, if none."""
        if primitive.name not in self.models:
            raise KeyError(
                f"there is no model of primitive {primitive.name!r}, only of {sorted(self.models)}"
            )
        return self.models[primitive.name]

    @staticmethod
    def kind_for(image: np.ndarray) -> type[Move]:
        """Primitive that moves the object in an image: drag for one that would roll, else push."""
        return move_for(looks_rollable(checked_image(image)[0].numpy()))

    def problem(
        self,
        image: np.ndarray,
        start_xy_m: Sequence[float],
        goal: Goal,
        mode: str | PlanMode = "multi_partial",
        obstacles: Sequence[Obstacle] = (),
    ) -> PlanningProblem:
        """Pose the problem of moving the object in an image (2, 48, 48) from (x, y) [m] to a goal.

        obstacles: not to be touched. The models' predictions are cached for the last image.
        """
        effects, poses = self._predictions(image)
        if obstacles and poses:
            space = FreeSpace(obstacles, image, start_xy_m, effects.outline_m)
            poses = PosePlanner(image, self.model, lambda s: self._can_act(s) and space.is_free(s))
        more = self.reachable(effects.kind), poses, tuple(obstacles)
        return PlanningProblem(start_xy_m, goal, effects, mode, *more)

    def effects(self, image: np.ndarray, kind: type[Move] | None = None) -> EffectMap:
        """Effect map of a primitive, by default `kind_for` the image; cached for the last image."""
        if kind in (None, self.kind_for(image)):
            return self._predictions(image)[0]
        return EffectMap(self.model(kind), image, kind)

    def _predictions(self, image: np.ndarray) -> tuple[EffectMap, PosePlanner | None]:
        key = np.ascontiguousarray(image).tobytes()
        if key not in self._last:
            kind, both = self.kind_for(image), {Rotate.name, Grasp.name} <= set(self.models)
            poses = PosePlanner(image, self.model, self._can_act) if both else None
            self._last.clear()
            self._last[key] = EffectMap(self.model(kind), image, kind), poses
        return self._last[key]

    def _can_act(self, step: Step) -> bool:
        at = np.array([step.predicted_end_xy_m])
        return bool(self.reachable(type(step.primitive))(at, None)[0])

    def reachable(self, kind: type[Primitive]) -> Reachable:
        """Function that says where the arm can act with a primitive."""
        if self.reachability is None:
            return everywhere

        def reachable(xy_m, direction_rad, *_):
            return self.reachability.probability(kind.name, xy_m, direction_rad) >= self.threshold

        return reachable
