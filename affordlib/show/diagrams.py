"""Data-flow diagrams: boxes and arrows."""

from collections.abc import Mapping, Sequence

from matplotlib.axes import Axes

from affordlib.show.plots import NEUTRAL


def plot_flow(
    ax: Axes, boxes: Mapping[str, tuple[float, float, str]], arrows: Sequence[tuple[str, str]]
) -> Axes:
    """Draw texts in boxes at (x, y), coloured by their third entry, and arrows between them."""
    drawn = {}
    for text, (x, y, color) in boxes.items():
        style = {"boxstyle": "round,pad=0.4", "fc": "white", "ec": color, "lw": 1.5}
        drawn[text] = ax.text(x, y, text, ha="center", va="center", bbox=style)
    for tail, tip in arrows:
        arrow = {"arrowstyle": "-|>", "color": NEUTRAL, "lw": 1.5}
        arrow |= {"patchA": drawn[tail].get_bbox_patch(), "patchB": drawn[tip].get_bbox_patch()}
        ax.annotate("", boxes[tip][:2], boxes[tail][:2], arrowprops=arrow)
    ax.axis("off")
    return ax
