"""What the goal picker offers: its menus, sliders, buttons and words."""

import html
import math
import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import ipywidgets as widgets

from affordlib.results import plain
from affordlib.types import Goal, Outcome, Plan

LIMIT_M = 0.35
"""Largest goal coordinate that can be picked [m]."""

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
    new goal when a slider is moved. `words` are placed by the picker.
    """

    def __init__(
        self,
        goal: Goal,
        planners: Sequence[str],
        executors: Sequence[str],
        on_goal: Callable[[Goal], None],
    ) -> None:
        own = {"continuous_update": False}  # or each window sends goals back, rounded and late
        self.sliders = [widgets.FloatSlider(description=n, **s, **own) for n, s in _SLIDERS.items()]
        self.x, self.y, self.turn, self.height = self.sliders
        self.planner = widgets.Dropdown(options=list(planners), description="planner")
        self.other = widgets.Dropdown(options=["nothing", *planners], description="compare")
        self.early = widgets.Checkbox(value=True, description="may stop early", indent=False)
        self.executor = widgets.Dropdown(options=list(executors), description="carry out")
        self.run = _button("Run", "play", "Execute the plan", button_style="primary")
        self.stop = _button("Stop", "stop", "Stop after this action", disabled=True)
        self.shove = _button("Shove it", "hand-o-right", "Disturb: shove the object")
        self.move_goal = _button("Move goal", "random", "Disturb: move the goal")
        self.start_over = _button("Start over", "undo", "Put object and goal back")
        self.words, self.said = widgets.HTML(), ""
        self.show(goal)
        for slider in self.sliders:
            slider.observe(lambda change: self._slid(change["owner"], on_goal), names="value")
        rows = [[w] for w in (self.planner, self.other, self.early, self.executor, *self.sliders)]
        rows.append([self.run, self.stop, self.start_over])
        rows.append([widgets.Label("disturb"), self.shove, self.move_goal])
        layout = {"flex": "1 1 250px", "max_width": "300px"}
        super().__init__([widgets.HBox(row) for row in rows], layout=layout)

    def show(self, goal: Goal) -> None:
        """Set the sliders to a goal, as accurately as they can show it."""
        self.goal, self._numbers = goal, [*goal.xy_m, goal.turn_rad or 0.0, goal.height_m or 0.0]
        for slider, value in zip(self.sliders, self._shown(), strict=True):
            slider.value = value

    def _shown(self) -> list[float]:
        each = zip(self.sliders, _SCALES, self._numbers, strict=True)
        return [round(min(max(scale * v, s.min), s.max), 1) for s, scale, v in each]

    def _slid(self, slider: widgets.FloatSlider, on_goal: Callable[[Goal], None]) -> None:
        """Change the goal's value that belongs to a slider, unless the slider follows the goal."""
        k, numbers = self.sliders.index(slider), [*self._numbers]
        if slider.value != self._shown()[k]:
            numbers[k] = round(slider.value / _SCALES[k], 12)
            x, y, turn, height = numbers
            on_goal(replace(self.goal, xy_m=(x, y), turn_rad=turn or None, height_m=height or None))

    def set_running(self, running: bool) -> None:
        """Disable the controls that have no effect during a run."""
        for one in (self.planner, self.other, self.early, self.executor, self.run, self.start_over):
            one.disabled = running
        self.stop.disabled = not running

    def say(self, text: str, css: str = "") -> None:
        """Show a text, and announce it to screen readers."""
        self.said, self.words.value = text, words_as_html(text, css)


def words_as_html(text: str, css: str = "") -> str:
    """A text that screen readers announce, as HTML; only what stands in **stars** is bold."""
    text = re.sub(r"\*\*(.*?)\*\*", r"<b>\1</b>", html.escape(plain(text)))
    return f"<div role='status' aria-live='polite'><div class='{css}'>{text}</div></div>"


def _button(name: str, icon: str, tooltip: str, **kwargs: Any) -> widgets.Button:
    layout = {"width": "auto", "flex": "none"}
    return widgets.Button(description=name, icon=icon, tooltip=tooltip, layout=layout, **kwargs)


def plan_in_words(plan: Plan) -> str:
    """Describe a plan: its actions, and their predicted distance to the goal."""
    steps = [f"{step.primitive.name} to {100 * step.stop_phase:.0f} %" for step in plan.steps]
    steps = [words.replace("_", " ") for words in steps]
    std_m = plan.steps[-1].std_m if plan.steps else math.nan
    spread = "" if math.isnan(std_m) else f" (σ of the last step {1000 * std_m:.1f} mm)"
    words = (
        f"Plan: {', then '.join(steps) or 'no action'}. Predicted to end "
        f"{1000 * plan.predicted_distance_m:.1f} mm from the goal{spread}."
    )
    missed = " Up to three pushes or drags do not reach the goal; a closed loop then plans again."
    if plan.predicted_distance_m <= plan.goal.tolerance_m:
        missed = " It reaches the goal's position, but not its turn or height."
    return words if plan.reaches_goal else words + missed


def outcome_in_words(outcome: Outcome, goal: Goal, how: str, done: int) -> tuple[str, str]:
    """Describe an outcome, and name its look; how: "Done," or "Stopped after"; done: actions."""
    within = "within" if outcome.distance_m <= goal.tolerance_m else "outside"
    errors = goal.errors(outcome.end_pose[:2], outcome.turned_rad, outcome.lifted_m)
    posed = [f" The {name} has an error of {error.text}." for name, error in errors.items()][1:]
    words = (
        f"{how} {done} action{'s' * (done != 1)}: the object rests "
        f"**{1000 * outcome.distance_m:.1f} mm** from the goal, {within} the tolerance of "
        f"{1000 * goal.tolerance_m:.0f} mm.{''.join(posed)} {outcome.words}"
    )
    return words, f"outcome {within}"
