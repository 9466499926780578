"""Figures in one style: fixed, colour-blind-safe colours for goal, prediction and ground truth.

Plot functions draw into the `ax` that they get and return it. Positions are in centimetres.
"""

import io
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from IPython import get_ipython
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib_inline.config import InlineBackend

from affordlib.geometry import rotated, unit_vector
from affordlib.perception import CAMERA_HEIGHT_M
from affordlib.planning import ClosedLoopResult
from affordlib.planning.effect_map import checked_image
from affordlib.planning.free_space import corners_of
from affordlib.results import write_atomically
from affordlib.types import (
    CROP_WIDTH_M,
    TABLE_X_M,
    TABLE_Y_M,
    Goal,
    Obstacle,
    Outcome,
    Plan,
    Step,
    check_finite,
    check_pair,
    check_within,
)
from affordlib.world import TabletopObject

GOAL, PREDICTION, TRUTH, NEUTRAL = "#0072B2", "#D55E00", "#009E73", "#777777"
_ARROW = {"arrowstyle": "-|>", "color": NEUTRAL, "lw": 1.5}

ENLARGED = 20
"""Radius, in σ, of the disc at the end of a predicted path: a disc of one σ is too small to see."""

# From matplotlib's defaults, so that a reader's own configuration changes no figure of the book.
_STYLE = {
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.titlesize": 11,
    "axes.titlelocation": "left",
    "figure.constrained_layout.use": True,
    "figure.dpi": 90,
    "font.size": 10,
    "grid.alpha": 0.3,
    "legend.frameon": False,
    "savefig.dpi": 120,
}
plt.style.use(["default", _STYLE])

if shell := get_ipython():  # in notebooks figures have their own size, and twice the resolution
    InlineBackend.instance(parent=shell).print_figure_kwargs = {"bbox_inches": None}
    InlineBackend.instance(parent=shell).figure_formats = {"retina"}


def save_figure(figure: Figure, folder: Path, name: str) -> Path:
    """Save a figure as `figures/<name>.png` in a results folder and return its path."""
    path = Path(folder) / "figures" / f"{name}.png"
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    write_atomically(path, buffer.getvalue(), b"PNG")
    return path


def plot_table(ax: Axes, around_m: Sequence[float] = (0.0, 0.0), half_width_m: float = 0.3) -> Axes:
    """Draw an empty top-down view of the table around a point."""
    x, y = (
        100 * check_within("around_m", v, -10, 10, "m") for v in check_pair("around_m", around_m)
    )
    half = 100 * check_within("half_width_m", half_width_m, 0.01, 10.0, "m")
    corners = np.array([(u, v) for u in TABLE_X_M for v in TABLE_Y_M])[[0, 1, 3, 2, 0]]
    ax.plot(*_cm(corners), color=NEUTRAL, lw=1)
    ax.set(xlabel="x [cm]", ylabel="y [cm]", aspect="equal")
    ax.set(xlim=(x - half, x + half), ylim=(y - half, y + half))
    return ax


def plot_footprint(
    ax: Axes,
    obj: TabletopObject,
    xy_m: Sequence[float],
    yaw_rad: float = 0.0,
    color: str = NEUTRAL,
    label: str | None = None,
    style: str = "filled",
) -> Axes:
    """Draw the outline of an object's base at a pose, filled or with a line style such as "--"."""
    closed = np.vstack([obj.footprint_m, obj.footprint_m[:1]])
    closed = _cm(rotated(closed, check_finite("yaw_rad", yaw_rad)) + check_pair("xy_m", xy_m))
    if style == "filled":
        ax.fill(*closed, facecolor=color, alpha=0.25, lw=0)
        style = "-"
    ax.plot(*closed, ls=style, color=color, lw=1.5, label=label)
    return ax


def plot_obstacles(ax: Axes, obstacles: Sequence[Obstacle]) -> Axes:
    """Draw obstacles from above."""
    for one in obstacles:
        ax.fill(*_cm(corners_of(one)), color="#8c6d5a", alpha=0.8, lw=0)
    return ax


