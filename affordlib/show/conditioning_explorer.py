"""What a model foresees from what it is told: observations dragged in time, and the blend w₁.

Equation (2) of the paper: the representation is w₁ r_action + w₂ r_effect, w₂ = 1 - w₁.
"""

from __future__ import annotations

from collections.abc import Sequence

import ipywidgets as widgets
import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from affordlib.models.protocol import EffectModel
from affordlib.show.figure_widget import FigureWidget
from affordlib.show.plots import PREDICTION, TRUTH
from affordlib.types import ACTION_CHANNELS, EFFECT_CHANNELS, Interaction, Observations, Prediction

N_TARGETS = 101


class ConditioningExplorer(FigureWidget):
    """When action and effect are observed and how they are blended; below, what is foreseen.

    model: any `EffectModel`; seen: a full interaction, which is the truth and gives what is
    observed. The black points in the figure, or the first sliders, are dragged to the phases at
    which the action is observed (two, as a planner observes it) and the effect (one); a tick takes
    the observation away. The orange band is mean ± 2 σ. `prediction` is what is shown.
    """

    figsize = (10.0, 4.6)

    def __init__(self, model: EffectModel, seen: Interaction) -> None:
        self.model, self.seen = model, seen
        self.prediction: Prediction | None = None
        with torch.no_grad():
            self._features = model.encode(torch.as_tensor(seen.image, dtype=torch.float32)[None])
        times = {"min": 0, "max": 1, "step": 0.01, "layout": {"width": "24em"}}
        long = {"style": {"description_width": "9em"}}
        self._action_t = widgets.FloatRangeSlider(
            value=(0.0, 1.0), description="action seen at t", **times, **long
        )
        self._effect_t = widgets.FloatSlider(
            value=0.7, description="effect seen at t", **times, **long
        )
        self._weight = widgets.FloatSlider(value=1.0, description="w₁ (action)", **times, **long)
        self._has_action = widgets.Checkbox(True, description="action", indent=False)
        self._has_effect = widgets.Checkbox(False, description="effect", indent=False)
        for box in (self._has_action, self._has_effect):
            box.layout.width = "6em"
        controls = [self._action_t, self._has_action, self._effect_t, self._has_effect]
        super().__init__([*controls, self._weight])

    def observe_at(
        self,
        action_t: Sequence[float] | None = (0.0, 1.0),
        effect_t: float | None = None,
        weight: float = 1.0,
    ) -> None:
        """Set what is observed and how it is blended, as the sliders do; None: not observed."""
        with self.drawing_once():
            self._has_action.value = action_t is not None
            self._has_effect.value = effect_t is not None
            if action_t is not None:
                self._action_t.value = tuple(action_t)
            if effect_t is not None:
                self._effect_t.value = effect_t
            self._weight.value = weight

    def drag(self, name: str, phase: float) -> None:
        """Observe the action (its first or second point) or the effect at another phase."""
        first, second = self._action_t.value
        if name == "effect":
            self._effect_t.value = phase
        elif name == "first action":
            self._action_t.value = min(phase, second), second
        else:
            self._action_t.value = first, max(first, phase)

    def observations(self) -> Observations:
        """What the model is told now; the weight is 1 or 0 where one modality is missing."""
        has_action, has_effect = self._has_action.value, self._has_effect.value
        if not (has_action or has_effect):
            raise ValueError("nothing is observed; tick the action, the effect, or both")
        weight = torch.tensor([self._weight.value]) if has_action and has_effect else None
        action = self._at(self._action_t.value, "action") if has_action else None
        effect = self._at((self._effect_t.value,), "effect") if has_effect else None
        return Observations.of(self.model, action, effect, weight)

    def _at(self, t: Sequence[float], of: str) -> tuple[torch.Tensor, torch.Tensor]:
        """Times (1, n) and the values (1, n, C) then of the action or of the effect."""
        known = ACTION_CHANNELS if of == "action" else EFFECT_CHANNELS
        values = getattr(self.seen, of)[
            :, [known.index(n) for n in getattr(self.model, f"{of}_channels")]
        ]
        at = np.stack([np.interp(t, self.seen.phase, column) for column in values.T], axis=-1)
        return torch.tensor([t], dtype=torch.float32), torch.as_tensor(at).float()[None]

    def draw(self, figure: Figure) -> str:
        """Action and effect over the phase, x and y: truth, what was observed, mean ± 2 σ."""
        told = self.observations()
        t = torch.linspace(0, 1, N_TARGETS)[None]
        with torch.no_grad():
            self.prediction = seen = self.model.predict(self._features, told, t)
        axes = figure.subplots(2, 2, sharex=True, sharey="row")
        rows = (
            ("action", seen.action_mean, seen.action_std, told.action_t, told.action),
            ("effect", seen.effect_mean, seen.effect_std, told.effect_t, told.effect),
        )
        observed = {"action": told.action_mask.any(), "effect": told.effect_mask.any()}
        for row, (of, mean, std, told_t, points) in zip(axes, rows, strict=True):
            known = ACTION_CHANNELS if of == "action" else EFFECT_CHANNELS
            channels = getattr(self.model, f"{of}_channels")
            for ax, name in zip(row, ("x", "y"), strict=True):
                c = channels.index(name)
                truth = getattr(self.seen, of)[:, known.index(name)]
                ax.plot(self.seen.phase, 100 * truth, "--", color=TRUTH, lw=2, label="truth")
                _band(ax, t[0].numpy(), mean[0, :, c].numpy(), std[0, :, c].numpy())
                if observed[of]:
                    at = told_t[0].numpy(), 100 * points[0, :, c].numpy()
                    ax.plot(*at, "o", color="black", label="observed", zorder=5)
                    names = ("first action", "second action") if of == "action" else ("effect",)
                    for point, *place in zip(names, *at, strict=True):
                        self.let_drag(ax, point, *map(float, place))
                ax.set_title(f"{of} {name}")
            row[0].set_ylabel("cm")
        for ax in axes[1]:
            ax.set_xlabel("phase t")
        figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside right upper")
        columns = [self.model.effect_channels.index(name) for name in ("x", "y")]
        end = seen.effect_mean[0, -1, columns].numpy()
        off_mm = 1000 * np.hypot(*(end - self.seen.effect[-1, :2]))
        std_mm = 1000 * float(seen.effect_std[0, -1, columns].norm())
        return (
            f"w₁ = {float(told.weight[0]):.2f}. The end is foreseen <b>{off_mm:.1f} mm</b> from "
            f"where it was, with σ = {std_mm:.1f} mm."
        )


def _band(ax: Axes, t: np.ndarray, mean: np.ndarray, std: np.ndarray) -> None:
    ax.plot(t, 100 * mean, color=PREDICTION, lw=2, label="prediction")
    low, high = 100 * (mean - 2 * std), 100 * (mean + 2 * std)
    ax.fill_between(t, low, high, color=PREDICTION, alpha=0.2, lw=0, label="± 2 σ")
