"""What the robot can do: a model for each primitive, and where its arm can act."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import numpy as np

from affordlib.models.checkpoint import load_checkpoint
from affordlib.models.protocol import EffectModel
from affordlib.paths import repo_root
from affordlib.perception import looks_rollable
from affordlib.planning.effect_map import EffectMap, map_effects
from affordlib.planning.finish import Finish
from affordlib.planning.modes import checked_image
from affordlib.planning.reachability import Reachability
from affordlib.planning.routes import REACH_M, RouteMap
from affordlib.primitives import Drag, Grasp, Primitive, Push, Rotate, primitive_named
from affordlib.types import Plan, check_field

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
        check_field(self, "threshold", 0.0, 1.0)

    @classmethod
    def load(cls) -> Repertoire:
        """The shipped models, and reachability as it was learned from the shipped interactions."""
        folder = repo_root() / "data" / "checkpoints"
        models = {
            name: load_checkpoint(folder / f"{file}.safetensors")[0]
            for name, file in CHECKPOINTS.items()
        }
        return cls(models, Reachability.load())

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
        return Drag if looks_rollable(checked_image(image)[0].numpy()) else Push

    def effects(self, image: np.ndarray) -> EffectMap:
        """What moving the object in an image (2, 48, 48) does."""
        kind = self.kind_for(image)
        return map_effects(self.model(kind), image, kind)

    def finish(self, image: np.ndarray) -> Finish:
        """What turns and lifts the object in an image (2, 48, 48) at the end of a plan."""
        return Finish(image, self.model(Rotate), self.model(Grasp), self._can_act)

    def _can_act(self, name: str, xy_m: Sequence[float]) -> bool:
        if self.reachability is None:
            return True
        return bool(self.reachability.probability(name, np.array([xy_m]))[0] >= self.threshold)

    def planner(self, plan: Callable[..., Plan], **settings: Any) -> Callable[..., Plan]:
        """`plan_astar` or `plan_continuous` as (image, start_xy_m, goal) → Plan.

        Told of the object's primitive, where the arm can act, and what turns and lifts it in the
        end. As long as the image (2, 48, 48) stays the same, as it does while only the goal moves,
        what the models say of it is kept. The function takes further settings of the planner;
        its attribute `search` is the planner with those given here, for who knows the object
        better.
        """
        last: dict[bytes, dict[str, Any]] = {}

        def planner(image, start_xy_m, goal, **further):
            seen = np.ascontiguousarray(image).tobytes()
            if seen not in last:
                last.clear()
                last[seen] = self._told_of(image)
            told = last[seen] | settings | further
            return plan(start_xy_m=start_xy_m, goal=goal, **told)

        told_anew = ("mode", "kind", "effects", "reachable", "finish")
        kept = {name: value for name, value in settings.items() if name not in told_anew}
        planner.search = partial(plan, **kept)
        return planner

    def _told_of(self, image: np.ndarray) -> dict[str, Any]:
        kind = self.kind_for(image)
        poses = {Rotate.name, Grasp.name} <= set(self.models)
        return {
            "image": image,
            "model": self.model(kind),
            "kind": kind,
            "effects": self.effects(image),
            "reachable": self.reachable(kind),
            "finish": self.finish(image) if poses else None,
        }

    def reachable(self, kind: type[Primitive]) -> Reachable | None:
        """Where the arm can act with a primitive, as planners ask it."""
        if self.reachability is None:
            return None

        def judge(xy_m, direction_rad):
            return self.reachability.probability(kind.name, xy_m, direction_rad) >= self.threshold

        return judge

    def routes(self, kind: type[Push] | type[Drag]) -> RouteMap:
        """Where the arm can take an object from where, all over the table; made once."""
        if kind not in self._routes:
            judge = self.reachable(kind)

            def allowed(xy_m, direction_rad, _):
                return np.ones(len(xy_m), bool) if judge is None else judge(xy_m, direction_rad)

            self._routes[kind] = RouteMap.of(REACH_M[kind], allowed)
        return self._routes[kind]

    @cached_property
    def _routes(self) -> dict[type[Primitive], RouteMap]:
        return {}
