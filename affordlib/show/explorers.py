"""Two explorers: figures that sliders change, drawn by the browser from a table of numbers.

All is computed beforehand, so they need no kernel. Without scripts, a still picture is shown.
"""

import itertools
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from IPython.core.pylabtools import print_figure
from matplotlib.figure import Figure
from scipy.interpolate import make_interp_spline

from affordlib.models.base import EffectModel
from affordlib.planning.free_space import placed
from affordlib.primitives import Primitive
from affordlib.show.plots import NEUTRAL, PREDICTION, TRUTH
from affordlib.types import (
    ACTION_CHANNELS,
    EFFECT_CHANNELS,
    Interaction,
    Observations,
    check_within,
)
from affordlib.world import Tabletop

CHANNELS = {"action": ACTION_CHANNELS, "effect": EFFECT_CHANNELS}
BLACK = "#222222"
_SCRIPT = Path(__file__).with_name("explorer.js")


class Line(NamedTuple):
    """What a panel shows: x and y (n,), or (S, n) for each of S states of the sliders.

    style: "-", "--", ":" or "o"; band: half the height (S, n) of a band around it.
    """

    name: str
    color: str
    x: np.ndarray
    y: np.ndarray
    style: str = "-"
    band: np.ndarray | None = None


@dataclass(frozen=True, eq=False, repr=False)
class Explorer:
    """Panels of lines that depend on sliders.

    sliders: name → values; the states are all their combinations, the last slider changing fastest.
    at: the number of the value at which each slider starts. panels: title → lines; square: the
    panel whose axes have the same scale. words: a sentence for each state, in which <b> is bold.
    """

    sliders: dict[str, Sequence[float]]
    at: list[int]
    panels: dict[str, list[Line]]
    words: list[str]
    square: str = ""

    @property
    def state(self) -> int:
        """Number of the state at which it starts."""
        return int(np.ravel_multi_index(self.at, [len(v) for v in self.sliders.values()]))

    def figure(self) -> Figure:
        """The first state as a figure."""
        rows, handles = (len(self.panels) + 1) // 2, {}
        figure = Figure(figsize=(10, 2.6 * rows), layout="constrained")
        axes = figure.subplots(rows, 2, squeeze=False)
        for ax, (title, lines) in zip(axes.flat, self.panels.items(), strict=True):
            for line in lines:
                parts = (line.x, line.y, line.band)
                x, y, band = (v if v is None or v.ndim == 1 else v[self.state] for v in parts)
                [handles[line.name]] = ax.plot(x, y, line.style, color=line.color)
                if band is not None:
                    ax.fill_between(x, y - band, y + band, color=line.color, alpha=0.2, lw=0)
            ax.set(title=title, aspect="equal" if title == self.square else "auto")
        figure.legend(handles.values(), handles, loc="outside lower center", ncols=5)
        return figure

    def _repr_mimebundle_(self, **kwargs: object) -> dict[str, str]:
        """What a notebook shows: numbers and script, and a picture until the script has run."""
        panels = [
            {"title": name, "square": name == self.square, "lines": [x._asdict() for x in lines]}
            for name, lines in self.panels.items()
        ]
        sliders = [{"name": k, "values": list(v)} for k, v in self.sliders.items()]
        data = {"sliders": sliders, "at": self.at, "panels": panels, "words": self.words}
        text = json.dumps(data, separators=(",", ":"), default=_rows).replace("<", "\\u003c")
        picture = print_figure(self.figure(), base64=True, bbox_inches=None)
        said = self.words[self.state].replace("<b>", "").replace("</b>", "")
        inside = f'<img alt="{said}" src="data:image/png;base64,{picture}">'
        script = f"<script>{_SCRIPT.read_text()}(document.currentScript.parentElement, {text})"
        html = f'<div class="affordlib-explorer">{inside}{script}</script></div>'
        return {"text/html": html, "text/plain": type(self).__name__}


def _rows(values: np.ndarray) -> list[list[float]]:
    """Numbers (n,) or (S, n) in JSON's types, as rows with two decimals."""
    return np.atleast_2d(values).astype(float).round(2).tolist()


