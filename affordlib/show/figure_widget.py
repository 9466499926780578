"""A figure with controls beside it, drawn anew when one of them is moved."""

from __future__ import annotations

import base64
import html
import io
from typing import TYPE_CHECKING

import ipywidgets as widgets
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

if TYPE_CHECKING:
    from collections.abc import Sequence

DPI = 90


class FigureWidget(widgets.VBox):
    """Controls above a figure and a line of words below; errors are shown in that line.

    A subclass draws in `draw(figure)`, which returns the words (HTML). A saved notebook keeps the
    picture, and shows it where there is no kernel.
    """

    figsize = (10.0, 3.6)

    def __init__(self, controls: Sequence[widgets.Widget]) -> None:
        width = f"{round(DPI * self.figsize[0])}px"
        self._image = widgets.Image(format="png", layout={"width": width, "max_width": "100%"})
        self._words = widgets.HTML()
        for control in controls:
            control.observe(lambda _: self.refresh(), names="value")
        row = widgets.HBox(list(controls), layout={"flex_flow": "row wrap"})
        super().__init__([row, self._image, self._words])
        self.refresh()

    def draw(self, figure: Figure) -> str:
        """Draw what the controls say into an empty figure; return it in words."""
        raise NotImplementedError

    def refresh(self) -> None:
        """Draw the figure anew."""
        # A figure of its own, outside pyplot: no window, nothing to close.
        figure = Figure(figsize=self.figsize, layout="constrained")
        FigureCanvasAgg(figure)
        try:
            words = self.draw(figure)
        except Exception as error:
            words = f"<b>{type(error).__name__}</b>: {html.escape(str(error))}"
        else:
            buffer = io.BytesIO()
            figure.savefig(buffer, format="png", dpi=DPI)
            self._image.value = buffer.getvalue()
        self._words.value = f"<div role='status' aria-live='polite'>{words}</div>"

    def _repr_mimebundle_(self, **kwargs: object) -> dict[str, object]:
        # A box of widgets saves only text; the picture stays in the notebook without a kernel.
        bundle = super()._repr_mimebundle_(**kwargs) | {"text/plain": type(self).__name__}
        if self._image.value:
            bundle["image/png"] = base64.b64encode(self._image.value).decode()
        return bundle
