"""A figure with controls above it, drawn anew when one of them, or a point in it, is moved.

Everything it needs is in this package; nothing is fetched from anywhere.
"""

from __future__ import annotations

import base64
import html
import io
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
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


class DraggedFigure(anywidget.AnyWidget):
    """Shows the PNG `value`, `width` pixels wide; what the reader drags arrives in `dragged`.

    handles: of the points and, with y None, the lines that can be dragged along the phase: name; x
    and y; left and right, where the phase is 0 and 1; top and bottom of the axes; all as shares of
    the picture's width and height. dragged: [name, phase, number], the number growing.
    """

    _esm = _HERE / "dragged_figure.js"
    _css = _HERE / "dragged_figure.css"
    value = traitlets.Bytes(b"").tag(sync=True)
    width = traitlets.Int().tag(sync=True)
    handles = traitlets.List().tag(sync=True)
    dragged = traitlets.List(["", 0.0, 0]).tag(sync=True)


class Pictured:
    """Before a class of ipywidgets: a box of widgets by itself saves only text."""

    def picture(self) -> bytes:
        """What is shown, as a PNG; empty where there is nothing yet."""
        raise NotImplementedError

    def _repr_mimebundle_(self, **kwargs: object) -> dict[str, object]:
        # Without a kernel the notebook shows the picture.
        bundle = super()._repr_mimebundle_(**kwargs) | {"text/plain": type(self).__name__}
        if picture := self.picture():
            bundle["image/png"] = base64.b64encode(picture).decode()
        return bundle


class FigureWidget(Pictured, widgets.VBox):
    """Controls above a figure and a line of words below; errors are shown in that line.

    A subclass draws in `draw(figure)`, which returns the words (HTML), and calls `let_drag` for
    what can be moved by hand; `drag(name, phase)` is told. A saved notebook keeps the picture, and
    shows it where there is no kernel.
    """

    figsize = (10.0, 3.6)

    def __init__(self, controls: Sequence[widgets.Widget]) -> None:
        self._image = DraggedFigure(width=round(DPI * self.figsize[0]))
        self._image.observe(self._dragged, names="dragged")
        self._handles: list[tuple[Axes, str, float, float | None]] = []
        self._waits = False
        self._words = widgets.HTML()
        for control in controls:
            control.observe(lambda _: self.refresh(), names="value")
        row = widgets.HBox(list(controls), layout={"flex_flow": "row wrap"})
        super().__init__([row, self._image, self._words])
        self.refresh()

    def draw(self, figure: Figure) -> str:
        """Draw what the controls say into an empty figure; return it in words."""
        raise NotImplementedError

    def drag(self, name: str, phase: float) -> None:
        """Move a handle to a phase, as a control does."""
        raise NotImplementedError

    def let_drag(self, ax: Axes, name: str, phase: float, y: float | None = None) -> None:
        """Offer a point of axes over the phase, or with y None a vertical line, to the hand."""
        self._handles.append((ax, name, phase, y))

    def _dragged(self, change: dict[str, Any]) -> None:
        name, phase, _ = change["new"]
        self.drag(name, round(float(phase), 2))

    def _placed(self, ax: Axes, name: str, phase: float, y: float | None) -> dict[str, Any]:
        size = ax.figure.bbox.size
        (x, at), (left, _), (right, _) = (
            ax.transData.transform((t, y or 0.0)) / size for t in (phase, 0.0, 1.0)
        )
        box = ax.bbox.extents / [*size, *size]
        return {
            "name": name,
            "x": x,
            "y": None if y is None else 1 - at,
            "left": left,
            "right": right,
            "top": 1 - box[3],
            "bottom": 1 - box[1],
        }

    @contextmanager
    def drawing_once(self) -> Iterator[None]:
        """While entered nothing is drawn, whatever controls change; then all of it."""
        self._waits = True
        try:
            yield
        finally:
            self._waits = False
            self.refresh()

    def refresh(self) -> None:
        """Draw the figure anew."""
        if self._waits:
            return
        # A figure of its own, outside pyplot: no window, nothing to close.
        figure = Figure(figsize=self.figsize, dpi=DPI, layout="constrained")
        canvas = FigureCanvasAgg(figure)
        self._handles.clear()
        try:
            words = self.draw(figure)
        except Exception as error:
            words = f"<b>{type(error).__name__}</b>: {html.escape(str(error))}"
        else:
            # `savefig` would draw everything twice, once for the layout.
            canvas.draw()
            buffer = io.BytesIO()
            Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB").save(buffer, "png")
            with self._image.hold_sync():
                self._image.handles = [self._placed(*handle) for handle in self._handles]
                self._image.value = buffer.getvalue()
        self._words.value = f"<div role='status' aria-live='polite'>{words}</div>"

    def picture(self) -> bytes:
        """What is shown, as a PNG."""
        return self._image.value
