"""The skills of a robot: a model for each primitive, and where its arm can act.

Reachability is learned from the robot's attempts (Section 3.4 of the paper).
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar, Self

import numpy as np
import torch
from torch import nn

from affordlib.models.base import EffectModel
from affordlib.models.checkpoint import load_checkpoint
from affordlib.perception import looks_rollable
from affordlib.planning.effect_map import EffectMap, checked_image
from affordlib.planning.free_space import FreeSpace
from affordlib.planning.grasp_rotate import PosePlanner
from affordlib.planning.problem import PlanMode, PlanningProblem, Reachable, everywhere
from affordlib.primitives import Grasp, Move, Primitive, Rotate, move_for, primitive_named
from affordlib.results import repo_root
from affordlib.types import Goal, Obstacle, check_array, check_choice
from affordlib.weights import restored, write_weights

CHECKPOINTS = {
    "push": "film_5000",
    "drag": "drag_film_500",
    "grasp": "grasp_film_1000_firm",
    "rotate": "rotate_film_1000",
}
REACHABILITY = "data/checkpoints/reachability.safetensors"
_KEPT = {"default_factory": dict, "init": False, "repr": False, "compare": False}


class Reachability(nn.Module):
    """Predicts the probability that the arm can execute one of some primitives at a position.

    The small network is trained on recorded interactions alone, without the arm's kinematics.
    """

    def __init__(self, primitives: Sequence[str]) -> None:
        super().__init__()
        self.primitives = tuple(primitive_named(name).name for name in primitives)
        first, second = nn.Linear(4 + len(self.primitives), 64), nn.Linear(64, 64)
        self.layers = nn.Sequential(first, nn.Tanh(), second, nn.Tanh(), nn.Linear(64, 1))

    @classmethod
    def load(cls, path: str | Path | None = None) -> Self:
        """Load a network, trained on the set `reach`; ValueError where the file is damaged."""
        path = Path(path or repo_root() / REACHABILITY)
        remedy = "learn it again with python -m experiments.shipped reachability"
        return restored(path, remedy, lambda described: cls(described["primitives"]))[0]

    def save(self, path: str | Path) -> Path:
        """Write the weights to a file, which `load` reads, atomically; returns its path."""
        about = {"format": "affordlib reachability 1", "primitives": [*self.primitives]}
        return write_weights(path, self.state_dict(), about)

    @torch.no_grad()
    def probability(
        self, primitive: str, xy_m: np.ndarray, direction_rad: np.ndarray | float | None = None
    ) -> np.ndarray:
        """Probability (n,) that `primitive` can be executed on objects at xy_m: (n, 2).

        It is 1 for a primitive that was not learned, where only the kinematics decides.
        direction_rad: (n,) or one number, the direction of a push or drag; None for the others.
        """
        primitive_named(primitive)
        if np.size(xy_m) == 0:
            return np.ones(0)
        xy_m = np.atleast_2d(check_array("xy_m", xy_m, 2))
        if primitive not in self.primitives:
            return np.ones(len(xy_m))
        turn = np.full(len(xy_m), np.nan)
        if direction_rad is not None:
            shape = (len(xy_m),) if np.ndim(direction_rad) else ()
            turn[:] = check_array("direction_rad", direction_rad, *shape)
        number = np.full(len(xy_m), self.primitives.index(primitive))
        features = reach_features(np.eye(len(self.primitives))[number], xy_m, turn)
        return torch.sigmoid(self.layers(features)).squeeze(-1).numpy()


def reach_features(kind: np.ndarray, xy_m: np.ndarray, direction_rad: np.ndarray) -> torch.Tensor:
    """Network inputs (n, 4 + primitives): position, direction (zero if none), one-hot primitive."""
    ahead = np.column_stack([np.cos(direction_rad), np.sin(direction_rad)])
    ahead[np.isnan(direction_rad)] = 0.0
    return torch.from_numpy(np.hstack([2 * xy_m, ahead, kind])).float()


@dataclass(frozen=True)
class Skills:
    """Models by the name of their primitive, and the probability that the arm can act.

    reachability: None means that the arm can act everywhere. threshold: minimum probability of an
    action to be planned; it is low, since the arm's kinematics is checked afterwards.
    """

    models: dict[str, EffectModel]
    reachability: Reachability | None = None
    threshold: ClassVar[float] = 0.2
    _last: dict[tuple[type[Move], bytes], EffectMap] = field(**_KEPT)

    def __post_init__(self) -> None:
        for name in self.models:
            primitive_named(name)

    @classmethod
    def load(cls) -> Self:
        """Load the shipped models, and the reachability learned from the shipped interactions."""
        models = {primitive: load_checkpoint(name)[0] for primitive, name in CHECKPOINTS.items()}
        return cls(models, Reachability.load())

    def model(self, primitive: type[Primitive]) -> EffectModel:
        """Return the model of a primitive; ValueError, with the names of those present, if none."""
        return self.models[check_choice("model of primitive", primitive.name, self.models)]

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

        obstacles: not to be touched.
        """
        effects, poses = self.effects(image), None
        if {Rotate.name, Grasp.name} <= set(self.models):
            space = obstacles and FreeSpace(obstacles, image, start_xy_m, effects.outline_m)

            def can_act(step):
                at = np.array([step.predicted_end_xy_m])
                can = bool(self.reachable(type(step.primitive))(at, None)[0])
                return can and (not space or space.is_free(step))

            poses = PosePlanner(image, self.model, can_act)
        more = self.reachable(effects.kind), poses, tuple(obstacles)
        return PlanningProblem(start_xy_m, goal, effects, mode, *more)

    def effects(self, image: np.ndarray, kind: type[Move] | None = None) -> EffectMap:
        """Effect map of a primitive, by default `kind_for` the image; the last one is cached."""
        kind = kind or self.kind_for(image)
        key = kind, np.ascontiguousarray(image).tobytes()
        if key not in self._last:
            self._last.clear()
            self._last[key] = EffectMap(self.model(kind), image, kind)
        return self._last[key]

    def reachable(self, kind: type[Primitive]) -> Reachable:
        """Function that says where the arm can act with a primitive."""
        if self.reachability is None:
            return everywhere

        def reachable(xy_m, direction_rad, *_):
            return self.reachability.probability(kind.name, xy_m, direction_rad) >= self.threshold

        return reachable
