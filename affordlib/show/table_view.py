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

from affordlib.geometry import rotated, unit_vector, wrap_angle
from affordlib.show.drawing import words_as_html
from affordlib.show.plots import ENLARGED
from affordlib.types import Goal, Outcome, Plan, Step
from affordlib.world import BASE_X_M, REACH_M, TabletopObject

HALF_WIDTH_M, LIMIT_M = 0.40, 0.35
"""Half width of the visible area, and the largest goal coordinate that can be picked [m]."""

PUSH_RUN_UP_M = 0.2
"""Largest distance [m] of a push's start from the object; it bounds the shaded reachable ring."""

_ARROW = '<path class="push" d="M-80 0H-38"/><path class="push-head" d="M-32 0L-46 7V-7Z"/>'
_STAR = "0,-17 4,-5.5 16.2,-5.3 6.5,2.1 10,13.8 0,6.8 -10,13.8 -6.5,2.1 -16.2,-5.3 -4,-5.5"

_AROUND = np.array([(1, 0), (-1, 0), (1, 1), (1, -1), (-1, 1), (-1, -1), (0, 1), (0, -1)])
_GAPS_MM = np.array([8, 25, 50, 80, 120, 170])[:, None, None]
"""Directions and gaps at which the place of a label is looked for, from its step's end."""


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
    grip = _shape("circle", "grip", r=45)
    return outline + circle + grip + _shape("polygon", "goal", points=_STAR)


def draw_plan(
    obj: TabletopObject, steps: Sequence[Step], start: Sequence[float], goal: Goal
) -> tuple[str, str]:
    """Draw predicted steps from (x, y, yaw): arrows, paths, σ and poses; and, apart, labels."""
    shapes, at = [], start
    taken = [(*to_mm(goal.xy_m), 1000 * goal.tolerance_m), *_cover(obj, start)]
    for k, step in enumerate(steps):
        x, y = to_mm(step.predicted_end_xy_m)
        if hasattr(step.primitive, "direction_rad"):
            arrow = _at(*at[:2], step.primitive.direction_rad)
            shapes.append(_shape("g", "arrow", _ARROW, transform=arrow))
            tail = np.outer((-0.08, -0.06, -0.04), unit_vector(step.primitive.direction_rad))
            if not math.isnan(step.std_m):
                radius = round(1000 * ENLARGED * step.std_m, 2)
                shapes.append(_shape("circle", "sigma", cx=x, cy=y, r=radius))
                taken.append((x, y, radius))
            shapes.append(draw_path(step.predicted_path_xy_m, "prediction"))
            shapes.append(_shape("circle", "prediction-end", cx=x, cy=y, r=3))
            taken += [(*to_mm(xy), 6) for xy in (*(at[:2] + tail), *step.predicted_path_xy_m)]
        at = (*step.predicted_end_xy_m, start[2] + step.predicted_turn_rad)
        shapes.append(draw_object(obj, at, "predicted" if k == len(steps) - 1 else "ghost"))
        taken += _cover(obj, at)
    return _shape("g", "plan", "".join(shapes)), _shape("g", "plan", _draw_labels(steps, taken))


def _draw_labels(steps: Sequence[Step], taken: list[tuple[float, ...]]) -> str:
    """Label steps, each at the place around its end that is the first to meet none of the circles.

    taken: circles (x, y, radius) [mm]. If they meet every place, the one with most room is used.
    """
    edge, shapes = 1000 * HALF_WIDTH_M, []
    for k, step in enumerate(steps):
        label = f"{k + 1}: {step_in_words(step).removeprefix('push to ')}"
        half = np.array([5 * len(label), 9])  # 10 mm per letter
        end = to_mm(step.predicted_end_xy_m)
        places = (end + _AROUND * (half + _GAPS_MM)).reshape(-1, 2)
        places = np.clip(places, half - edge, edge - half)
        circles = np.array(taken)
        away = np.maximum(np.abs(places[:, None] - circles[:, :2]) - half, 0)
        room = (np.linalg.norm(away, axis=-1) - circles[:, 2]).min(axis=1)
        x, y = places[np.argmax(np.minimum(room, 2))].round(2).tolist()
        taken += [(x + dx, y, 9) for dx in range(9 - 5 * len(label), 5 * len(label), 9)]
        rim = np.add((x, y), np.clip(np.subtract(end, (x, y)), -half, half))
        if math.dist(rim, end) > 60:
            shapes.append(_shape("path", "leader", d="M{} {}L{} {}".format(*rim, *end)))
        shapes.append(_shape("text", "step", label, x=x, y=y + 6, text_anchor="middle"))
    return "".join(shapes)


