"""Pick a goal with sliders, see the plan redrawn, run it in the world.

A view on plain objects: everything it does can be done with `plan_*` and `carry_out`.
"""

from __future__ import annotations

import base64
import html
import io
from typing import TYPE_CHECKING

import ipywidgets as widgets
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from affordlib.planning import carry_out
from affordlib.show.plots import plot_footprint, plot_outcome, plot_plan, plot_table
from affordlib.types import Goal

if TYPE_CHECKING:
    from collections.abc import Callable

    from affordlib.types import Outcome, Plan
    from affordlib.world import Tabletop


class GoalPicker(widgets.VBox):
    """Sliders for a goal, a choice of planners, the plan as a picture, and a button to run it.

    planners: name → function (image, start_xy_m, goal) → Plan. `plan` and `outcome` hold what is
    shown; `pick(x_m, y_m)` and `run()` do what the sliders and the button do.
    """

    def __init__(
        self,
        world: Tabletop,
        planners: dict[str, Callable[..., Plan]],
        goal_xy_m: tuple[float, float] = (0.12, 0.10),
        reach_m: float = 0.25,
    ) -> None:
        self.world, self.planners = world, planners
        self.plan: Plan | None = None
        self.outcome: Outcome | None = None
        limits = {"min": -reach_m * 100, "max": reach_m * 100, "step": 0.5, "readout_format": ".1f"}
        self._x = widgets.FloatSlider(value=100 * goal_xy_m[0], description="x [cm]", **limits)
        self._y = widgets.FloatSlider(value=100 * goal_xy_m[1], description="y [cm]", **limits)
        self._planner = widgets.Dropdown(options=list(planners), description="planner")
        self._run = widgets.Button(description="Run", button_style="primary", icon="play")
        self._picture = widgets.Image(format="png", layout={"width": "460px"})
        self._words = widgets.HTML()
        for control in (self._x, self._y, self._planner):
            control.observe(lambda _: self._safely(self._replan), names="value")
        self._run.on_click(lambda _: self._safely(self.run))
        controls = widgets.VBox([self._x, self._y, self._planner, self._run, self._words])
        super().__init__([widgets.HBox([self._picture, controls])])
        self._replan()

    def pick(self, x_m: float, y_m: float) -> None:
        """Set the goal [m] and redraw the plan, as moving the sliders does."""
        goal = Goal((x_m, y_m))
        with self.hold_trait_notifications():
            self._x.value, self._y.value = 100 * goal.xy_m[0], 100 * goal.xy_m[1]
        self._replan()

    def run(self) -> None:
        """Carry the plan out in the world and show what came of it; the next plan starts there."""
        self._run.disabled = True
        try:
            self.outcome = carry_out(self.world, self.plan)
        finally:
            self._run.disabled = False
        self._draw(self.outcome)
        distance_mm = 1000 * self.outcome.distance_m
        self._say(f"The object rests <b>{distance_mm:.1f} mm</b> from the goal.")

    def _safely(self, action: Callable[[], None]) -> None:
        try:
            action()
        except Exception as error:
            self._say(f"<b>{type(error).__name__}</b>: {html.escape(str(error))}")

    def _replan(self) -> None:
        goal = Goal((self._x.value / 100, self._y.value / 100))
        start = self.world.object_pose()[:2]
        self.plan = self.planners[self._planner.value](self.world.look(), start, goal)
        self._draw(self.plan)
        steps = ", ".join(f"push to {100 * s.stop_phase:.0f} %" for s in self.plan.steps) or "stay"
        self._say(
            f"Plan: {steps}. Expected distance {1000 * self.plan.predicted_distance_m:.1f} mm, "
            f"found in {1000 * self.plan.plan_s:.0f} ms."
        )

    def _say(self, text: str) -> None:
        self._words.value = f"<div style='max-width: 22em; line-height: 1.4'>{text}</div>"

    def _draw(self, shown: Plan | Outcome) -> None:
        # A figure of its own, outside pyplot: no window, nothing to close.
        figure = Figure(figsize=(5, 5), layout="constrained")
        FigureCanvasAgg(figure)
        ax = plot_table(figure.add_subplot(), half_width_m=0.32)
        x, y, yaw = self.world.object_pose()
        plot_footprint(ax, self.world.thing, (x, y), yaw)
        (plot_plan if shown is self.plan else plot_outcome)(ax, shown)
        ax.legend(loc="upper left")
        buffer = io.BytesIO()
        figure.savefig(buffer, format="png", dpi=90)
        self._picture.value = buffer.getvalue()

    def _repr_mimebundle_(self, **kwargs: object) -> dict[str, object]:
        # A box of widgets saves only text; the picture stays in the notebook without a kernel.
        bundle = super()._repr_mimebundle_(**kwargs)
        return {**bundle, "image/png": base64.b64encode(self._picture.value).decode()}
