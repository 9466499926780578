"""Make the page on which a reader plans without a kernel: `python -m experiments.try_it`.

The page holds everything that it needs, and opens by a double-click. Objects, their effect maps and
the arm's reachability come from the package; planning and drawing are `affordlib/show/table.js`.
"""

import base64
import itertools
import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from affordlib import show
from affordlib.planning import Skills, execute_plan, plan_continuous
from affordlib.results import repo_root, write_atomically
from affordlib.show.table_data import object_data, table_data
from affordlib.types import Goal
from affordlib.world import Tabletop, TabletopObject
from affordlib.world.objects import Cuboid, LyingCylinder, Prism, Sphere, UprightCylinder
from affordlib.world.trajectory import STEP_S

PAGE = repo_root() / "figures" / "try_it.html"
OBJECTS = {
    "box": Cuboid(0.07, 0.05, 0.05),
    "cube": Cuboid(0.05, 0.05, 0.05),
    "tin": UprightCylinder(0.06, 0.06),
    "roller": LyingCylinder(0.07, 0.05),
    "ball": Sphere(0.06),
    "triangle": Prism(((0.04, 0.0), (-0.02, 0.035), (-0.02, -0.035)), 0.05),
    "wedge": Prism(((-0.05, -0.02), (0.05, -0.02), (0.05, 0.0), (-0.05, 0.03)), 0.04),
    "slab": Cuboid(0.14, 0.03, 0.04),
}
UNKNOWN = {"triangle", "wedge", "slab"}
"""Shapes that the network of pushes was not trained on."""

N_RUNS, EVERY, HIGH_M = 26, 24, 0.14
"""Executions recorded of each object; simulation steps between two rows of a recorded motion;
height [m] from which on the hand is not shown."""


def data(n_runs: int = N_RUNS) -> dict[str, object]:
    """Everything that the page knows, in JSON's types, with n_runs executions of each object."""
    skills, objects = Skills.load(), []
    with Tabletop() as world:
        for name, obj in OBJECTS.items():
            world.place(obj, (0.0, 0.0), 0.0)
            about = {"name": name, "known": name not in UNKNOWN}
            about |= object_data(obj, skills.effects(world.depth_image()))
            goals = goals_of(name)
            runs = [recorded(world, obj, skills, next(goals)) for _ in range(n_runs)]
            objects.append(about | {"runs": runs})
    return table_data(skills) | {"objects": objects, "every": EVERY * STEP_S}


def goals_of(name: str) -> Iterator[Goal]:
    """Goals around the table's centre, the same for an object whatever their number."""
    rng = np.random.default_rng([len(name), *name.encode()])
    while True:
        far, bearing = rng.uniform(0.03, 0.22), rng.uniform(0, 2 * np.pi)
        yield Goal((round(far * np.cos(bearing), 3), round(far * np.sin(bearing), 3)))


def recorded(world: Tabletop, obj: TabletopObject, skills: Skills, goal: Goal) -> dict[str, object]:
    """Plan for a goal, execute the plan in the simulation, and return the motion in JSON's types.

    Rows of the motion: pose and height of the object, pose of the hand and gap of its fingers, in
    units of 0.1 mm and 0.1 mrad, where the hand is near the table.
    """
    world.place(obj, (0.0, 0.0), 0.0)
    plan = plan_continuous(skills.problem(world.depth_image(), (0.0, 0.0), goal))
    rows, steps, z = [], itertools.count(), world.object_state()[2]

    def note(world):
        hand = world.arm.tool_pose()
        if next(steps) % EVERY == 0 and hand[2] < HIGH_M:
            rows.append([*world.object_pose(), world.object_state()[2] - z, *hand])

    world.on_step = note
    outcome = execute_plan(world, plan)
    world.on_step = None
    whole = np.round(10_000 * np.array(rows or [9 * [0.0]])).astype("<i2")
    return {
        "goal": list(goal.xy_m),
        "chain": [v for s in plan.steps for v in (s.primitive.direction_rad, s.stop_phase)],
        "motion": base64.b64encode(whole.tobytes()).decode(),
        "distance": round(outcome.distance_m, 5),
    }


def page(known: dict[str, object]) -> str:
    """The whole page, around data that `data` makes."""
    here, package = Path(__file__).parent, Path(show.__file__).parent
    parts = {"data": json.dumps(known, separators=(",", ":")).replace("<", "\\u003c")}
    for folder, names in ((package, ("table.css", "table.js")), (here, ("page.css", "page.js"))):
        parts |= {name: (folder / name).read_text().strip() for name in names}
    text = (here / "page.html").read_text()
    for name, part in parts.items():
        text = text.replace(f"{{{name}}}", part, 1)
    return text


def main() -> None:
    """Write the page."""
    write_atomically(PAGE, page(data()), b"<!doctype html>")
    print(f"{PAGE.relative_to(repo_root())}: {PAGE.stat().st_size / 1000:.0f} kB")
