"""Building blocks of the widgets: a drawing with handles, and figures with controls and handles.

All code is in this package; nothing is fetched from the network.
"""

import base64
import html
import io
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import anywidget
import ipywidgets as widgets
import numpy as np
import traitlets
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

DPI = 90
_HERE = Path(__file__).parent


class Drawing(anywidget.AnyWidget):
    """Shows a picture with handles that can be dragged.

    picture: a data URL, or empty. scene: {"inside": contents of an SVG over it; "box": its viewBox;
    "handles": for each the name of the element (`data-handle`) that it moves, x and y (None: any),
    its range left, right, top, bottom and step; "answered": number of the last request that this
    scene includes}. wanted: [name, x, y, number], the requested position of a handle.
    """

    _esm = _HERE / "drawing.js"
    _css = _HERE / "drawing.css"
    label = traitlets.Unicode().tag(sync=True)
    picture = traitlets.Unicode().tag(sync=True)
    scene = traitlets.Dict().tag(sync=True)
    wanted = traitlets.List(["", 0.0, 0.0, 0]).tag(sync=True)


def words_as_html(text: str, css: str = "") -> str:
    """A text that screen readers announce, as HTML; only what stands in **stars** is bold."""
    text = re.sub(r"\*\*(.*?)\*\*", r"<b>\1</b>", html.escape(text))
    return f"<div role='status' aria-live='polite'><div class='{css}'>{text}</div></div>"


class FigurePicture:
    """Mixin, before a class of ipywidgets: without a kernel, a notebook shows its saved picture."""

    def figure(self) -> Figure | None:
        """The figure that is shown without a kernel."""
        raise NotImplementedError

    def picture(self) -> bytes:
        """The shown picture, as a PNG at twice the resolution; empty if there is none."""
        buffer, figure = io.BytesIO(), self.figure()
        if figure is not None:
            figure.savefig(buffer, dpi=2 * DPI)
        return buffer.getvalue()

    def _repr_mimebundle_(self, **kwargs: object) -> tuple[dict[str, object], dict[str, object]]:
        bundle = super()._repr_mimebundle_(**kwargs) | {"text/plain": type(self).__name__}
        picture = self.picture()
        if not picture:
            return bundle, {}
        width, height = (n // 2 for n in Image.open(io.BytesIO(picture)).size)
        about = {"image/png": {"width": width, "height": height}}
        return bundle | {"image/png": base64.b64encode(picture).decode()}, about


class FigureWidget(FigurePicture, widgets.VBox):
    """Controls above a figure and a line of text below, which also shows errors.

    A subclass draws in `draw(figure)`, which returns the text, and calls `add_handle` for
    what can be dragged; `drag(name, phase)` then does what a control does.
    """

    figsize = (10.0, 3.6)

    def __init__(self, controls: Sequence[widgets.Widget]) -> None:
        label = "Drag the marked points in the figure, or use the controls above it."
        layout = {"width": f"{DPI * self.figsize[0]:.0f}px", "max_width": "100%"}
        self._drawing = Drawing(label=label, layout=layout)
        self._drawing.observe(self._dragged, names="wanted")
        self._handles: list[tuple[Axes, str, float, float | None]] = []
        self._words = widgets.HTML()
        self._figure: Figure | None = None
        self._waits = False
        for control in controls:
            control.observe(lambda _: self.refresh(), names="value")
        row = widgets.HBox(list(controls), layout={"flex_flow": "row wrap"})
        super().__init__([row, self._drawing, self._words])
        self.add_class("affordlib-figure")
        self.refresh()

    def draw(self, figure: Figure) -> str:
        """Draw the controls' settings into an empty figure; return a description."""
        raise NotImplementedError

    def drag(self, name: str, phase: float) -> None:
        """Move a handle to a phase."""
        raise NotImplementedError

    def add_handle(self, ax: Axes, name: str, phase: float, y: float | None = None) -> None:
        """Make a point of the axes draggable over the phase; a vertical line if y is None."""
        self._handles.append((ax, name, phase, y))

    def set_controls(self, values: dict[widgets.Widget, Any]) -> None:
        """Set the values of several controls, and draw once."""
        self._waits = True
        try:
            for control, value in values.items():
                control.value = value
        finally:
            self._waits = False
            self.refresh()

    def refresh(self) -> None:
        """Draw the figure again."""
        if self._waits:
            return
        # Made without pyplot, the figure opens no window and need not be closed.
        figure = Figure(figsize=self.figsize, dpi=DPI, layout="constrained")
        canvas = FigureCanvasAgg(figure)
        shown, self._handles = self._handles, []
        try:
            words = self.draw(figure)
        except Exception as error:
            words, self._handles = str(error) or type(error).__name__, shown
        else:
            # `savefig` would draw twice, once for the layout.
            canvas.draw()
            buffer = io.BytesIO()
            Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB").save(buffer, "png")
            self._figure = figure
            with self._drawing.hold_sync():
                self._drawing.scene = self._scene(*canvas.get_width_height())
                url = base64.b64encode(buffer.getvalue()).decode()
                self._drawing.picture = f"data:image/png;base64,{url}"
        self._words.value = words_as_html(words)

    def figure(self) -> Figure | None:
        """The figure that is shown."""
        return self._figure

    def _scene(self, width: int, height: int) -> dict[str, Any]:
        """The handles in pixels from the upper left corner, with 100 steps over the phase."""
        handles, rings = [], ""
        for k, (ax, _, phase, y) in enumerate(self._handles):
            x, left, right = ax.transData.transform([(t, y or 0) for t in (phase, 0, 1)])
            handle = {"name": str(k), "x": x[0], "left": left[0], "right": right[0]}
            handle |= {"y": None, "top": height - ax.bbox.y1, "bottom": height - ax.bbox.y0}
            if y is not None:
                handle["y"] = handle["top"] = handle["bottom"] = height - x[1]
            handles.append(handle | {"step": (right[0] - left[0]) / 100})
            rings += f'<circle class="hand" data-handle="{k}" r="8"/>'
        box, answered = f"0 0 {width} {height}", self._drawing.wanted[3]
        return {"inside": rings, "box": box, "handles": handles, "answered": answered}

    def _dragged(self, change: dict[str, Any]) -> None:
        k, x, _, _ = change["new"]
        if not 0 <= int(k) < len(self._handles):  # of an earlier picture
            return
        handle = self._drawing.scene["handles"][int(k)]
        phase = (x - handle["left"]) / (handle["right"] - handle["left"])
        self.drag(self._handles[int(k)][1], round(phase, 2))