def conditioning_explorer(
    model: EffectModel, seen: Interaction, effect_t: float = 0.7, weight: float = 1.0
) -> Explorer:
    """Make an explorer of predictions from chosen observations of an interaction.

    The action is observed at 0 and at a second phase, with a weight w₁ as in equation (2) of the
    paper; the effect at one phase, with 1 - w₁. The band is mean ± 2 σ. seen: a full interaction,
    the ground truth; effect_t, weight: the first phase of the effect, and w₁.
    """
    effect_t = check_within("effect_t", effect_t, 0, 1)
    weight = check_within("weight", weight, 0, 1)
    phases, quarters = np.linspace(0, 1, 11).round(2), np.linspace(0, 1, 5)
    sliders = {"action also seen at t": quarters, "effect seen at t": phases, "w₁": quarters}
    states = np.array(list(itertools.product(*sliders.values())))
    context = {"action": np.insert(states[:, :1], 0, 0.0, axis=1), "effect": states[:, 1:2]}
    channels = {of: getattr(model, f"{of}_channels") for of in CHANNELS}
    columns = {of: [CHANNELS[of].index(n) for n in names] for of, names in channels.items()}
    truth = {of: getattr(seen, of)[:, each] for of, each in columns.items()}
    values = {of: make_interp_spline(seen.phase, rows, k=1) for of, rows in truth.items()}
    given = [tuple(map(torch.Tensor, (t, values[of](t)))) for of, t in context.items()]
    observed = Observations.of(model, *given, torch.Tensor(states[:, 2]))
    t = np.linspace(0, 1, 25)
    with torch.no_grad():
        features = model.encode(torch.Tensor(seen.image)[None]).expand(len(states), -1)
        found = model.predict(features, observed, torch.Tensor(t).expand(len(states), -1))
    panels, shown = {}, {"action": states[:, 2] > 0, "effect": states[:, 2] < 1}
    for of, name in itertools.product(CHANNELS, ("x", "y")):
        c = channels[of].index(name)
        mean, std = (100 * getattr(found, f"{of}_{m}")[..., c].numpy() for m in ("mean", "std"))
        dots = 100 * values[of](context[of])[..., c]
        dots[~shown[of]] = mean.min() - 99  # out of sight
        panels[f"{of}, {name} [cm], over phase"] = [
            Line("ground truth", TRUTH, seen.phase[::10], 100 * truth[of][::10, c], "--"),
            Line("prediction ± 2 σ", PREDICTION, t, mean, "-", 2 * std),
            Line("observed", BLACK, context[of], dots, "o"),
        ]
    c = [channels["effect"].index(name) for name in ("x", "y")]
    error_mm = 1000 * np.hypot(*(found.effect_mean[:, -1, c].numpy() - truth["effect"][-1, c]).T)
    std_mm = 1000 * found.effect_std[:, -1, c].norm(dim=-1)
    words = [
        f"The predicted final position is <b>{error:.1f} mm</b> from the true one, "
        f"with σ = {std:.1f} mm."
        for error, std in zip(error_mm, std_mm, strict=True)
    ]
    return Explorer(sliders, [4, round(10 * effect_t), round(4 * weight)], panels, words)


def phase_explorer(world: Tabletop, action: Primitive, phase: float = 0.8) -> Explorer:
    """Make an explorer of where an action on the world's object, stopped at a phase, leaves it.

    The action is executed in full, and stopped at 13 phases. phase: the first one that is shown.
    """
    phase = check_within("phase", phase, 0.0, 1.0)
    start, obj = np.array(world.object_pose()), world.obj
    full, stops = world.execute_primitive(action), np.linspace(0.4, 1, 13).round(2)
    rest = []
    for stop in stops:
        world.place(obj, tuple(start[:2]), start[2], tool=action.tool)
        world.execute_primitive(action, stop)
        rest.append(world.object_pose())
    along = np.linspace(0, 1, 101)
    effect = np.array([np.interp(along, full.phase, full.effect[:, c]) for c in (0, 1, 3)]).T
    during = start + [effect[round(100 * stop)] for stop in stops]
    until = np.minimum(along, stops[:, None])
    hand = [np.interp(until, full.phase, full.action[:, c]) for c in (0, 1)]
    gripper = [100 * (at + way) for at, way in zip(start[:2], hand, strict=True)]

    def outline(poses):
        corners = placed(np.vstack([obj.footprint_m, obj.footprint_m[:1]]), np.array(poses))
        return np.moveaxis(100 * corners, -1, 0)

    moved = 100 * np.hypot(*effect[:, :2].T)
    rest_cm = 100 * np.hypot(*(np.array(rest) - start).T[:2])[:, None]
    panels = {
        "from above [cm]": [
            Line("start", NEUTRAL, *outline([start])[:, 0]),
            Line("gripper", BLACK, *gripper, ":"),
            Line("at rest, stopped at t", TRUTH, *outline(rest)),
            Line("full action at t", BLACK, *outline(during), "--"),
        ],
        "object has moved [cm], over phase": [
            Line("during the full action", BLACK, along, moved),
            Line("at rest, stopped at t", TRUTH, stops[:, None], rest_cm, "o"),
        ],
    }
    off_mm = 1000 * np.hypot(*(np.array(rest) - during).T[:2])
    words = [
        f"At t = {t:.2f} the object has moved {cm:.1f} cm. Stopped there, it rests "
        f"<b>{mm:.2f} mm</b> from that position."
        for t, cm, mm in zip(stops, moved[(100 * stops).round().astype(int)], off_mm, strict=True)
    ]
    at = int(np.abs(stops - phase).argmin())
    return Explorer({"phase t": stops}, [at], panels, words, "from above [cm]")
