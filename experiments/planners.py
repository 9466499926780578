"""The planners of Table 3, by name: which planner, on which models, how often it may correct."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, TypeVar

import numpy as np

from affordlib.evaluation.tasks import GOAL_SOURCES, ROLLABLE, STANDING
from affordlib.models.checkpoint import checkpoint_sha256, load_checkpoint
from affordlib.planning import (
    EffectMap,
    PlanningProblem,
    Skills,
    plan_astar,
    plan_continuous,
    plan_gradient,
)
from affordlib.planning.problem import PlanMode, mode_named
from affordlib.primitives import Drag, Push
from affordlib.types import Goal, Plan
from affordlib.world import Tabletop, WorldConfig
from experiments.oracle import oracle_effects

T = TypeVar("T")

FORMATS: dict[Callable[..., Plan], int] = {plan_astar: 5, plan_continuous: 6, plan_gradient: 2}
"""Counts the changes of each planner, or of how plans are executed, that change its numbers."""

ORACLE_FORMAT = 4


@dataclass(frozen=True)
class Variant:
    """A planner and its settings.

    push, drag: names of checkpoints; None where it has none for such objects. samples: stop phases
    of A*, or phases at which the gradient planner queries. full_only: no partial actions. goals:
    the families of goals that it is asked for; every: of these, each so-many-th. world: whose goals
    (see `tasks.FROZEN`). nominal: whoever plans with the simulator is not told this world's
    frictions, masses and heights (it starts where the camera sees the object in any case). wary: it
    has a σ, see `oracle_effects`. nudged: the object is a millimetre and a degree off when the plan
    is carried out. looks: of which each perception is the mean.
    """

    planner: Callable[..., Plan]
    name: str
    model: str
    push: str | None
    drag: str | None = None
    samples: int | None = None
    corrections: int = 0
    full_only: bool = False
    goals: tuple[str, ...] = GOAL_SOURCES
    every: int = 1
    world: str = "clean"
    nominal: bool = False
    wary: bool = False
    nudged: bool = False
    looks: int = 1
    settings: tuple[tuple[str, Any], ...] = ()

    @property
    def sees_world(self) -> bool:
        """Whether it plans with the simulator itself."""
        return self.model == "simulator"

    @property
    def classes(self) -> tuple[str, ...]:
        """The families of objects that it can be asked about."""
        every = (self.sees_world and self.world == "clean") or (self.push and self.drag)
        return STANDING + ROLLABLE if every else STANDING

    def asked(self, tasks: Sequence[T], read: Callable[[T], tuple[str, str]]) -> list[T]:
        """Of tasks, or their records, those that it is asked; read: their goals and their class."""
        chosen = []
        for task in tasks:
            goals, object_class = read(task)
            if goals in self.goals and object_class in self.classes:
                chosen.append(task)
        return chosen[:: self.every]

    def columns(self) -> dict[str, Any]:
        """What a row of the table says of it."""
        return {
            "planner": self.name,
            "model": self.model,
            "world": self.world,
            "samples": self.samples,
            "closed_loop": self.corrections > 0,
        }

    def about(self) -> dict[str, Any]:
        """All that decides its numbers, checkpoints by their hashes."""
        files = {name: checkpoint_sha256(name)[:16] for name in (self.push, self.drag) if name}
        settings = {k: list(v) if isinstance(v, tuple) else v for k, v in self.settings}
        more = {"corrections": self.corrections, "full_only": self.full_only}
        more |= {
            "settings": settings,
            "checkpoints": files,
            "format": ORACLE_FORMAT if self.sees_world else FORMATS[self.planner],
        }
        if self.goals != GOAL_SOURCES:
            more["goals"] = list(self.goals)
        if self.every > 1:
            more["every"] = self.every
        if self.looks > 1:
            more["looks"] = self.looks
        for name in ("nominal", "wary", "nudged"):
            if getattr(self, name):
                more[name] = True
        return self.columns() | more

    def make(self) -> Callable[..., Plan]:
        """The planner as (image, start_xy_m, goal, mode) → Plan.

        One that plans with the simulator takes the world before all others.
        """
        if self.sees_world:
            return partial(_plan_with_simulator, self, Tabletop())
        names = {"push": self.push, "drag": self.drag}
        models = {kind: load_checkpoint(name)[0] for kind, name in names.items() if name}
        return partial(_plan_with_models, self, Skills(models))

    def mode(self, name: str | PlanMode) -> PlanMode:
        """The mode, without partial actions if it has none."""
        mode = mode_named(name)
        return PlanMode(mode.max_steps, partial=False) if self.full_only else mode


def _plan_with_models(
    variant: Variant,
    skills: Skills,
    image: np.ndarray,
    start_xy_m: tuple[float, float],
    goal: Goal,
    mode: str | PlanMode,
) -> Plan:
    settings = dict(variant.settings)
    goal = replace(goal, tolerance_m=settings.pop("tolerance_m", goal.tolerance_m))
    kind = skills.kind_for(image) if variant.drag else Push
    effects = EffectMap(skills.model(kind), image, kind)
    problem = PlanningProblem(start_xy_m, goal, effects, variant.mode(mode))
    return variant.planner(problem, **settings)


def _plan_with_simulator(
    variant: Variant,
    imagined: Tabletop,
    world: Tabletop,
    image: np.ndarray,
    start_xy_m: tuple[float, float],
    goal: Goal,
    mode: str | PlanMode,
) -> Plan:
    kind = Drag if world.object_rolls() else Push
    config = WorldConfig() if variant.nominal else world.config
    effects = oracle_effects(imagined, world, image, kind, config, variant.wary)
    return variant.planner(PlanningProblem(start_xy_m, goal, effects, variant.mode(mode)))


_FILM = {"model": "film_5000", "push": "push_film_x10", "drag": "drag_film"}
_PAPER = {"model": "paper", "push": "push_cnp"}
_LSTM = {"model": "lstm_tuned", "push": "push_lstm"}
_VARIED = {"model": "film_5000_varied", "push": "push_film_varied", "world": "varied"}
_ORACLE = {"model": "simulator", "push": None, "goals": ("constructed",)}
_FINE = (
    ("n_directions", 72),
    ("stop_phases", tuple(round(0.5 + 0.05 * k, 2) for k in range(1, 11))),
    ("tolerance_m", 0.005),
)
_RING = (("starts", 4), ("direction_only", True))


def _continuous(**columns: Any) -> Variant:
    return Variant(plan_continuous, **{"name": "continuous"} | columns)


def _astar(**columns: Any) -> Variant:
    return Variant(plan_astar, **{"name": "astar", "samples": 5} | columns)


def _gradient(
    samples: int, name: str = "gradient", settings: tuple = (), **columns: Any
) -> Variant:
    settings = (("samples", samples), *settings)
    return Variant(plan_gradient, name, **_PAPER, samples=samples, settings=settings, **columns)


_CONSTRUCTED = {"goals": ("constructed",)}
VARIANTS: dict[str, Variant] = {
    "continuous": _continuous(**_FILM),
    "continuous_corrected": _continuous(**_FILM, corrections=2),
    "astar": _astar(**_FILM),
    "astar_fine": _astar(**_FILM | {"name": "astar_fine", "samples": 10}, settings=_FINE),
    "astar_corrected": _astar(**_FILM, corrections=2),
    "astar_paper": _astar(**_PAPER),
    "gradient_25": _gradient(25, **_CONSTRUCTED),
    "gradient_100": _gradient(100),
    "gradient_300": _gradient(300, **_CONSTRUCTED),
    "gradient_snapped": _gradient(
        100, "gradient_snapped", settings=(("snap", True),), **_CONSTRUCTED
    ),
    "gradient_direction": _gradient(100, "gradient_direction", settings=_RING),
    "gradient_corrected": _gradient(
        100, "gradient_direction", settings=_RING, corrections=2, **_CONSTRUCTED
    ),
    "continuous_paper": _continuous(**_PAPER),
    "continuous_500": _continuous(**_FILM | {"model": "film_500", "push": "push_film"}),
    "continuous_full": _continuous(**_FILM | {"name": "continuous_full"}, full_only=True),
    "continuous_nudged": _continuous(**_FILM, **_CONSTRUCTED, nudged=True),
    "astar_lstm": _astar(**_LSTM, **_CONSTRUCTED),
    "continuous_lstm": _continuous(**_LSTM, **_CONSTRUCTED),
    "oracle": _continuous(name="oracle_privileged", **_ORACLE),
    "oracle_wary": _continuous(name="oracle_privileged", **_ORACLE, wary=True),
    "varied": _continuous(**_VARIED, **_CONSTRUCTED),
    "varied_corrected": _continuous(**_VARIED, **_CONSTRUCTED, corrections=2),
    "varied_looks": _continuous(**_VARIED, **_CONSTRUCTED, corrections=2, looks=8),
    "varied_clean": _continuous(
        model="film_5000", push="push_film_x10", world="varied", **_CONSTRUCTED
    ),
    "varied_oracle": _continuous(name="oracle_privileged", **_ORACLE, world="varied", every=5),
    "varied_perceived": _continuous(
        name="oracle_perceived", **_ORACLE, world="varied", every=5, nominal=True
    ),
}
"""Our planner and A* on our best model; the paper's planners on its own network; what each idea is
worth; what the world does with a small misperception; a recurrent network under the same planners;
the simulator itself in the place of a model; and the varied, noisy world."""
