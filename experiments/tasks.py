"""Planning tasks: objects and goals drawn with a seed, independent of any planner (Table 3).

No model has seen the objects; goals are more than 2 cm from the start. *Constructed* goals are
final positions of executed actions, so they can be reached; *uniform* ones are drawn uniformly over
the reachable area. Both avoid the 10° grid of A*. The tables' tasks are stored in files that
`python -m experiments.shipped goals` wrote.
"""

import hashlib
import json
import math
from collections.abc import Sequence
from dataclasses import asdict, astuple, dataclass, field
from itertools import count
from typing import Any, Self

import numpy as np

from affordlib.geometry import unit_vector
from affordlib.interactions.recipes import Variation
from affordlib.planning import MODES
from affordlib.primitives import Drag, Push, move_for
from affordlib.results import file_at
from affordlib.types import Goal, check_choice
from affordlib.world import STANDING, Tabletop, TabletopObject, WorldConfig, category_named

_DRAWN = "perturbed", "perturbed_rollable", "outside", "validation", "fresh", "fresh_rollable"
FROZEN = {"clean": "data/goals/planning.json"}
FROZEN |= {world: f"data/goals/planning_{world}.json" for world in _DRAWN}
GOAL_SOURCES = ("constructed", "uniform")

MIN_DISTANCE_M = 0.02
EARLIEST_STOP = 0.55
"""Earliest stop phase of constructed tasks; before it hardly any action has moved its object."""
ATTEMPTS = 30  # number of random episodes tried with an object before it is replaced

REACH_M = {Push: 0.07, Drag: 0.05}
"""Distance [m] of one full action: the minimum (push) or the approximate one (drag)."""


@dataclass(frozen=True)
class PlanningTask:
    """An object at the table's centre with a yaw [rad], its goal, and a world that is not known."""

    obj: TabletopObject
    yaw_rad: float
    goal: Goal
    mode: str
    goals: str
    config: WorldConfig = field(default_factory=WorldConfig)

    def to_json(self) -> dict[str, Any]:
        """Convert to plain values, from which `from_json` makes the same task."""
        plain = {
            "object_class": self.obj.category,
            "size_m": list(astuple(self.obj)),
            "yaw_rad": self.yaw_rad,
            "goal_xy_m": list(self.goal.xy_m),
            "mode": self.mode,
            "goals": self.goals,
        }
        return plain if self.config == WorldConfig() else plain | {"world": asdict(self.config)}

    @classmethod
    def from_json(cls, plain: dict[str, Any]) -> Self:
        """Make the task from values of `to_json`."""
        obj = category_named(plain["object_class"])(*plain["size_m"])
        goal = Goal(tuple(plain["goal_xy_m"]))
        config = WorldConfig(**plain.get("world", {}))
        mode = check_choice("mode", plain["mode"], MODES)
        goals = check_choice("goals", plain["goals"], GOAL_SOURCES)
        return cls(obj, plain["yaw_rad"], goal, mode, goals, config)


def drawn_object(mode: str, goals: str, seed: int, index: int, classes: Sequence[str]) -> tuple:
    """Draw the object of a task, its yaw [rad], and the generator to draw the goal from."""
    key = (list(MODES).index(check_choice("mode", mode, MODES)), GOAL_SOURCES.index(goals), index)
    rng = np.random.default_rng(np.random.SeedSequence(2_000_003 + seed, spawn_key=key))
    obj = category_named(classes[index % len(classes)]).sample(rng)
    return obj, float(rng.uniform(-math.pi, math.pi)), rng


def off_grid(rng: np.random.Generator, around: float, spread: float) -> float:
    """Draw an angle within `spread` of `around`, at least 1° off the 10° grid."""
    while True:
        angle = around + rng.uniform(-spread, spread)
        off = math.degrees(angle) % 10
        if 1 <= off <= 9:
            return angle


