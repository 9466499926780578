"""What stands beside the table of a goal picker: menus, sliders, buttons and words."""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import ipywidgets as widgets

from affordlib.geometry import wrap_angle
from affordlib.show.table_view import LIMIT_M, step_in_words
from affordlib.types import Goal, Outcome, Plan

_SLIDERS = {
    "x [cm]": {"min": -100 * LIMIT_M, "max": 100 * LIMIT_M, "step": 0.1, "readout_format": ".1f"},
    "y [cm]": {"min": -100 * LIMIT_M, "max": 100 * LIMIT_M, "step": 0.1, "readout_format": ".1f"},
    "turn [°]": {"min": -90, "max": 90, "step": 5, "readout_format": ".0f"},
    "lift [cm]": {"max": 20, "step": 0.5, "readout_format": ".1f"},
}


class PickerControls(widgets.VBox):
    """The controls, which do nothing alone; lengths in cm, turns in degrees, 0 for no matter.

    goal: shown first; planners, executors: the names to choose from; on_goal: is called with the
    goal that a moved slider asks for.
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
        self.run = _button("Run", "play", "Carry the plan out", button_style="primary")
        self.stop = _button("Stop", "stop", "Stop after this action", disabled=True)
        self.progress = widgets.IntProgress(max=1, layout={"width": "9em"})
        self.shove = _button("Shove it", "hand-o-right", "Disturb: shove the object")
        self.move_goal = _button("Move goal", "random", "Disturb: move the goal")
        self.start_over = _button("Start over", "undo", "Put the object back")
        self.name = widgets.Text("plan.json", description="file", layout={"width": "14em"})
        self.save, self.load = _button("Save", "save"), _button("Load", "folder-open")
        self.words = widgets.HTML()
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
        """Set the sliders to a goal, as near as they can show it."""
        self.goal = goal
        for slider, value in zip(self.sliders, self._shown(goal), strict=True):
            slider.value = value

    def _shown(self, goal: Goal) -> list[float]:
        turn_deg = math.degrees(goal.turn_rad or 0.0)
        values = [*(100 * v for v in goal.xy_m), turn_deg, 100 * (goal.height_m or 0.0)]
        return [
            round(min(max(value, slider.min), slider.max), 1)
            for slider, value in zip(self.sliders, values, strict=True)
        ]

    def _slid(self, slider: widgets.FloatSlider, on_goal: Callable[[Goal], None]) -> None:
        """Change that of the goal which the slider is for, unless it only shows what is so."""
        k, value = self.sliders.index(slider), slider.value
        if value == self._shown(self.goal)[k]:
            return
        x, y = self.goal.xy_m
        change = [
            {"xy_m": (round(value / 100, 3), y)},
            {"xy_m": (x, round(value / 100, 3))},
            {"turn_rad": math.radians(value) or None},
            {"height_m": value / 100 or None},
        ]
        on_goal(replace(self.goal, **change[k]))

    def set_running(self, running: bool) -> None:
        """While the robot is at work, only what it listens to can be pressed."""
        for control in (self.run, self.start_over, self.planner, self.executor, self.load):
            control.disabled = running
        self.stop.disabled = not running

    def show_progress(self, done: int, of: int | None = None) -> None:
        """So many actions are done, of so many if that is new."""
        self.progress.value, self.progress.max = done, of or self.progress.max

    def say(self, text: str) -> None:
        """Show a text, as HTML, and have it read aloud where that is wanted."""
        style = "width: 27em; max-width: 100%; line-height: 1.4; white-space: normal"
        self.words.value = f"<div role='status' aria-live='polite' style='{style}'>{text}</div>"


def _button(name: str, icon: str, tooltip: str = "", **kwargs: Any) -> widgets.Button:
    layout = {"width": "auto"}
    return widgets.Button(
        description=name, icon=icon, tooltip=tooltip or name, layout=layout, **kwargs
    )


def plan_in_words(plan: Plan) -> str:
    """The actions, how near they are expected to lead, and what finding them took."""
    steps = ", then ".join(step_in_words(step) for step in plan.steps) or "stay"
    arrives = "" if plan.reaches_goal else " It does not arrive."
    if not plan.reaches_goal and plan.predicted_distance_m <= plan.goal.tolerance_m:
        arrives = " It arrives, but is not predicted to be turned or lifted as the goal asks."
    std_m = plan.steps[-1].std_m if plan.steps else math.nan
    unsure = "" if math.isnan(std_m) else f" (σ of the last step {1000 * std_m:.1f} mm)"
    return (
        f"Plan: {steps}. Expected to end {1000 * plan.predicted_distance_m:.1f} mm from the goal"
        f"{unsure}.{arrives} Found in {1000 * plan.plan_s:.0f} ms."
    )


def outcome_in_words(outcome: Outcome, goal: Goal, how: str, done: int) -> str:
    """Where the object rests (HTML); how: "Done," or "Stopped after", done: how many actions."""
    within = "within" if outcome.distance_m <= goal.tolerance_m else "outside"
    posed = ""
    if goal.turn_rad is not None:
        off = math.degrees(abs(wrap_angle(goal.turn_rad - outcome.turned_rad)))
        posed += f" The turn is off by {off:.1f}°."
    if goal.height_m is not None:
        off = 1000 * abs(goal.height_m - outcome.lifted_m)
        posed += f" The height is off by {off:.1f} mm."
    return (
        f"{how} {done} action{'s' * (done != 1)}: the object rests "
        f"<b>{1000 * outcome.distance_m:.1f} mm</b> from the goal, {within} the tolerance of "
        f"{1000 * goal.tolerance_m:.0f} mm.{posed} {outcome.words}".rstrip()
    )
