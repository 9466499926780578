"""What an interaction costs beside its bare physics: the price of arm, camera and bookkeeping."""

from __future__ import annotations

import time
from dataclasses import dataclass
from unittest import mock

import numpy as np
import pybullet

from affordlib.interactions.recipes import Recipe, interact
from affordlib.world import Tabletop


@dataclass(frozen=True)
class Cost:
    """Seconds of whole interactions (n,) and of the simulation steps alone (n,)."""

    whole_s: np.ndarray
    bare_s: np.ndarray

    @property
    def ratios(self) -> np.ndarray:
        """Whole to bare, episode by episode (n,)."""
        return self.whole_s / self.bare_s


def measure_cost(recipe: Recipe, episodes: int) -> Cost:
    """Run the first episodes of a recipe twice in turn: as they are, and with a clock inside.

    Raises RuntimeError if the two do not give the same bits.
    """
    whole_s, bare_s = np.zeros((2, episodes))
    with Tabletop() as world:
        step_simulation = world.client.stepSimulation
        interact(recipe, 0, world)
        for index in range(episodes):

            def timed_step(index: int = index) -> None:
                began = time.perf_counter()
                step_simulation()
                bare_s[index] += time.perf_counter() - began

            began = time.perf_counter()
            _, once = interact(recipe, index, world)
            whole_s[index] = time.perf_counter() - began
            with mock.patch.object(pybullet, "stepSimulation", timed_step):
                _, again = interact(recipe, index, world)
            if once.effect.tobytes() != again.effect.tobytes():
                raise RuntimeError(f"interaction {index} came out differently the second time")
    return Cost(whole_s, bare_s)
