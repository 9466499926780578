"""What the goal picker offers: its menus, sliders, buttons and words."""

import html
import math
import re
from collections.abc import Sequence
from typing import Any

import ipywidgets as widgets

from affordlib.results import plain
from affordlib.types import Goal, Outcome, Plan


class PickerControls(widgets.VBox):
    """Controls of a goal picker; `turn` and `height` are 0 if not part of the goal.

    planners, executors: the names to choose from. `words` are placed by the picker.
    """

    def __init__(self, planners: Sequence[str], executors: Sequence[str]) -> None:
        turn = {"min": -90, "max": 90, "step": 5, "readout_format": ".0f"}
        height = {"max": 20, "step": 0.5, "readout_format": ".1f"}
        late = {"continuous_update": False}  # when released
        self.turn = widgets.FloatSlider(description="turn [°]", **turn, **late)
        self.height = widgets.FloatSlider(description="lift [cm]", **height, **late)
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
        menus = self.planner, self.other, self.early, self.executor, self.turn, self.height
        rows = [[one] for one in menus]
        rows.append([self.run, self.stop, self.start_over])
        rows.append([widgets.Label("disturb"), self.shove, self.move_goal])
        layout = {"flex": "1 1 250px", "max_width": "300px"}
        super().__init__([widgets.HBox(row) for row in rows], layout=layout)

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
