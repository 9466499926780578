"""Pursue a pose goal by off-centre pushes, using observations only, and measure what is missed."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

import pandas as pd

from affordlib.geometry import wrap_angle
from affordlib.logs import PushedObject, Pushes, plan_push_at
from affordlib.logs.fit import Forecast, PushModel
from affordlib.perception import turn_between
from affordlib.types import Goal, Observation, Step
from affordlib.world import Tabletop

CORRECTIONS = 4
TURN_M = 0.04
"""Weight of yaw errors [m/rad] relative to position errors: 3° count as 2 mm."""
WITHIN_M, WITHIN_RAD = 0.005, math.radians(5)


class Remembered:
    """Caches a model's prediction for candidate pushes, which are the same for one seed."""

    def __init__(self, model: PushModel) -> None:
        self.model, self.known = model, None

    def predict(self, pushes: Pushes) -> Forecast:
        """Return the model's prediction for the first pushes."""
        if self.known is None:
            self.known = self.model.predict(pushes)
        return self.known


def act(world: Tabletop, step: Step, seen: Observation) -> None:
    """Execute a step at the object's position in the plan, whether it is there or not."""
    seen = replace(seen, xy_m=tuple(step.predicted_path_xy_m[0].tolist()))
    world.execute_primitive(step.primitive, seen=seen)


def pursue(
    world: Tabletop,
    model: PushModel,
    goal: tuple[float, float, float],
    obj: PushedObject,
) -> Iterator[int]:
    """Push an object to a goal (x, y, turn), using only observations.

    A plan of up to three pushes is executed open loop from one observation. Then, up to four times,
    the robot observes the object and executes the first push of a new plan, unless no improvement
    is predicted.
    Yields the number of pushes after the plan, and after the corrections.
    """
    first = seen = world.observe()
    turned, pushes = 0.0, 0
    for n in (3, *(min(3, k) for k in range(CORRECTIONS, 0, -1))):
        wanted = Goal(goal[:2], 0.001, wrap_angle(goal[2] - turned))
        plan = plan_push_at(model, obj, (*seen.xy_m, turned), wanted, n, turn_m=TURN_M)
        end = plan.steps[-1]
        turn = TURN_M * wrap_angle(end.predicted_turn_rad - wanted.turn_rad)
        expected = math.hypot(plan.predicted_distance_m, turn, end.std_m)
        now = math.hypot(wanted.distance_m(seen.xy_m), TURN_M * wanted.turn_rad)
        if pushes and expected >= now:
            break
        steps = plan.steps[: 1 if pushes else 3]
        for step in steps:
            act(world, step, seen)
        if not pushes:
            yield len(steps)
        pushes += len(steps)
        seen = world.observe()
        turned += steps[-1].predicted_turn_rad
        told = turn_between(first.image, seen.image, turned)
        turned = told[0] if told else turned
    yield pushes


def attempt(world: Tabletop, *arguments) -> list[dict]:
    """Return the errors (ground truth) after the plan and after the corrections of `pursue`."""
    (*_, start), rows = world.object_pose(), []
    goal = arguments[1]
    for pushes in pursue(world, *arguments):
        *xy, yaw = world.object_pose()
        left = abs(wrap_angle(yaw - start - goal[2]))
        rows.append({"corrected": bool(rows), "pushes": pushes})
        rows[-1] |= {"position_m": math.dist(xy, goal[:2]), "yaw_rad": left}
    return rows


def summary(rows: list[dict], by: list[str]) -> list[dict]:
    """Return statistics of the trials' errors, grouped by some columns."""
    table = pd.DataFrame(rows)
    near = (table["position_m"] <= WITHIN_M) & (table["yaw_rad"] <= WITHIN_RAD)
    table["within_percent"] = 100.0 * near
    return [
        dict(zip(by, key, strict=True))
        | {"n": len(part), "pushes": part["pushes"].mean()}
        | {
            f"{column}_{statistic}_{unit}": part[f"{column}_{unit}"].agg(statistic)
            for column, unit in (("position", "m"), ("yaw", "rad"))
            for statistic in ("median", "mean", "sem")
        }
        | {"within_percent": part["within_percent"].mean()}
        for key, part in table.groupby(by)
    ]
