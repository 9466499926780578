"""Parts of the goal picker: the table from above, and menus, sliders, buttons and text.

The table is drawn as SVG: millimetres from its centre, y downwards.
"""

import html
import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import ipywidgets as widgets
import numpy as np

from affordlib.geometry import wrap_angle
from affordlib.show.plots import ENLARGED
from affordlib.types import Goal, Outcome, Plan, Step
from affordlib.world import BASE_X_M, REACH_M, TabletopObject

HALF_WIDTH_M, LIMIT_M = 0.40, 0.35
"""Half width of the visible area, and the largest goal coordinate that can be picked [m]."""

PUSH_RUN_UP_M = 0.2
"""Largest distance [m] of a push's start from the object; it bounds the shaded reachable ring."""

_ARROW = '<path class="push" d="M-80 0H-38"/><path class="push-head" d="M-32 0L-46 7V-7Z"/>'
_STAR = "0,-17 4,-5.5 16.2,-5.3 6.5,2.1 10,13.8 0,6.8 -10,13.8 -6.5,2.1 -16.2,-5.3 -4,-5.5"


def step_in_words(step: Step) -> str:
    """Name the primitive and its stop phase in percent."""
    return f"{step.primitive.name.replace('_', ' ')} to {100 * step.stop_phase:.0f} %"


def draw_ground() -> str:
    """Draw where the arm can push, with a line every 10 cm."""
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
    """Draw the outline of an object's base at (x, y, yaw)."""
    return _shape("polygon", css, points=_points(obj.footprint_m), transform=_at(*pose))


def draw_path(path_xy_m: np.ndarray, css: str) -> str:
    """Draw a path (n, 2) [m]."""
    return _shape("polyline", css, points=_points(path_xy_m))


def draw_goal(obj: TabletopObject, goal: Goal, from_yaw_rad: float) -> str:
    """Draw the goal around the origin: star, tolerance, and the outline if it has a rotation."""
    outline = ""
    if goal.turn_rad is not None:
        outline = draw_object(obj, (0, 0, from_yaw_rad + goal.turn_rad), "tolerance wanted")
    circle = _shape("circle", "tolerance", r=1000 * goal.tolerance_m)
    return outline + circle + _shape("polygon", "goal", points=_STAR)


def draw_plan(obj: TabletopObject, steps: Sequence[Step], start: Sequence[float]) -> str:
    """Draw predicted steps from (x, y, yaw): arrow, path, σ and label; the object's final pose.

    A label is beside the end of its step, away from the next push and its motion; the labels of
    rotations and lifts are below that of the last move.
    """
    moves = [step for step in steps if hasattr(step.primitive, "direction_rad")]
    shapes, at, right, y_label = [], start, True, 0.0
    x, y = to_mm(at)
    for k, step in enumerate(steps):
        label = f"{k + 1}: {step_in_words(step).removeprefix('push to ')}"
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
        # A label (10 mm per letter) that would extend beyond the drawing's rim is moved inwards.
        room = 1000 * HALF_WIDTH_M - 10 * len(label)
        x_label, anchor = (min(x, room), "start") if right else (max(x, -room), "end")
        shapes.append(_shape("text", "step", label, x=x_label, y=y_label, text_anchor=anchor))
    if steps:
        end = (*steps[-1].predicted_end_xy_m, start[2] + steps[-1].predicted_turn_rad)
        shapes.append(draw_object(obj, end, "predicted"))
    return _shape("g", "plan", "".join(shapes))


def to_mm(xy_m: Sequence[float]) -> tuple[float, float]:
    """Convert a position [m] on the table to the drawing's millimetres."""
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


_SLIDERS = {
    "x [cm]": {"min": -100 * LIMIT_M, "max": 100 * LIMIT_M, "step": 0.1, "readout_format": ".1f"},
    "y [cm]": {"min": -100 * LIMIT_M, "max": 100 * LIMIT_M, "step": 0.1, "readout_format": ".1f"},
    "turn [°]": {"min": -90, "max": 90, "step": 5, "readout_format": ".0f"},
    "lift [cm]": {"max": 20, "step": 0.5, "readout_format": ".1f"},
}
_SCALES = (100, 100, math.degrees(1), 100)


