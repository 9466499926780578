"""Observe, plan and execute 3,000 times: memory stays constant and results are bit-identical.

    make soak

Each round has a different object, start and goal; A* and the continuous planner alternate. Every
hundred rounds two fixed tasks are repeated. Exits with 1 when memory grew by more than 2 MB after
the first thousand rounds, or a fixed task ended differently. It takes 15 minutes.
"""

from __future__ import annotations

import argparse
import gc
import hashlib
import itertools
import sys

import numpy as np
import psutil

from affordlib.planning import Skills, execute_plan, plan_astar, plan_continuous
from affordlib.planning.problem import PlanMode
from affordlib.types import Goal, UnreachableError
from affordlib.world import Cuboid, LyingCylinder, Tabletop, UprightCylinder

MOST_GROWTH_MB, WARM_UP = 2.0, 1000
EVERY = 100
CATEGORIES = (Cuboid, UprightCylinder, LyingCylinder)


def one_round(world: Tabletop, pose, planner, obj, start, goal: Goal) -> str:
    """Observe, plan and execute; return the hash of the object's path."""
    world.place(obj, start)
    seen = world.observe()
    try:
        outcome = execute_plan(world, planner(pose(seen.image, seen.xy_m, goal)))
    except UnreachableError:
        return "unreachable"
    told = [np.array(outcome.end_pose), *outcome.object_paths_xy_m]
    return hashlib.sha256(b"".join(part.tobytes() for part in told)).hexdigest()


def memory_mb() -> float:
    """Anonymous memory [MB], swapped out or not; memory backed by files is shared with others."""
    gc.collect()
    return sum(part.anonymous + part.swap for part in psutil.Process().memory_maps()) / 2**20


def main() -> int:
    """Run all rounds, and report."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("--rounds", type=int, default=3000)
    rounds = parser.parse_args().rounds
    rng = np.random.default_rng(0)
    skills = Skills.load()

    def pose(*query):
        return skills.problem(*query, PlanMode(2, partial=True))

    planners = [plan_astar, plan_continuous]
    fixed = [(Cuboid(0.06, 0.05, 0.07), (0.0, 0.0)), (UprightCylinder(0.06, 0.08), (0.1, 0.2))]
    first: list[str] = []
    begin = 0.0
    with Tabletop() as world:
        for number, planner in zip(range(1, rounds + 1), itertools.cycle(planners), strict=False):
            category = CATEGORIES[rng.integers(len(CATEGORIES))]
            start = rng.uniform((-0.1, -0.2), (0.2, 0.2))
            goal = Goal(tuple(start + rng.uniform(-0.1, 0.1, 2)), 0.005)
            one_round(world, pose, planner, category.sample(rng, (0.05, 0.08)), start, goal)
            if number % EVERY == 0:
                again = [
                    one_round(world, pose, plan, obj, at, Goal((at[0] + 0.08, at[1] + 0.06), 0.005))
                    for obj, at in fixed
                    for plan in planners
                ]
                first = first or again
                now = memory_mb()
                begin = now if number <= WARM_UP else begin
                same = again == first
                print(f"{number} rounds: {now - begin:+.1f} MB, same bits: {same}", flush=True)
                if not same or now - begin > MOST_GROWTH_MB:
                    return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
