"""Partial actions by hand: break an action off at a phase, and see what becomes of the object."""

from __future__ import annotations

import ipywidgets as widgets
import numpy as np
from matplotlib.figure import Figure

from affordlib.primitives import Primitive
from affordlib.show.figure_widget import FigureWidget
from affordlib.show.plots import NEUTRAL, PREDICTION, TRUTH, plot_footprint, plot_table
from affordlib.types import check_within
from affordlib.world import Tabletop


class PhaseSlider(FigureWidget):
    """A slider over the phase t of an action on the object that stands in a world.

    The dotted line of the figure can be dragged as well.

    The action is executed once in full. Wherever the slider stands, the figure shows the gripper's
    path up to t and where the full action had the object at t; `stop_here()`, the button, executes
    the action up to t for comparison. `rest` maps the phases that were tried to the poses
    (x, y, yaw) in which the object came to rest.
    """

    def __init__(self, world: Tabletop, action: Primitive, phase: float = 0.8) -> None:
        self.world, self.action = world, action
        self._pose = world.object_pose()
        self.full = world.execute_primitive(action)
        self.rest: dict[float, tuple[float, float, float]] = {}
        self._phase = widgets.FloatSlider(
            value=check_within("phase", phase, 0.0, 1.0),
            min=0,
            max=1,
            step=0.01,
            description="phase t",
            layout={"width": "26em"},
        )
        self._stop = widgets.Button(description="Stop it here", icon="stop")
        self._stop.on_click(lambda _: self.stop_here())
        super().__init__([self._phase, self._stop])

    @property
    def phase(self) -> float:
        """Where the slider stands."""
        return round(self._phase.value, 2)

    def expected(self, phase: float) -> np.ndarray:
        """Where the full action had the object at a phase: (x, y, yaw) on the table."""
        effect = [np.interp(phase, self.full.phase, self.full.effect[:, c]) for c in (0, 1, 3)]
        return np.array(self._pose) + effect

    def stop_here(self) -> None:
        """Put the object back, execute the action up to t, and show where the object rests."""
        x, y, yaw = self._pose
        self.world.place(self.world.obj, (x, y), yaw, tool=self.action.tool)
        self.world.execute_primitive(self.action, self.phase)
        self.rest[self.phase] = self.world.object_pose()
        self.refresh()

    def drag(self, name: str, phase: float) -> None:
        """Move the slider to a phase."""
        self._phase.value = phase

    def draw(self, figure: Figure) -> str:
        """Left the table from above, right how far the object has moved over the phase."""
        above, over_time = figure.subplots(1, 2, width_ratios=(1, 1.9))
        t, obj, now = self.phase, self.world.obj, self.expected(self.phase)
        x, y, yaw = self._pose
        plot_table(above, around_m=(x, y), half_width_m=0.24)
        until = self.full.phase <= t
        path = 100 * (self.full.action[:, :2] + (x, y))
        above.plot(*path.T, ":", color=NEUTRAL, lw=1)
        above.plot(*path[until].T, color="black", lw=2, label="gripper")
        plot_footprint(above, obj, (x, y), yaw, label="start")
        moved = 100 * np.hypot(*self.full.effect[:, :2].T)
        over_time.plot(self.full.phase, moved, color=PREDICTION, label="during the full action")
        over_time.axvline(t, color=NEUTRAL, ls=":")
        self.let_drag(over_time, "phase", t)
        rest_cm = {k: 100 * np.hypot(p[0] - x, p[1] - y) for k, p in self.rest.items()}
        label = "at rest, stopped there"
        over_time.plot(list(rest_cm), list(rest_cm.values()), "o", color=TRUTH, label=label)
        over_time.set(xlabel="phase t", ylabel="object has moved [cm]", xlim=(0, 1.02))
        words = (
            f"At t = {t:.2f} the object has moved {np.interp(t, self.full.phase, moved):.1f} cm."
        )
        if t in self.rest:
            rest = self.rest[t]
            plot_footprint(above, obj, rest[:2], rest[2], TRUTH, "at rest")
            off_mm = 1000 * np.hypot(rest[0] - now[0], rest[1] - now[1])
            words += f" Stopped there, it rests <b>{off_mm:.2f} mm</b> from where it was then."
        told = {"label": "full action at t", "filled": False, "style": "--"}  # over what rests
        plot_footprint(above, obj, now[:2], now[2], PREDICTION, **told)
        above.legend(loc="upper left", fontsize=8)
        over_time.legend(loc="upper left")
        return words
