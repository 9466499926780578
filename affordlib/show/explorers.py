"""Two widgets: predictions from chosen observations, and final positions of partial actions."""

from collections.abc import Sequence

import ipywidgets as widgets
import numpy as np
import torch
from matplotlib.figure import Figure

from affordlib.models.protocol import EffectModel
from affordlib.primitives import Primitive
from affordlib.show.drawing import FigureWidget
from affordlib.show.plots import NEUTRAL, PREDICTION, TRUTH, plot_footprint, plot_table
from affordlib.types import (
    ACTION_CHANNELS,
    EFFECT_CHANNELS,
    Interaction,
    Observations,
    Prediction,
    check_within,
)
from affordlib.world import Tabletop

CHANNELS = {"action": ACTION_CHANNELS, "effect": EFFECT_CHANNELS}
N_TARGETS = 101
_PHASES = {"min": 0, "max": 1, "step": 0.01, "layout": {"width": "24em", "max_width": "100%"}}


class ConditioningExplorer(FigureWidget):
    """Choose when action and effect are observed and how they are blended; see the prediction.

    Equation (2) of the paper: the representation is w₁ r_action + w₂ r_effect, w₂ = 1 - w₁.

    seen: a full interaction, the ground truth, from which observations are taken. The black points,
    or sliders, set the phases of the observations, a tick removes one; the band is mean ± 2 σ.
    """

    figsize = (10.0, 5.2)

    def __init__(self, model: EffectModel, seen: Interaction) -> None:
        self.model, self.seen = model, seen
        self.prediction: Prediction | None = None
        with torch.no_grad():
            self._features = model.encode(torch.as_tensor(seen.image, dtype=torch.float32)[None])
        look = _PHASES | {"style": {"description_width": "8em"}}
        tick = {"indent": False, "layout": {"width": "6em"}}
        self._action_t = widgets.FloatRangeSlider(
            value=(0.0, 1.0), description="action seen at t", **look
        )
        self._effect_t = widgets.FloatSlider(value=0.7, description="effect seen at t", **look)
        self._weight = widgets.FloatSlider(value=1.0, description="w₁ (action)", **look)
        self._has_action = widgets.Checkbox(True, description="action", **tick)
        self._has_effect = widgets.Checkbox(False, description="effect", **tick)
        controls = [self._action_t, self._has_action, self._effect_t, self._has_effect]
        super().__init__([*controls, self._weight])

    def observe_at(
        self,
        action_t: Sequence[float] | None = (0.0, 1.0),
        effect_t: float | None = None,
        weight: float = 1.0,
    ) -> None:
        """Set what is observed and how it is blended, like the sliders; None: not observed."""
        values = {
            self._has_action: action_t is not None,
            self._has_effect: effect_t is not None,
            self._weight: weight,
        }
        if action_t is not None:
            values[self._action_t] = tuple(action_t)
        if effect_t is not None:
            values[self._effect_t] = effect_t
        self.set_controls(values)

    def drag(self, name: str, phase: float) -> None:
        """Set the phase at which the action (first or second point) or the effect is observed."""
        first, second = self._action_t.value
        if name == "effect":
            self._effect_t.value = phase
        elif name == "first action":
            self._action_t.value = min(phase, second), second
        else:
            self._action_t.value = first, max(first, phase)

    def observations(self) -> Observations:
        """Current input of the model; the weight is 1 or 0 where one modality is missing."""
        has_action, has_effect = self._has_action.value, self._has_effect.value
        if not (has_action or has_effect):
            raise ValueError("nothing is observed; tick the action, the effect, or both")
        weight = torch.tensor([self._weight.value]) if has_action and has_effect else None
        action = self._at(self._action_t.value, "action") if has_action else None
        effect = self._at((self._effect_t.value,), "effect") if has_effect else None
        return Observations.of(self.model, action, effect, weight)

    def _at(self, t: Sequence[float], of: str) -> tuple[torch.Tensor, torch.Tensor]:
        """Phases (1, n), and the values (1, n, C) of the action or the effect at them."""
        columns = [self._truth(of, name) for name in getattr(self.model, f"{of}_channels")]
        at = np.stack([np.interp(t, self.seen.phase, column) for column in columns], axis=-1)
        return torch.tensor([t], dtype=torch.float32), torch.as_tensor(at).float()[None]

    def _truth(self, of: str, name: str) -> np.ndarray:
        return getattr(self.seen, of)[:, CHANNELS[of].index(name)]

    def draw(self, figure: Figure) -> str:
        """Draw x and y of action and effect over phase: truth, observations, mean ± 2 σ."""
        if not (self._has_action.value or self._has_effect.value):
            self.prediction = None
            return "Nothing is observed: tick the action, the effect, or both."
        given = self.observations()
        t = torch.linspace(0, 1, N_TARGETS)
        with torch.no_grad():
            self.prediction = seen = self.model.predict(self._features, given, t[None])
        axes = figure.subplots(2, 2, sharex=True, sharey="row")
        points = {"action": ("first action", "second action"), "effect": ("effect",)}
        for row, of in zip(axes, CHANNELS, strict=True):
            row[0].set_ylabel(f"{of} [cm]")
            channels = getattr(self.model, f"{of}_channels")
            for ax, name in zip(row, ("x", "y"), strict=True):
                c = channels.index(name)
                mean = 100 * getattr(seen, f"{of}_mean")[0, :, c]
                std = 100 * getattr(seen, f"{of}_std")[0, :, c]
                truth = 100 * self._truth(of, name)
                ax.plot(self.seen.phase, truth, "--", color=TRUTH, lw=2, label="ground truth")
                ax.plot(t, mean, color=PREDICTION, lw=2, label="prediction")
                band = {"color": PREDICTION, "alpha": 0.2, "lw": 0, "label": "± 2 σ"}
                ax.fill_between(t, mean - 2 * std, mean + 2 * std, **band)
                ax.set_title(f"{of}, {name}")
                if getattr(given, f"{of}_mask").any():
                    at = getattr(given, f"{of}_t")[0].numpy()
                    value = 100 * getattr(given, of)[0, :, c].numpy()
                    ax.plot(at, value, "o", color="black", label="observed", zorder=5)
                    for point, *place in zip(points[of], at, value, strict=True):
                        self.add_handle(ax, point, *map(float, place))
        for ax in axes[1]:
            ax.set_xlabel("phase t")
        shown = [ax.get_legend_handles_labels() for ax in axes[:, 0]]
        named = {
            name: line for lines, names in shown for line, name in zip(lines, names, strict=True)
        }
        figure.legend(named.values(), named, loc="outside lower center", ncols=4)
        columns = [self.model.effect_channels.index(name) for name in ("x", "y")]
        end = seen.effect_mean[0, -1, columns].numpy()
        error_mm = 1000 * np.hypot(*(end - self.seen.effect[-1, :2]))
        std_mm = 1000 * float(seen.effect_std[0, -1, columns].norm())
        return (
            f"w₁ = {float(given.weight[0]):.2f}. The predicted final position is "
            f"**{error_mm:.1f} mm** from the true one, with σ = {std_mm:.1f} mm."
        )