def _cm(xy_m: Any) -> np.ndarray:
    """Convert points (n, 2) or one (2,) from metres to x and y in centimetres."""
    return 100 * np.asarray(xy_m, dtype=float).T


def _name(ax: Axes, text: str, at_cm: Sequence[float], offset: Sequence[float], **style) -> None:
    """Write the name of an action, offset from its position in points."""
    plate = {"facecolor": "white", "edgecolor": "none", "alpha": 0.7, "pad": 1}
    style = {"fontsize": 9, "ha": "center", "va": "center"} | style
    ax.annotate(text, at_cm, tuple(offset), textcoords="offset points", bbox=plate, **style)


def _name_in_place(ax: Axes, text: str, step: Step, goal: Goal, row: int) -> None:
    """Label an action that does not move the object, to its right, one label below the other."""
    x, y = _cm(step.predicted_end_xy_m)
    at = x + 100 * goal.tolerance_m, y
    _name(ax, f"{text} {step.primitive.name}", at, (8, -11 * row), ha="left", va="baseline")


def plot_plan(
    ax: Axes,
    plan: Plan,
    sigma: bool = True,
    obj: TabletopObject | None = None,
    yaw_rad: float = 0.0,
) -> Axes:
    """Draw a plan as predicted: the object's path, final position and σ of each step, and the goal.

    sigma: draw a disc at each step's end, with a radius of twenty σ. obj: drawn dotted at its
    predicted pose after each push; yaw_rad: its current yaw.
    """
    goal, row, yaw_rad = plan.goal, 0, check_finite("yaw_rad", yaw_rad)
    start, before = np.array(plan.start_xy_m), [plan.start_xy_m]
    ax.add_patch(plt.Circle(_cm(goal.xy_m), 100 * goal.tolerance_m, color=GOAL, fill=False, lw=1))
    ax.plot(*_cm(goal.xy_m), "*", color=GOAL, ms=13, label="goal", zorder=5)
    for k, step in enumerate(plan.steps):
        end = np.array(step.predicted_end_xy_m)
        text = f"{k + 1}: {100 * step.stop_phase:.0f} %"
        if not hasattr(step.primitive, "direction_rad"):
            row += 1
            _name_in_place(ax, text, step, goal, row)
            continue
        direction = unit_vector(step.primitive.direction_rad)
        tail, tip = _cm(start - 0.075 * direction), _cm(start - 0.035 * direction)
        ax.annotate("", tip, tail, arrowprops=_ARROW, zorder=4)
        aside = -direction if k == 0 else direction[::-1] * (1, -1)
        off = tail[:, None] - _cm(before)
        if aside @ off[:, np.hypot(*off).argmin()] < 0:
            aside = -aside  # away from the path of the push before
        clear = 6 + np.min((20, 6) / np.maximum(np.abs(aside), 1e-6))  # half a label, and a gap
        _name(ax, text, tail, clear * aside)
        label = "prediction" if k == 0 else None
        ax.plot(*_cm(step.predicted_path_xy_m), color=PREDICTION, lw=2, label=label)
        ax.plot(*_cm(end), "o", color=PREDICTION, ms=3)
        if sigma and not math.isnan(step.std_m):
            disc = {"radius": 100 * ENLARGED * step.std_m, "color": PREDICTION, "alpha": 0.35}
            ax.add_patch(plt.Circle(_cm(end), **disc, lw=1, zorder=1.5))
        start, before = end, step.predicted_path_xy_m
        if obj is not None:
            plot_footprint(ax, obj, end, yaw_rad + step.predicted_turn_rad, PREDICTION, style=":")
    return ax


