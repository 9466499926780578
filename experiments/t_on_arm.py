"""A T of ours, pushed by the simulated arm with a thin rod: from random pushes to a pose.

`python -m experiments.t_on_arm` pushes the T at random 200 times, reads the pushes through `Log`,
fits a Gaussian process, and brings the T to 50 goals: plan, push, observe, and again. The pose is
what the camera shows. *Within*: 5 mm and 5°, by the true pose, at most 20 pushes.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import islice
from typing import Any

import numpy as np
import pandas as pd

from affordlib.geometry import centroid, unit_vector, wrap_angle
from affordlib.logs import Log, PushedObject, PushPlanner, fit
from affordlib.logs.planning import primitive_of
from affordlib.perception import turn_between
from affordlib.types import Goal, UnreachableError
from affordlib.world import Tabletop, TabletopObject
from affordlib.world.objects import mesh
from affordlib.world.robot import ROD_WIDTH_M
from experiments.novelty import body_of
from experiments.own_log import NOISE_M, NOISE_RAD, executed
from experiments.runner import FOLDER, Job, Rows, command_of, plain, read

TABLE = "t_on_arm"
BARS_M = ((-0.06, 0.02, 0.06, 0.05), (-0.015, -0.07, 0.015, 0.02))
"""The T's two bars: least x and y, largest x and y [m]."""
T_M = ((-6, 2), (-1.5, 2), (-1.5, -7), (1.5, -7), (1.5, 2), (6, 2), (6, 5), (-6, 5))
CENTROID_M = centroid(np.array(T_M) / 100)
HEIGHT_M, LENGTHS_M = 0.03, (0.005, 0.05)
N_PUSHES, N_GOALS, DRAWS, MOST_PUSHES, FAR_M = 200, 50, 5, 20, 0.15
TURN_M, WITHIN_M, WITHIN_RAD = 0.04, 0.005, math.radians(5)
"""Weight of yaw errors [m/rad] relative to position errors; when a goal is reached."""


def _corners(bar: Sequence[float]) -> np.ndarray:
    x0, y0, x1, y1 = np.array(bar) - np.tile(CENTROID_M, 2)
    return np.array([(x, y, z * HEIGHT_M / 2) for x in (x0, x1) for y in (y0, y1) for z in (-1, 1)])


@dataclass(frozen=True)
class TBlock(TabletopObject):
    """A T of two bars, with the frame in the centroid."""

    height: float = HEIGHT_M

    category = "t_block"
    volume_m3 = property(lambda self: HEIGHT_M * sum((c - a) * (d - b) for a, b, c, d in BARS_M))
    footprint_m = property(lambda self: np.array(T_M) / 100 - CENTROID_M)

    def shape(self) -> dict[str, Any]:
        seen = [_corners(bar) for bar in BARS_M]
        hulls = [mesh([part]) for part in seen]
        felt = body_of((h["vertices"], np.reshape(h["indices"], (-1, 3))) for h in hulls)
        return felt | {"seen": seen}


def collect(n: int, seed: int) -> list[dict[str, Any]]:
    """Return n random pushes as arguments of `Log.add`: the rod's path, and noisy poses."""
    rng, found = np.random.default_rng(seed), []
    the_t = PushedObject(np.array(T_M) / 100, ROD_WIDTH_M / 2, LENGTHS_M)
    pushes = executed(TBlock(), lambda yaw: primitive_of(the_t.draw(8, rng), 0, yaw), rng)
    for tool, poses in islice(pushes, n):
        poses = rng.normal(poses, (NOISE_M, NOISE_M, NOISE_RAD))
        found.append({"tool_t": np.arange(len(tool)), "tool_xy": tool, "poses": poses})
    return found


def bring(world: Tabletop, planner: PushPlanner, goal: tuple[float, float, float]) -> int:
    """Push the T towards a pose, observing after each push; the number of pushes."""
    first = seen = world.observe()
    turned, pushes = 0.0, 0
    while pushes < MOST_PUSHES:
        wanted = Goal(goal[:2], 0.001, wrap_angle(goal[2] - turned))
        off_m = math.hypot(wanted.distance_m(seen.xy_m), TURN_M * wanted.turn_rad)
        plan = planner.plan((*seen.xy_m, turned), wanted, 3)
        if off_m < 0.002 or plan.predicted_distance_m >= off_m:
            break
        step = plan.steps[0]
        try:
            world.execute_primitive(step.primitive)
        except UnreachableError:
            break
        pushes, seen = pushes + 1, world.observe()
        turned = wrap_angle(turned + step.predicted_turn_rad)
        turned = (turn_between(first.image, seen.image, turned) or [turned])[0]
    return pushes


def goals(draw: int) -> Rows:
    """Errors of ten goals with a model of a draw's own pushes."""
    log, rows = Log("m", TBlock().footprint_m, tool_radius=ROD_WIDTH_M / 2), []
    log.add_all(collect(N_PUSHES, draw))
    pushes, rng = log.pushes(), np.random.default_rng(draw)
    how = {"turn_m": TURN_M, "price": 0.1, "rounds": 2}
    planner = PushPlanner(fit(pushes, "rate_gp"), PushedObject.of(pushes), **how)
    with Tabletop() as world:
        for _ in range(N_GOALS // DRAWS):
            to = rng.uniform(0.02, FAR_M) * unit_vector(rng.uniform(-math.pi, math.pi))
            goal = (*to, rng.uniform(-math.pi, math.pi))
            world.place(TBlock(), (0.0, 0.0), 0.0, tool="rod")
            pushed = bring(world, planner, goal)
            x, y, yaw = world.object_pose()
            off = {"position_m": math.dist((x, y), goal[:2])}
            rows.append(off | {"yaw_rad": abs(wrap_angle(yaw - goal[2])), "pushes": pushed})
    return rows


def job(draw: int) -> Job:
    """Return the job of a draw of pushes and its goals."""
    return Job(goals, {"draw": draw}, (T_M, HEIGHT_M, N_PUSHES, N_GOALS, MOST_PUSHES, FAR_M))


def tables(folder: str = FOLDER) -> dict[str, Rows]:
    """Return the errors over all goals, and over those of each draw of pushes."""
    results, how = read(TABLE, job, folder), ("mean", "sem", "median")
    found = pd.DataFrame([row | about for about, rows in results for row in rows])
    near = (found.position_m <= WITHIN_M) & (found.yaw_rad <= WITHIN_RAD)
    each = pd.concat([found.assign(draw="all"), found]).assign(within_percent=100.0 * near)
    columns = {"n": ("within_percent", "size")}
    columns |= {name: (name, "mean") for name in ("pushes", "within_percent")}
    columns |= {f"position_{what}_m": ("position_m", what) for what in how}
    columns |= {f"yaw_{what}_rad": ("yaw_rad", what) for what in how}
    return {"goals": plain(each.groupby("draw", sort=False).agg(**columns).reset_index())}


main = command_of(TABLE, __doc__, lambda: [job(draw) for draw in range(DRAWS)], tables)

if __name__ == "__main__":
    raise SystemExit(main())
