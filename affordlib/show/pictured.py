"""Widgets that leave a picture of themselves in a saved notebook."""

from __future__ import annotations

import base64


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
