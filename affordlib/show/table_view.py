"""The table from above, drawn as SVG: millimetres from its middle, y downwards."""

import html
import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from affordlib.show.plots import ENLARGED
from affordlib.types import Goal, Step
from affordlib.world import BASE_X_M, REACH_M, TabletopObject

HALF_WIDTH_M, LIMIT_M = 0.36, 0.35
"""What is seen of the table, and how far from its middle a goal can be put by hand [m]."""

PUSH_RUN_UP_M = 0.2
"""A push begins at most so far from the object; the shaded ring is where any push is in reach."""

_ARROW = '<path class="push" d="M-80 0H-38"/><path class="push-head" d="M-32 0L-46 7V-7Z"/>'
_STAR = "0,-17 4,-5.5 16.2,-5.3 6.5,2.1 10,13.8 0,6.8 -10,13.8 -6.5,2.1 -16.2,-5.3 -4,-5.5"


def step_in_words(step: Step) -> str:
    """Which primitive, and to which share of its phase."""
    return f"{step.primitive.name.replace('_', ' ')} to {100 * step.stop_phase:.0f} %"


def draw_ground() -> str:
    """Where the arm can push, with a line every 10 cm."""
    middle = {"cx": 1000 * BASE_X_M, "cy": 0}
    shapes = [
        _shape("circle", "reach", **middle, r=1000 * (REACH_M[1] - PUSH_RUN_UP_M)),
        _shape("circle", "reach inner", **middle, r=1000 * (REACH_M[0] + PUSH_RUN_UP_M)),
    ]
    edge = 1000 * HALF_WIDTH_M
    for cm in range(-30, 31, 10):
        at = 10 * cm
        shapes += [
            _shape("path", "grid", d=f"M{at} {-edge}V{edge}M{-edge} {at}H{edge}"),
            _shape("text", "tick", cm, x=at, y=edge - 8, text_anchor="middle"),
            _shape("text", "tick", cm or "", x=8 - edge, y=6 - at),
        ]
    shapes.append(_shape("text", "tick", "cm", x=edge - 8, y=edge - 8, text_anchor="end"))
    return "".join(shapes)


def draw_object(obj: TabletopObject, pose: Sequence[float], css: str = "object") -> str:
    """The outline of an object's base at (x, y, yaw)."""
    return _shape("polygon", css, points=_points(obj.footprint_m), transform=_at(*pose))


def draw_path(path_xy_m: np.ndarray, css: str) -> str:
    """A path (n, 2) [m]."""
    return _shape("polyline", css, points=_points(path_xy_m))


def draw_goal(obj: TabletopObject, goal: Goal, from_yaw_rad: float) -> str:
    """The goal around the origin: star, tolerance, and the outline if a turn is wanted."""
    outline = ""
    if goal.turn_rad is not None:
        outline = draw_object(obj, (0, 0, from_yaw_rad + goal.turn_rad), "tolerance wanted")
    circle = _shape("circle", "tolerance", r=1000 * goal.tolerance_m)
    return outline + circle + _shape("polygon", "goal", points=_STAR)


def draw_plan(obj: TabletopObject, steps: Sequence[Step], start: Sequence[float]) -> str:
    """The steps from (x, y, yaw) on as predicted: arrow, path, σ and name; the object at the end.

    Names stand beside the end of a step, where neither the next push comes from nor its object
    goes; below the last move's are those of turns and lifts of what is then in its place.
    """
    moves = [step for step in steps if hasattr(step.primitive, "direction_rad")]
    shapes, at, right, y_label = [], start, True, 0.0
    x, y = to_mm(at)
    for k, step in enumerate(steps):
        label = f"{k + 1}: {step_in_words(step)}"
        if k < len(moves):
            arrow = _at(*at[:2], step.primitive.direction_rad)
            shapes.append(_shape("g", "arrow", _ARROW, transform=arrow))
            at = step.predicted_end_xy_m
            x, y = to_mm(at)
            if not math.isnan(step.std_m):
                radius = round(1000 * ENLARGED * step.std_m, 2)
                shapes.append(_shape("circle", "sigma", cx=x, cy=y, r=radius))
            shapes.append(draw_path(step.predicted_path_xy_m, "prediction"))
            shapes.append(_shape("circle", "prediction-end", cx=x, cy=y, r=3))
            last = k == len(moves) - 1
            ahead = moves[k if last else k + 1].primitive.direction_rad
            right, up = math.cos(ahead) >= 0, math.sin(ahead) > (0.5 if k % 2 else -0.5)
            x += (28 if last else 12) * (1 if right else -1)
            if last:
                y_label = y + 6 - 24 * (len(steps) - len(moves)) * (math.sin(ahead) > 0)
            else:
                y_label = y + (26 if up else -14)
        elif k == 0:
            x, y_label = x + 28, y + 6
        else:
            y_label += 24
        anchor = "start" if right else "end"
        shapes.append(_shape("text", "step", label, x=x, y=y_label, text_anchor=anchor))
    if steps:
        end = (*steps[-1].predicted_end_xy_m, start[2] + steps[-1].predicted_turn_rad)
        shapes.append(draw_object(obj, end, "predicted"))
    return _shape("g", "plan", "".join(shapes))


def to_mm(xy_m: Sequence[float]) -> tuple[float, float]:
    """A position [m] on the table in the drawing."""
    return round(1000 * float(xy_m[0]), 2), round(-1000 * float(xy_m[1]), 2)


def _points(xy_m: Any) -> str:
    return " ".join(f"{1000 * x:.2f},{-1000 * y:.2f}" for x, y in xy_m)


def _at(x_m: float, y_m: float, yaw_rad: float) -> str:
    x, y = to_mm((x_m, y_m))
    return f"translate({x} {y}) rotate({-math.degrees(yaw_rad):.2f})"


def _shape(tag: str, css: str, inside: object = "", **attributes: object) -> str:
    said = "".join(f' {k.replace("_", "-")}="{v}"' for k, v in attributes.items())
    inside = html.escape(str(inside)) if tag == "text" else inside
    return f'<{tag} class="{css}"{said}>{inside}</{tag}>'
