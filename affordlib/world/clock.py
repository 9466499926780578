"""How much of the time the physics itself takes: a clock around every simulation step."""

from __future__ import annotations

import time

import pybullet


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
