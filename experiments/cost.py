"""What an interaction costs beside its bare physics: the price of arm, camera and bookkeeping."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
import pybullet

from affordlib.interactions.recipes import Recipe, interact
from affordlib.world import Tabletop


class SteppingClock:
    """Counts seconds and steps inside PyBullet's stepSimulation while it is entered."""

    def __init__(self) -> None:
        self.seconds, self.steps = 0.0, 0
        self._step = pybullet.stepSimulation

    def __call__(self, client: int) -> None:
        began = time.perf_counter()
        self._step(client)
        self.seconds += time.perf_counter() - began
        self.steps += 1

    def __enter__(self) -> SteppingClock:
        pybullet.stepSimulation = self
        return self

    def __exit__(self, *_: object) -> None:
        pybullet.stepSimulation = self._step


@dataclass(frozen=True)
class Cost:
    """Seconds of whole interactions (n,) and of the simulation steps alone (n,); their steps."""

    whole_s: np.ndarray
    bare_s: np.ndarray
    steps: int

    @property
    def ratios(self) -> np.ndarray:
        """Whole to bare, episode by episode (n,)."""
        return self.whole_s / self.bare_s


def measure_cost(recipe: Recipe, episodes: int) -> Cost:
    """Run the first episodes of a recipe twice in turn: as they are, and with a clock inside.

    Raises RuntimeError if the two do not give the same bits.
    """
    whole, bare = [], []
    with Tabletop() as world:
        interact(recipe, 0, world)
        for index in range(episodes):
            began = time.perf_counter()
            _, once = interact(recipe, index, world)
            whole.append(time.perf_counter() - began)
            with SteppingClock() as clock:
                _, again = interact(recipe, index, world)
            bare.append(clock.seconds)
            if once.effect.tobytes() != again.effect.tobytes():
                raise RuntimeError(f"interaction {index} came out differently the second time")
    return Cost(np.array(whole), np.array(bare), clock.steps)