class PhaseSlider(FigureWidget):
    """A slider, or a dotted line, at the phase t at which an action on the object is stopped.

    The figure shows where the object was at t in the full action; `stop_here()`, the button,
    executes it up to t. `rest` maps the phases tried so far to the poses (x, y, yaw) at rest.
    """

    def __init__(self, world: Tabletop, action: Primitive, phase: float = 0.8) -> None:
        self.world, self.action = world, action
        self._pose = world.object_pose()
        self.full = world.execute_primitive(action)
        self.rest: dict[float, tuple[float, float, float]] = {}
        phase = check_within("phase", phase, 0.0, 1.0)
        self._phase = widgets.FloatSlider(value=phase, description="phase t", **_PHASES)
        self._stop = widgets.Button(description="Stop it here", icon="stop")
        self._stop.on_click(lambda _: self.stop_here())
        super().__init__([self._phase, self._stop])

    @property
    def phase(self) -> float:
        """Phase at which the slider stands."""
        return round(self._phase.value, 2)

    def expected(self, phase: float) -> np.ndarray:
        """Pose (x, y, yaw) of the object on the table at a phase of the full action."""
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
        """Draw the table from above (left) and the object's displacement over the phase (right)."""
        above, over_time = figure.subplots(1, 2, width_ratios=(1, 1.9))
        t, obj, now = self.phase, self.world.obj, self.expected(self.phase)
        x, y, yaw = self._pose
        path = self.full.action[:, :2] + (x, y)
        seen = np.vstack([path, self.full.effect[:, :2] + (x, y)])
        low, high = seen.min(axis=0), seen.max(axis=0)
        plot_table(above, (low + high) / 2, 0.05 + float(max(high - low)) / 2)
        above.plot(*100 * path.T, ":", color=NEUTRAL, lw=1)
        above.plot(*100 * path[self.full.phase <= t].T, color="black", lw=2, label="gripper")
        plot_footprint(above, obj, (x, y), yaw, label="start")
        moved = 100 * np.hypot(*self.full.effect[:, :2].T)
        over_time.plot(self.full.phase, moved, color="black", label="during the full action")
        over_time.axvline(t, color=NEUTRAL, ls=":")
        self.add_handle(over_time, "phase", t)
        rest_cm = [100 * np.hypot(rest[0] - x, rest[1] - y) for rest in self.rest.values()]
        label = "at rest, stopped there"
        over_time.plot(list(self.rest), rest_cm, "o", color=TRUTH, label=label)
        over_time.set(xlabel="phase t", ylabel="object has moved [cm]", xlim=(0, 1.02))
        moved_cm = np.interp(t, self.full.phase, moved)
        words = f"At t = {t:.2f} the object has moved {moved_cm:.1f} cm."
        if t in self.rest:
            rest = self.rest[t]
            plot_footprint(above, obj, rest[:2], rest[2], TRUTH, "at rest")
            off_mm = 1000 * np.hypot(rest[0] - now[0], rest[1] - now[1])
            words += f" Stopped there, it rests **{off_mm:.2f} mm** from that position."
        label = "full action at t"  # drawn over the object at rest
        plot_footprint(above, obj, now[:2], now[2], "black", label, style="--")
        figure.legend(*above.get_legend_handles_labels(), loc="outside lower left", ncols=4)
        over_time.legend(loc="upper left")
        return words
