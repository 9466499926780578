"""What a primitive costs: the whole interaction with the full arm against its bare physics.

Every episode runs twice in turn: once as it is, and once with a clock around each stepSimulation.
The two must give the same bits. Prints per primitive the interactions per second on one core and
the ratio (median, and 5 to 95 %), and beside them, in the same run, a naive controller that
solves numerical inverse kinematics in every step and sets the motors one by one.
"""

import time

import numpy as np
import pybullet

from affordlib.interactions.recipes import RECIPES
from affordlib.primitives import PRIMITIVES, Push
from affordlib.world import Cuboid, Tabletop, robot
from experiments.cost import SteppingClock, measure_cost
from experiments.speed.keeping import keep

EPISODES = 24
NAIVE_EPISODES = 6
LIMIT = 1.25


def naive_push(world):
    """Ratio of a push steered by numerical inverse kinematics, joint by joint, to its physics."""
    world.place(Cuboid(0.06, 0.06, 0.06))
    world.interact(Push(0.0), 0.3)  # puts the arm at the start of the path
    down = pybullet.getQuaternionFromEuler((np.pi, 0, 0))
    clock, began = SteppingClock(), time.perf_counter()
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
    print(f"{EPISODES} interactions per primitive; ratio: median (5 to 95 %), at most {LIMIT}")
    print(f"{'primitive':10} {'per second':>10} {'whole ms':>9} {'bare ms':>8} {'steps':>6}  ratio")
    kept = []
    for name in PRIMITIVES:
        cost = measure_cost(RECIPES[name], EPISODES)
        low, middle, high = np.quantile(cost.ratios, [0.05, 0.5, 0.95])
        print(
            f"{name:10} {1 / cost.whole_s.mean():10.1f} {1000 * np.median(cost.whole_s):9.1f} "
            f"{1000 * np.median(cost.bare_s):8.1f} {cost.steps:6}  "
            f"{middle:.3f} ({low:.3f} to {high:.3f})"
        )
        row = {"primitive": name, "per_second": 1 / cost.whole_s.mean(), "n": EPISODES}
        kept.append(row | {"ratio_p5": low, "ratio_median": middle, "ratio_p95": high})
    with Tabletop() as world:
        naive = [naive_push(world) for _ in range(NAIVE_EPISODES)]
    print(f"naive push: {np.median(naive):.3f} times its bare physics ({NAIVE_EPISODES} episodes)")
    keep("primitives", kept)


if __name__ == "__main__":
    main()