def constructed_tasks(
    world: Tabletop,
    mode: str,
    n: int,
    seed: int = 0,
    classes: Sequence[str] = STANDING,
    variation: Variation | None = None,
) -> list[PlanningTask]:
    """Draw tasks whose goal is the final position of random actions of the mode's kind.

    variation: draws a separate world for each task. An object is replaced by another of its
    category if in none of `ATTEMPTS` episodes it stays upright and on the table without a fault.
    """

    def drawn(index: int) -> PlanningTask | None:
        obj, yaw, rng = drawn_object(mode, "constructed", seed, index, classes)
        kind = move_for(obj.rollable)
        config = variation.sample(obj, rng) if variation else WorldConfig()
        for _ in range(ATTEMPTS):
            direction, valid = rng.uniform(-math.pi, math.pi), True
            world.place(obj, (0.0, 0.0), yaw, config=config)
            for _ in range(rng.integers(2, MODES[mode].max_steps + 1) if mode[0] == "m" else 1):
                stop = rng.uniform(EARLIEST_STOP, 1.0) if MODES[mode].partial else 1.0
                action = kind.towards(off_grid(rng, direction, math.pi / 4))
                if valid:
                    seen = world.execute_primitive(action, stop, approach=True)
                    valid = not (seen.faults or seen.fell or seen.left_table)
            x, y, _ = world.object_pose()
            if math.hypot(x, y) > MIN_DISTANCE_M and valid:
                return PlanningTask(obj, yaw, Goal((x, y)), mode, "constructed", config)
        return None

    of_place = [map(drawn, count(index, 1000 * len(classes))) for index in range(n)]
    return [next(filter(None, candidates)) for candidates in of_place]


def uniform_tasks(
    mode: str, n: int, seed: int = 0, classes: Sequence[str] = STANDING
) -> list[PlanningTask]:
    """Draw tasks with goals uniform on the ring between 2 cm and the mode's reach."""
    tasks = []
    for index in range(n):
        obj, yaw, rng = drawn_object(mode, "uniform", seed, index, classes)
        reach = MODES[mode].max_steps * REACH_M[move_for(obj.rollable)]
        r = math.sqrt(rng.uniform(MIN_DISTANCE_M**2, reach**2))
        goal = Goal(tuple((r * unit_vector(off_grid(rng, 0.0, math.pi))).tolist()))
        tasks.append(PlanningTask(obj, yaw, goal, mode, "uniform"))
    return tasks


def sealed(name: str, text: str) -> str:
    """Return the text of a goals file: JSON that begins with its name and the hash of the rest."""
    digest = hashlib.sha256(text.encode()).hexdigest()
    return f'{{"name": {json.dumps(name)}, "sha256": "{digest}",\n{text.removeprefix("{")}'


def frozen_text(world: str = "clean") -> str:
    """Read the goals of a world; ValueError if their file is damaged or another file's copy."""
    name = check_choice("world", world, FROZEN)
    remedy = "fetch it again, or draw goals with python -m experiments.shipped goals"
    try:
        path = file_at(FROZEN[name])
    except FileNotFoundError as error:
        raise FileNotFoundError(f"{error}; {remedy}") from None
    content = path.read_text(encoding="utf-8", errors="replace")
    text = "{" + content.partition(",\n")[2]
    if content != sealed(path.stem, text):
        raise ValueError(f"{path} is damaged, or is not the file of its name; {remedy}")
    return text


def tasks_sha256(world: str = "clean") -> str:
    """Return the hash of a world's frozen goals."""
    return hashlib.sha256(frozen_text(world).encode()).hexdigest()


def frozen_tasks(world: str = "clean") -> list[PlanningTask]:
    """Load the tasks of the tables in one of the worlds, or the validation tasks."""
    text = frozen_text(world)
    try:
        return [PlanningTask.from_json(plain) for plain in json.loads(text)["tasks"]]
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise ValueError(f"{FROZEN[world]} holds no goals ({error!r:.300})") from error