def _cover(obj: TabletopObject, pose: Sequence[float]) -> list[tuple[float, ...]]:
    """Circles (x, y, radius) [mm] that cover the outline of an object at (x, y, yaw)."""
    corners = rotated(obj.footprint_m, pose[2])
    rim = np.linspace(corners, np.roll(corners, 1, axis=0), 6).reshape(-1, 2)
    return [(*to_mm(xy), 5) for xy in np.vstack([rim, rim / 2]) + pose[:2]]


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
    new goal when a slider is moved. `words` and `progress` are placed by the picker.
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
        self.shove = _button("Shove it", "hand-o-right", "Disturb: shove the object")
        self.move_goal = _button("Move goal", "random", "Disturb: move the goal")
        self.start_over = _button("Start over", "undo", "Put the object back")
        narrow = {"style": {"description_width": "auto"}, "layout": {"flex": "1", "min_width": "0"}}
        self.name = widgets.Text("plan.json", description="file", **narrow)
        self.save, self.load = _button("Save", "save"), _button("Load", "folder-open")
        self.words, self.said, self.progress = widgets.HTML(), "", widgets.HTML()
        self.show(goal)
        for slider in self.sliders:
            slider.observe(lambda change: self._slid(change["owner"], on_goal), names="value")
        rows = [
            [self.planner],
            [self.executor],
            *([slider] for slider in self.sliders),
            [self.run, self.stop, self.start_over],
            [widgets.Label("disturb"), self.shove, self.move_goal],
            [self.name, self.save, self.load],
        ]
        layout = {"flex": "1 1 250px", "max_width": "300px"}
        super().__init__([widgets.HBox(row) for row in rows], layout=layout)

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

    def show_progress(self, done: int, of: int = 1) -> None:
        """Show the number of actions done, of a total."""
        self.progress.value = f"<progress aria-label='actions done' value={done} max={of}>"

    def say(self, text: str, css: str = "") -> None:
        """Show a text, and announce it to screen readers."""
        self.said, self.words.value = text, words_as_html(text, css)


def _numbers(goal: Goal) -> list[float]:
    """The values of a goal that the sliders show, in m and rad."""
    return [*goal.xy_m, goal.turn_rad or 0.0, goal.height_m or 0.0]


def _button(name: str, icon: str, tooltip: str = "", **kwargs: Any) -> widgets.Button:
    layout = {"width": "auto", "flex": "none"}
    return widgets.Button(
        description=name, icon=icon, tooltip=tooltip or name, layout=layout, **kwargs
    )


def plan_in_words(plan: Plan) -> str:
    """Describe a plan: its actions, predicted distance to the goal, and planning time."""
    steps = ", then ".join(step_in_words(step) for step in plan.steps) or "no action"
    missed = " Up to three pushes or drags do not reach the goal; a closed loop then plans again."
    arrives = "" if plan.reaches_goal else missed
    if not plan.reaches_goal and plan.predicted_distance_m <= plan.goal.tolerance_m:
        arrives = " It reaches the goal's position, but not its turn or height."
    std_m = plan.steps[-1].std_m if plan.steps else math.nan
    unsure = "" if math.isnan(std_m) else f" (σ of the last step {1000 * std_m:.1f} mm)"
    return (
        f"Plan: {steps}. Predicted to end {1000 * plan.predicted_distance_m:.1f} mm from the goal"
        f"{unsure}.{arrives} Found in {1000 * plan.plan_s:.0f} ms."
    )


def outcome_in_words(outcome: Outcome, goal: Goal, how: str, done: int) -> tuple[str, str]:
    """Describe an outcome, and name its look; how: "Done," or "Stopped after"; done: actions."""
    within = "within" if outcome.distance_m <= goal.tolerance_m else "outside"
    posed = ""
    if goal.turn_rad is not None:
        off = math.degrees(abs(wrap_angle(goal.turn_rad - outcome.turned_rad)))
        posed += f" The turn has an error of {off:.1f}°."
    if goal.height_m is not None:
        off = 1000 * abs(goal.height_m - outcome.lifted_m)
        posed += f" The height has an error of {off:.1f} mm."
    words = (
        f"{how} {done} action{'s' * (done != 1)}: the object rests "
        f"**{1000 * outcome.distance_m:.1f} mm** from the goal, {within} the tolerance of "
        f"{1000 * goal.tolerance_m:.0f} mm.{posed} {outcome.words}"
    )
    return words, f"outcome {within}"