class PickerControls(widgets.VBox):
    """Controls of a goal picker; lengths in cm, rotations in degrees, 0 if not part of the goal.

    goal: the initial one; planners, executors: the names to choose from; on_goal: called with the
    new goal when a slider is moved.
    """

    def __init__(
        self,
        goal: Goal,
        planners: Sequence[str],
        executors: Sequence[str],
        on_goal: Callable[[Goal], None],
    ) -> None:
        self.goal = goal
        self.sliders = [widgets.FloatSlider(description=n, **s) for n, s in _SLIDERS.items()]
        self.x, self.y, self.turn, self.height = self.sliders
        self.planner = widgets.Dropdown(options=list(planners), description="planner")
        self.executor = widgets.Dropdown(options=list(executors), description="carry out")
        self.run = _button("Run", "play", "Execute the plan", button_style="primary")
        self.stop = _button("Stop", "stop", "Stop after this action", disabled=True)
        self.progress = widgets.IntProgress(max=1, layout={"width": "9em"})
        self.shove = _button("Shove it", "hand-o-right", "Disturb: shove the object")
        self.move_goal = _button("Move goal", "random", "Disturb: move the goal")
        self.start_over = _button("Start over", "undo", "Put the object back")
        self.name = widgets.Text("plan.json", description="file", layout={"width": "14em"})
        self.save, self.load = _button("Save", "save"), _button("Load", "folder-open")
        self.words, self.said = widgets.HTML(), ""
        self.show(goal)
        for slider in self.sliders:
            slider.observe(lambda change: self._slid(change["owner"], on_goal), names="value")
        rows = [
            [self.planner],
            [self.executor],
            *([slider] for slider in self.sliders),
            [self.run, self.stop, self.progress],
            [widgets.Label("disturb"), self.shove, self.move_goal],
            [self.start_over],
            [self.name, self.save, self.load],
            [self.words],
        ]
        super().__init__([widgets.HBox(row) for row in rows])

    def show(self, goal: Goal) -> None:
        """Set the sliders to a goal, as accurately as they can show it."""
        self.goal = goal
        for slider, value in zip(self.sliders, self._shown(goal), strict=True):
            slider.value = value

    def _shown(self, goal: Goal) -> list[float]:
        each = zip(self.sliders, _SCALES, _numbers(goal), strict=True)
        return [round(min(max(scale * v, s.min), s.max), 1) for s, scale, v in each]

    def _slid(self, slider: widgets.FloatSlider, on_goal: Callable[[Goal], None]) -> None:
        """Change the goal's value that belongs to a slider, unless the slider follows the goal."""
        k, numbers = self.sliders.index(slider), _numbers(self.goal)
        if slider.value != self._shown(self.goal)[k]:
            numbers[k] = round(slider.value / _SCALES[k], 12)
            x, y, turn, height = numbers
            wanted = {"turn_rad": turn or None, "height_m": height or None}
            on_goal(replace(self.goal, xy_m=(x, y), **wanted))

    def set_running(self, running: bool) -> None:
        """Disable the controls that have no effect during a run."""
        for control in (self.run, self.start_over, self.planner, self.executor, self.load):
            control.disabled = running
        self.stop.disabled = not running

    def show_progress(self, done: int, of: int | None = None) -> None:
        """Show the number of actions done, and the total if given."""
        self.progress.value, self.progress.max = done, of or self.progress.max

    def say(self, text: str) -> None:
        """Show a text, as HTML, and announce it to screen readers."""
        self.said = text
        style = "width: 27em; max-width: 100%; line-height: 1.4; white-space: normal"
        self.words.value = f"<div role='status' aria-live='polite' style='{style}'>{text}</div>"


def _numbers(goal: Goal) -> list[float]:
    """The values of a goal that the sliders show, in m and rad."""
    return [*goal.xy_m, goal.turn_rad or 0.0, goal.height_m or 0.0]


def _button(name: str, icon: str, tooltip: str = "", **kwargs: Any) -> widgets.Button:
    layout = {"width": "auto"}
    return widgets.Button(
        description=name, icon=icon, tooltip=tooltip or name, layout=layout, **kwargs
    )


def plan_in_words(plan: Plan) -> str:
    """Describe a plan: its actions, predicted distance to the goal, and planning time."""
    steps = ", then ".join(step_in_words(step) for step in plan.steps) or "no action"
    arrives = "" if plan.reaches_goal else " It does not reach the goal."
    if not plan.reaches_goal and plan.predicted_distance_m <= plan.goal.tolerance_m:
        arrives = " It reaches the goal's position, but not its turn or height."
    std_m = plan.steps[-1].std_m if plan.steps else math.nan
    unsure = "" if math.isnan(std_m) else f" (σ of the last step {1000 * std_m:.1f} mm)"
    return (
        f"Plan: {steps}. Predicted to end {1000 * plan.predicted_distance_m:.1f} mm from the goal"
        f"{unsure}.{arrives} Found in {1000 * plan.plan_s:.0f} ms. {plan.warning}".strip()
    )


def outcome_in_words(outcome: Outcome, goal: Goal, how: str, done: int) -> str:
    """Describe an outcome (HTML); how: "Done," or "Stopped after"; done: number of actions."""
    within = "within" if outcome.distance_m <= goal.tolerance_m else "outside"
    posed = ""
    if goal.turn_rad is not None:
        off = math.degrees(abs(wrap_angle(goal.turn_rad - outcome.turned_rad)))
        posed += f" The turn has an error of {off:.1f}°."
    if goal.height_m is not None:
        off = 1000 * abs(goal.height_m - outcome.lifted_m)
        posed += f" The height has an error of {off:.1f} mm."
    return (
        f"{how} {done} action{'s' * (done != 1)}: the object rests "
        f"<b>{1000 * outcome.distance_m:.1f} mm</b> from the goal, {within} the tolerance of "
        f"{1000 * goal.tolerance_m:.0f} mm.{posed} {outcome.words}".rstrip()
    )
