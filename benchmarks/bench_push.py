"""What a push costs: the whole interaction with the full arm against its bare physics.

Every episode runs twice in turn: once as it is, and once with a clock around each stepSimulation.
The two must give the same bits. Prints the median of the ratios and their spread, and beside them
a naive controller that solves numerical inverse kinematics in every step.
"""

import time

import numpy as np
import pybullet

from affordlib.interactions.recipes import Recipe, interact
from affordlib.primitives import Push
from affordlib.world import Cuboid, Tabletop, robot

EPISODES = 40
NAIVE_EPISODES = 6


class Clock:
    """Counts the seconds inside stepSimulation while it is installed."""

    def __init__(self):
        self.step, self.seconds, self.steps = pybullet.stepSimulation, 0.0, 0

    def __call__(self, client):
        began = time.perf_counter()
        self.step(client)
        self.seconds += time.perf_counter() - began
        self.steps += 1

    def __enter__(self):
        pybullet.stepSimulation = self
        return self

    def __exit__(self, *_):
        pybullet.stepSimulation = self.step


def naive_push(world):
    """Ratio of a push steered by numerical inverse kinematics, joint by joint, to its physics."""
    world.place(Cuboid(0.06, 0.06, 0.06))
    world.interact(Push(0.0), 0.3)  # puts the arm at the start of the path
    down = pybullet.getQuaternionFromEuler((np.pi, 0, 0))
    clock, began = Clock(), time.perf_counter()
    for x, y, z, *_ in Push(0.0).path(np.linspace(0, 1, 900)):
        joints = pybullet.calculateInverseKinematics(
            world.robot, 6, (x, y, z + robot.TOOL_LENGTH_M), down, physicsClientId=world.client
        )
        for joint, angle in zip(world.joints, joints, strict=True):
            pybullet.setJointMotorControl2(
                world.robot,
                joint,
                pybullet.POSITION_CONTROL,
                targetPosition=angle,
                physicsClientId=world.client,
            )
        world.object_state()
        clock(world.client)
    return (time.perf_counter() - began) / clock.seconds


def main():
    recipe = Recipe(seed=7, n_interactions=EPISODES)
    whole, bare, naive = [], [], []
    with Tabletop() as world:
        interact(recipe, 0, world)
        for index in range(EPISODES):
            began = time.perf_counter()
            _, once = interact(recipe, index, world)
            whole.append(time.perf_counter() - began)
            with Clock() as clock:
                _, again = interact(recipe, index, world)
            bare.append(clock.seconds)
            steps = clock.steps
            assert once.effect.tobytes() == again.effect.tobytes()
        for _ in range(NAIVE_EPISODES):
            naive.append(naive_push(world))
    whole, bare = np.array(whole), np.array(bare)
    low, middle, high = np.quantile(whole / bare, [0.05, 0.5, 0.95])
    print(f"{EPISODES} pushes of {steps} steps")
    print(
        f"one push           {1000 * np.median(whole):7.1f} ms, {1 / np.mean(whole):.1f} a second"
    )
    print(f"bare physics       {1000 * np.median(bare):7.1f} ms")
    print(f"ratio              {middle:7.3f}   (5 to 95 %: {low:.3f} to {high:.3f}; at most 1.25)")
    print(f"naive controller   {np.median(naive):7.3f}   times its bare physics")


if __name__ == "__main__":
    main()