def plot_outcome(
    ax: Axes, outcome: Outcome, obj: TabletopObject | None = None, yaw_rad: float = 0.0
) -> Axes:
    """Draw the true path and final pose of an object over its executed plan (see `plot_plan`)."""
    plot_plan(ax, outcome.plan, sigma=False, obj=obj, yaw_rad=yaw_rad)
    if obj is not None:
        *xy_m, yaw = outcome.end_pose
        plot_footprint(ax, obj, xy_m, yaw, TRUTH)
    for line in ax.lines:
        if (line.get_color(), line.get_linestyle()) == (PREDICTION, "-"):
            line.set(lw=5, alpha=0.4)  # wide, so that it is seen below the executed path
    for k, path in enumerate(outcome.object_paths_xy_m):
        ax.plot(*_cm(path), color=TRUTH, lw=2, ls="--", label="executed" if k == 0 else None)
    ax.plot(*_cm(outcome.end_pose[:2]), "s", color=TRUTH, ms=6, zorder=6)
    title = f"{outcome.plan.planner}: {1000 * outcome.distance_m:.1f} mm from the goal"
    ax.set_title(title, parse_math=False)
    return ax


def plot_closed_loop(ax: Axes, result: ClosedLoopResult) -> Axes:
    """Draw a closed loop from above: the object's path in each action, and disturbances.

    Dots are predicted positions after each action, numbers count the actions, and dotted lines are
    motions between actions.
    """
    goal = result.goal
    first = result.plans[0].goal if result.plans else goal
    if first.xy_m != goal.xy_m:
        ax.plot(*_cm(first.xy_m), "*", color=GOAL, ms=11, mfc="none", label="first goal", zorder=5)
    ax.plot(*_cm(goal.xy_m), "*", color=GOAL, ms=13, label="goal", zorder=5)
    start = next(iter(result.seen_xy_m), (math.nan, math.nan))  # lost before it was seen
    at, row, others = np.array(start), 0, "moved by others"
    ax.plot(*_cm(at), "o", color=NEUTRAL, ms=5, label="start")
    for k, (step, path) in enumerate(zip(result.steps, result.object_paths_xy_m, strict=True)):
        if math.dist(path[0], at) > 0.003:
            ax.plot(*_cm([at, path[0]]), ":", color="black", lw=1.2, label=others)
            others = None
        truth, prediction = ("ground truth", "prediction") if k == 0 else (None, None)
        ax.plot(*_cm(path), color=TRUTH, lw=2, label=truth)
        ax.plot(*_cm(step.predicted_end_xy_m), "o", color=PREDICTION, ms=5, label=prediction)
        at = path[-1]
        if not hasattr(step.primitive, "direction_rad"):
            row += 1
            _name_in_place(ax, f"{k + 1}", step, goal, row)
            continue
        moved = np.hypot(*np.diff(path, axis=0, prepend=path[:1]).T).cumsum()
        middle = [np.interp(moved[-1] / 2, moved, path[:, c]) for c in (0, 1)]
        _name(ax, f"{k + 1}", _cm(middle), (0, 0))
    return ax


def plot_depth(ax: Axes, image: np.ndarray, title: str = "") -> Axes:
    """Draw the depth channel of an image (2, 48, 48): the higher above the table, the brighter."""
    height_m = CAMERA_HEIGHT_M - checked_image(image)[0, 0]
    half = 50 * CROP_WIDTH_M
    ax.imshow(height_m, extent=(-half, half, -half, half), cmap="cividis", vmin=0)
    ax.grid(False)
    ax.set(title=title, xlabel="x [cm]", ylabel="y [cm]", xticks=(-5, 0, 5), yticks=(-5, 0, 5))
    return ax


def plot_flow(
    ax: Axes, boxes: Mapping[str, tuple[float, float, str]], arrows: Sequence[tuple[str, str]]
) -> Axes:
    """Draw texts in boxes at (x, y), coloured by their third entry, and arrows between them."""
    drawn = {}
    for text, (x, y, color) in boxes.items():
        style = {"boxstyle": "round,pad=0.4", "fc": "white", "ec": color, "lw": 1.5}
        drawn[text] = ax.text(x, y, text, ha="center", va="center", bbox=style)
    for tail, tip in arrows:
        ends = {"patchA": drawn[tail].get_bbox_patch(), "patchB": drawn[tip].get_bbox_patch()}
        ax.annotate("", boxes[tip][:2], boxes[tail][:2], arrowprops=_ARROW | ends)
    ax.axis("off")
    return ax
