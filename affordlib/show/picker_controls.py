"""What stands beside the table of a goal picker: sliders, menus, buttons and words."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import ipywidgets as widgets

from affordlib.primitives import wrap_angle
from affordlib.types import Goal, Outcome, Plan, Step


class PickerControls:
    """The controls, which do nothing by themselves; lengths in cm, turns in degrees.

    planners, executors: the names to choose from. limit_m: how far from the middle a goal may be.
    """

    def __init__(
        self, goal: Goal, planners: Sequence[str], executors: Sequence[str], limit_m: float
    ) -> None:
        limits = {"min": -100 * limit_m, "max": 100 * limit_m, "step": 0.1, "readout_format": ".1f"}
        self.x = widgets.FloatSlider(description="x [cm]", **limits)
        self.y = widgets.FloatSlider(description="y [cm]", **limits)
        turns = {"min": -90, "max": 90, "step": 5, "readout_format": ".0f"}
        self.turn = widgets.FloatSlider(description="turn [°]", **turns)
        heights = {"max": 20, "step": 0.5, "readout_format": ".1f"}
        self.height = widgets.FloatSlider(description="lift [cm]", **heights)
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

    def box(self) -> widgets.VBox:
        """All of them, one below the other."""
        rows = [
            [self.planner],
            [self.executor],
            [self.x],
            [self.y],
            [self.turn],
            [self.height],
            [self.run, self.stop, self.progress],
            [widgets.Label("disturb"), self.shove, self.move_goal],
            [self.start_over],
            [self.name, self.save, self.load],
            [self.words],
        ]
        return widgets.VBox([widgets.HBox(row) for row in rows])

    def show(self, goal: Goal) -> None:
        """Set the sliders to a goal."""
        self.x.value, self.y.value = (round(100 * v, 1) for v in goal.xy_m)
        self.turn.value = round(math.degrees(goal.turn_rad or 0.0), 1)
        self.height.value = round(100 * (goal.height_m or 0.0), 1)

    def place_m(self, goal: Goal, change: dict[str, Any]) -> tuple[float, float]:
        """The place [m] that a moved slider asks for; the other may end before the goal does."""
        x, y = goal.xy_m
        moved = change["new"] / 100
        return (moved, y) if change["owner"] is self.x else (x, moved)

    def pose(self, goal: Goal, change: dict[str, Any]) -> tuple[float, float]:
        """The turn [°] and the height [cm] that a moved slider asks for, likewise."""
        turn_deg, height_cm = math.degrees(goal.turn_rad or 0.0), 100 * (goal.height_m or 0.0)
        is_turn = change["owner"] is self.turn
        return (change["new"], height_cm) if is_turn else (turn_deg, change["new"])

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
    return widgets.Button(
        description=name, icon=icon, tooltip=tooltip or name, layout={"width": "auto"}, **kwargs
    )


def step_in_words(step: Step) -> str:
    """Which primitive, and to which share of its phase."""
    return f"{step.primitive.name.replace('_', ' ')} to {100 * step.stop_phase:.0f} %"


def plan_in_words(plan: Plan) -> str:
    """The actions, how near they are expected to lead, and what finding them took."""
    steps = ", then ".join(step_in_words(step) for step in plan.steps) or "stay"
    arrives = "" if plan.reaches_goal else " It does not arrive."
    if not plan.reaches_goal and plan.predicted_distance_m <= plan.goal.tolerance_m:
        arrives = " It arrives, but is not foreseen to be turned or lifted there as the goal asks."
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
