"""Figures of one look: fixed, colour-blind-safe colours for goal, prediction and truth.

Every function draws into the `ax` that it is given and returns it. Positions are in centimetres.
"""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from torch import Tensor

from affordlib.perception import CAMERA_HEIGHT_M
from affordlib.planning import ClosedLoopResult
from affordlib.primitives import Grasp, Rotate
from affordlib.results import write_atomically
from affordlib.types import (
    CROP_WIDTH_M,
    TABLE_X_M,
    TABLE_Y_M,
    Goal,
    Outcome,
    Plan,
    check_array,
    check_finite,
    check_pair,
    check_within,
)
from affordlib.world import TabletopObject

GOAL, PREDICTION, TRUTH, NEUTRAL = "#0072B2", "#D55E00", "#009E73", "#777777"

ENLARGED = 20
"""So many times σ is the radius of the disc at the end of a foreseen path; σ itself is too small to
be seen."""

plt.rcParams.update(
    {
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
)


def save_figure(figure: Figure, folder: Path, name: str) -> Path:
    """Save a figure as `figures/<name>.png` in a results folder and return its path."""
    path = Path(folder) / "figures" / f"{name}.png"
    path.parent.mkdir(parents=True, exist_ok=True)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    write_atomically(path, buffer.getvalue(), b"PNG")
    return path


def plot_table(ax: Axes, around_m: Sequence[float] = (0.0, 0.0), half_width_m: float = 0.3) -> Axes:
    """An empty top-down view of the table around a point."""
    around_m = [check_within("around_m", v, -10, 10, "m") for v in check_pair("around_m", around_m)]
    half_width_m = check_within("half_width_m", half_width_m, 0.01, 10.0, "m")
    ax.set_aspect("equal")
    ax.set_xlim(100 * (around_m[0] - half_width_m), 100 * (around_m[0] + half_width_m))
    ax.set_ylim(100 * (around_m[1] - half_width_m), 100 * (around_m[1] + half_width_m))
    corners = 100 * np.array([[x, y] for x, y in _corners()])
    ax.plot(*corners.T, color=NEUTRAL, lw=1)
    ax.set_xlabel("x [cm]")
    ax.set_ylabel("y [cm]")
    return ax


def _corners() -> list[tuple[float, float]]:
    (x0, x1), (y0, y1) = TABLE_X_M, TABLE_Y_M
    return [(x0, y0), (x1, y0), (x1, y1), (x0, y1), (x0, y0)]


def plot_footprint(
    ax: Axes,
    obj: TabletopObject,
    xy_m: Sequence[float],
    yaw_rad: float = 0.0,
    color: str = NEUTRAL,
    label: str | None = None,
    filled: bool = True,
    style: str = "-",
) -> Axes:
    """The outline of an object's base at a pose."""
    yaw_rad = check_finite("yaw_rad", yaw_rad)
    c, s = math.cos(yaw_rad), math.sin(yaw_rad)
    outline = 100 * (obj.footprint_m @ np.array([[c, s], [-s, c]]) + check_pair("xy_m", xy_m))
    ax.fill(*outline.T, facecolor=color if filled else "none", alpha=0.25 if filled else 1, lw=0)
    ax.plot(*np.vstack([outline, outline[:1]]).T, style, color=color, lw=1.5, label=label)
    return ax


_PLATE = {"facecolor": "white", "edgecolor": "none", "alpha": 0.7, "pad": 1}


def _beside(ax: Axes, words: str, end_cm: np.ndarray, goal: Goal, below: int) -> int:
    """Name an action that stays in its place, to the right of it and below the one before."""
    x, y = end_cm
    at = (x + 100 * goal.tolerance_m, y)
    offset = (8, below - 11)
    ax.annotate(words, at, offset, textcoords="offset points", fontsize=8, bbox=_PLATE)
    return below - 11


def plot_plan(
    ax: Axes,
    plan: Plan,
    sigma: bool = True,
    obj: TabletopObject | None = None,
    yaw_rad: float = 0.0,
) -> Axes:
    """A plan as predicted: the object's path, where each step stops and σ there, and the goal.

    sigma: draw a disc at each step's end, with twenty times σ for its radius.
    obj: drawn dotted as each later push is foreseen to find it, yaw_rad being how it stands now.
    """
    circle = plt.Circle(
        100 * np.array(plan.goal.xy_m), 100 * plan.goal.tolerance_m, color=GOAL, fill=False, lw=1
    )
    ax.add_patch(circle)
    ax.plot(*(100 * np.array(plan.goal.xy_m)), "*", color=GOAL, ms=13, label="goal", zorder=5)
    first = start = np.array(plan.start_xy_m)
    below, turn = 0, 0.0
    for k, step in enumerate(plan.steps):
        end = 100 * np.array(step.predicted_end_xy_m)
        label = f"{k + 1}: {100 * step.stop_phase:.0f} %"
        if isinstance(step.primitive, Grasp | Rotate):
            below = _beside(ax, f"{label} {step.primitive.name}", end, plan.goal, below)
            continue
        direction = np.array(
            [math.cos(step.primitive.direction_rad), math.sin(step.primitive.direction_rad)]
        )
        if obj is not None and k > 0:
            plot_footprint(ax, obj, start, yaw_rad + turn, PREDICTION, filled=False, style=":")
        tail = 100 * (start - 0.075 * direction)
        ax.annotate(
            "",
            100 * (start - 0.035 * direction),
            tail,
            arrowprops={"arrowstyle": "-|>", "color": NEUTRAL, "lw": 1.5},
            zorder=4,
        )
        aside = direction[::-1] * (1, -1)
        aside *= 22 if aside @ (start - first) >= 0 else -22  # away from where the object stood
        ax.annotate(
            label,
            tail,
            ha="center",
            va="center",
            fontsize=8,
            xytext=tuple(-10 * direction if k == 0 else aside),
            textcoords="offset points",
            bbox=_PLATE,
        )
        ax.plot(
            *(100 * step.predicted_path_xy_m.T),
            color=PREDICTION,
            lw=2,
            label="prediction" if k == 0 else None,
        )
        ax.plot(*end, "o", color=PREDICTION, ms=3)
        if sigma and not math.isnan(step.std_m):
            disc = {"radius": 100 * ENLARGED * step.std_m, "color": PREDICTION, "alpha": 0.35}
            ax.add_patch(plt.Circle(end, **disc, lw=1, zorder=1.5))
        start, turn = np.array(step.predicted_end_xy_m), step.predicted_turn_rad
    return ax


def plot_outcome(
    ax: Axes, outcome: Outcome, obj: TabletopObject | None = None, yaw_rad: float = 0.0
) -> Axes:
    """What carrying out a plan gave: the object's real path, over the plan (see `plot_plan`)."""
    plot_plan(ax, outcome.plan, False, obj, yaw_rad)
    for k, path in enumerate(outcome.object_paths_xy_m):
        ax.plot(*(100 * path.T), color=TRUTH, lw=2, ls="--", label="truth" if k == 0 else None)
    ax.plot(*(100 * np.array(outcome.end_pose[:2])), "s", color=TRUTH, ms=6)
    ax.set_title(f"{outcome.plan.planner}: {1000 * outcome.distance_m:.1f} mm from the goal")
    return ax


def plot_closed_loop(
    ax: Axes, pursuit: ClosedLoopResult, obj: TabletopObject | None = None
) -> Axes:
    """A pursuit from above: where each action took the object, and where it was moved by others.

    Dots are where the object was expected after each action; dotted lines what nobody planned.
    obj: drawn as it stands in the end, if given.
    """
    first = pursuit.plans[0].goal if pursuit.plans else pursuit.goal
    if first.xy_m != pursuit.goal.xy_m:
        ax.plot(*(100 * np.array(first.xy_m)), "*", color=GOAL, ms=11, mfc="none", zorder=5)
    ax.plot(*(100 * np.array(pursuit.goal.xy_m)), "*", color=GOAL, ms=13, label="goal", zorder=5)
    at = np.array(pursuit.seen_xy_m[0])
    below = 0
    ax.plot(*(100 * at), "o", color=NEUTRAL, ms=5)
    for k, (step, path) in enumerate(zip(pursuit.steps, pursuit.object_paths_xy_m, strict=True)):
        if np.hypot(*(path[0] - at)) > 0.003:
            label = "moved by others" if "moved by others" not in _labels(ax) else None
            ax.plot(*(100 * np.array([at, path[0]]).T), ":", color="black", lw=1.2, label=label)
        ax.plot(*(100 * path.T), color=TRUTH, lw=2, label="truth" if k == 0 else None)
        end = 100 * np.array(step.predicted_end_xy_m)
        ax.plot(*end, "o", color=PREDICTION, ms=5, label="prediction" if k == 0 else None)
        if isinstance(step.primitive, Grasp | Rotate):
            below = _beside(ax, f"{k + 1} {step.primitive.name}", end, pursuit.goal, below)
            at = path[-1]
            continue
        x, y = path[-1] - path[0]
        aside = np.array([-y, x]) / max(math.hypot(x, y), 1e-6)
        ax.annotate(
            f"{k + 1} {step.primitive.name}",
            100 * path[len(path) // 2 :].mean(axis=0),
            tuple((-1) ** k * 14 * aside),
            textcoords="offset points",
            ha="center",
            va="center",
            fontsize=7,
            bbox=_PLATE,
        )
        at = path[-1]
    if obj is not None:
        plot_footprint(ax, obj, pursuit.end_pose[:2], pursuit.end_pose[2], TRUTH)
    ax.set_title(
        f"{pursuit.status}: {1000 * pursuit.distance_m:.1f} mm, {len(pursuit.steps)} actions"
    )
    return ax


def _labels(ax: Axes) -> list[str]:
    return ax.get_legend_handles_labels()[1]


def plot_depth(
    ax: Axes,
    image: np.ndarray,
    title: str = "",
    width_m: float = CROP_WIDTH_M,
    top_cm: float | None = None,
) -> Axes:
    """The depth channel of an image (2, n, n), as height above the table in centimetres.

    top_cm: where the colours end (default: at the highest point, or 8 cm).
    """
    half = 50 * check_within("width_m", width_m, 0.01, 10.0, "m")
    image = check_array("image", image)
    if image.ndim != 3:
        raise ValueError(f"image must be (2, n, n), got an array {image.shape}")
    height_cm = 100 * (CAMERA_HEIGHT_M - image[0])
    top = top_cm or max(8.0, float(height_cm.max()))
    drawn = ax.imshow(
        height_cm, extent=(-half, half, -half, half), cmap="cividis", vmin=0, vmax=top
    )
    ax.grid(False)
    ax.set_title(title)
    ax.set_xlabel("x [cm]")
    ax.set_ylabel("y [cm]")
    ax.figure.colorbar(drawn, ax=ax, label="height [cm]", shrink=0.8)
    return ax


def table_picture(
    obj: TabletopObject,
    pose: Sequence[float],
    plan: Plan | None,
    outcome: Outcome | None,
    half_width_m: float,
) -> bytes:
    """The table from above as a PNG: the object at (x, y, yaw), and the outcome, else the plan.

    What there is to be seen fills it; half_width_m bounds what it shows.
    """
    # A figure of its own, outside pyplot: no window, nothing to close.
    figure = Figure(figsize=(5, 5), layout="constrained")
    FigureCanvasAgg(figure)
    shown = [pose[:2]]
    if (made := outcome.plan if outcome else plan) is not None:
        ends = [step.predicted_end_xy_m for step in made.steps]
        shown += [made.start_xy_m, made.goal.xy_m, *ends]
    low, high = np.min(shown, axis=0), np.max(shown, axis=0)
    half = min(half_width_m, max(high - low) / 2 + 0.11)
    ax = plot_table(figure.add_subplot(), (low + high) / 2, half)
    if outcome is not None:
        plot_outcome(ax, outcome)
    elif plan is not None:
        plot_plan(ax, plan, obj=obj, yaw_rad=pose[2])
    plot_footprint(ax, obj, pose[:2], pose[2], label="object")
    ax.legend(loc="upper left")
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=90)
    return buffer.getvalue()


_ALONG, _UP = 0.45, 0.3


def outline_in_lever_frame(
    obj: TabletopObject, yaw_rad: float, contact_xy_m: np.ndarray, theta_rad: float
) -> np.ndarray:
    """The base (n, 2) [m] of an object at its start, from the contact point, lever to the right."""
    yaw, theta = check_finite("yaw_rad", yaw_rad), check_finite("theta_rad", theta_rad)
    c, s = math.cos(yaw), math.sin(yaw)
    outline = obj.footprint_m @ np.array([[c, s], [-s, c]]) - check_pair(
        "contact_xy_m", contact_xy_m
    )
    c, s = math.cos(theta), math.sin(theta)
    return outline @ np.array([[c, -s], [s, c]])


def plot_levered(
    ax: Axes,
    outline_m: np.ndarray,
    height_m: float,
    pose: np.ndarray | Tensor,
    color: str,
    label: str | None = None,
) -> Axes:
    """A prism after a change of pose (x, y, z [m], tilt [rad]) from its start.

    outline_m: (n, 2), as of `outline_in_lever_frame`. It is tilted about an axis across the lever,
    which for the real one is only roughly so. Across is drawn obliquely; units are centimetres.
    """
    pose, height_m = check_array("pose", pose, 4), check_finite("height_m", height_m)
    outline_m = check_array("outline_m", outline_m, 2)
    centre, tilt = outline_m.mean(axis=0), pose[3]
    c, s = math.cos(tilt), math.sin(tilt)
    faces = []
    for z in (-height_m / 2, height_m / 2):
        x, y = (outline_m - centre).T
        x, z = c * x + s * z, c * z - s * x
        x, y, z = x + centre[0] + pose[0], y + centre[1] + pose[1], z + height_m / 2 + pose[2]
        faces.append(100 * np.column_stack([x + _ALONG * y, z + _UP * y]))
    for face in faces:
        ax.fill(*face.T, facecolor=color, alpha=0.15, lw=0)
        ax.plot(*np.vstack([face, face[:1]]).T, color=color, lw=1.2, label=label)
        label = None
    for low, high in zip(*faces, strict=True):
        ax.plot(*np.array([low, high]).T, color=color, lw=0.8)
    ax.set_aspect("equal")
    ax.set(xlabel="along the lever [cm]", ylabel="height [cm]")
    return ax
