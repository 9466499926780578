"""The embedded log of page 09.

`python -m experiments.own_log` collects `data/own_log/SURFACE_SUPPORT.txt.xz` in the simulated
world, in the text format of Zhou et al.: 50 pushes of one triangle with a thin rod for each of five
combinations of surface (friction) and support (centre of mass).
"""

import argparse
import lzma
import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from functools import partial
from itertools import islice

import numpy as np

from affordlib.geometry import rotated
from affordlib.primitives import PushAt
from affordlib.results import repo_root
from affordlib.types import UnreachableError
from affordlib.world import Prism, Tabletop, TabletopObject, WorldConfig
from experiments.commands import command

FOLDER = repo_root() / "data" / "own_log"
N_PUSHES = 50
TRIANGLE_M = ((0.0, 0.0), (0.13, 0.0), (0.03, 0.11))
"""Corners [m] of the triangle in the recorded frame; it is scalene, so it has no symmetry."""
HEIGHT_M = 0.02
Pose = tuple[float, float, float]
SUPPORTS = {"mid": (0.0, 0.0), "left": (-0.02, -0.005), "right": (0.022, -0.01)}
SURFACES = {"felt": 0.9, "steel": 0.35}
CONDITIONS = ("felt_mid", "felt_left", "steel_mid", "steel_right", "steel_left")
NOISE_M, NOISE_RAD = 0.0003, 0.003
"""Standard deviation of the noise of the tracked poses [m] and [rad]."""


def drawn_push(outline_m: np.ndarray, yaw: float, rng: np.random.Generator) -> PushAt:
    """Sample a push anywhere on the outline, up to 50° from the normal."""
    edges = np.roll(outline_m, -1, axis=0) - outline_m
    sizes = np.linalg.norm(edges, axis=1)
    k = rng.choice(len(edges), p=sizes / sizes.sum())
    contact = outline_m[k] + rng.uniform(0.06, 0.94) * edges[k]
    inward = math.atan2(edges[k, 0], -edges[k, 1])
    direction = inward + math.radians(rng.uniform(-50, 50))
    return PushAt(rotated(contact, yaw), direction + yaw, float(rng.uniform(0.009, 0.017)))


def executed(
    obj: TabletopObject,
    draw: Callable[[float], PushAt],  # a push for the object's yaw
    rng: np.random.Generator,
    config: WorldConfig | None = None,
) -> Iterator[tuple[np.ndarray, tuple[Pose, Pose]]]:
    """Yield the rod's path (n, 2) of pushes that do not fail, and the poses before and after."""
    with Tabletop(config) as world:
        while True:
            world.place(obj, (0.0, 0.0), rng.uniform(-math.pi, math.pi), tool="rod")
            before = world.object_pose()
            with suppress(UnreachableError):
                done = world.execute_primitive(draw(before[2]))
                if not (done.faults or done.fell):
                    path = done.tool[:, :2] + done.estimated_xy_m
                    yield path, (before, world.object_pose())


def collect(condition: str, seed: int) -> str:
    """Collect the pushes of a condition and return the text of its log."""
    rng, lines = np.random.default_rng(seed), [str(N_PUSHES)]
    surface, support = condition.split("_")
    friction = dict.fromkeys(("table_friction", "finger_friction"), SURFACES[surface])
    # The centre of mass is low, so that the triangle does not tip over.
    config = WorldConfig(com_offset_m=(*SUPPORTS[support], -0.3 * HEIGHT_M), **friction)
    prism = Prism(TRIANGLE_M, HEIGHT_M)
    corner, draw = np.array(prism.corners[0]), partial(drawn_push, prism.footprint_m, rng=rng)
    for tool, poses in islice(executed(prism, draw, rng, config), N_PUSHES):
        for x, y, yaw in poses:
            at = np.add((x, y), rotated(corner, yaw)) + rng.normal(0, NOISE_M, 2)
            at, a = 1e3 * at, (yaw + rng.normal(0, NOISE_RAD)) / 2
            lines.append(f"{at[0]:.3f} {at[1]:.3f} 0 {math.cos(a):.6f} 0 0 {math.sin(a):.6f}")
        lines += ["0", str(len(tool))]
        for t, xy in zip(np.linspace(0, 3.75, len(tool)), 1e3 * tool, strict=True):
            lines.append("{:.2f} {:.3f} {:.3f} 0 1 0 0 0".format(t, *xy))
    return "\n".join(lines) + "\n"


@command(OSError, ValueError)
def main(argv: Sequence[str] | None = None) -> int:
    """Collect the log."""
    argparse.ArgumentParser(description=__doc__).parse_args(argv)
    FOLDER.mkdir(parents=True, exist_ok=True)
    for seed, condition in enumerate(CONDITIONS):
        text = collect(condition, seed)
        (FOLDER / f"{condition}.txt.xz").write_bytes(lzma.compress(text.encode()))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
