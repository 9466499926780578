"""Notebooks as files: which of their cells and outputs are kept when they are committed."""

from __future__ import annotations

from collections.abc import Iterable

import nbformat

WIDGET = "application/vnd.jupyter.widget-view+json"
ADDED = {"injected-parameters", "papermill-error-cell-tag"}


def own_cells(cells: Iterable[nbformat.NotebookNode]) -> list[nbformat.NotebookNode]:
    """The cells without those that papermill adds."""
    return [c for c in cells if not ADDED & set(c.metadata.get("tags", []))]


def cleaned(notebook: nbformat.NotebookNode) -> str:
    """Return an executed notebook as it is committed: outputs and tags kept, the rest dropped.

    Of a widget its picture is kept: without its kernel JupyterLab would show an error in its place.
    """
    cells = own_cells(notebook.cells)
    for cell in cells:
        for output in cell.get("outputs", []):
            if "image/png" in output.get("data", ()):
                output.data.pop(WIDGET, None)
        cell.metadata = {k: cell.metadata[k] for k in ("tags", "jupyter") if cell.metadata.get(k)}
    clean = nbformat.v4.new_notebook(
        cells=cells,
        metadata={
            "kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"},
            "language_info": {"name": "python"},
        },
    )
    return nbformat.writes(clean) + "\n"
