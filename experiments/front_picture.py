"""Make the README's animation of one push, twice: `python -m experiments.front_picture`.

The full push overshoots the goal; the partial push, stopped at the planned phase, ends there.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from matplotlib import font_manager
from PIL import Image, ImageDraw, ImageFont

from affordlib.paths import repo_root
from affordlib.planning import Skills, execute_plan, plan_continuous
from affordlib.results import write_atomically
from affordlib.show import FrameRecorder
from affordlib.types import Goal
from affordlib.world import Cuboid, Tabletop

BOX = Cuboid(0.05, 0.045, 0.05)
GOAL = Goal((0.0, 0.028))
FRAME_STEPS = 48
LARGE, LEFT, TOP, WIDTH, HEIGHT = (960, 720), 275, 185, 420, 330
"""Size of the rendered pictures and the part of them that is shown [pixels]."""
GOAL_RGB = (0.0, 0.45, 0.70)
PICTURE = repo_root() / "figures" / "partial_push.gif"


def recorded(title: str, stop: bool) -> list[np.ndarray]:
    """Return frames (h, w, 3) of one planned push, stopped as planned or executed in full."""
    animation = FrameRecorder(FRAME_STEPS, *LARGE)
    with Tabletop() as world:
        world.place(BOX, (0.0, 0.0), 0.3)
        planner = Skills.load().planner(plan_continuous, mode="single_partial")
        plan = planner(world.depth_image(), world.object_pose()[:2], GOAL)
        turned = 0.3 + plan.steps[0].predicted_turn_rad
        if not stop:
            plan = replace(plan, steps=(replace(plan.steps[0], stop_phase=1.0),))
        world.mark(GOAL.xy_m, GOAL_RGB, turned, scale=1.3)
        world.on_step = animation
        outcome = execute_plan(world, plan)
    titles = [title.format(plan.steps[0].stop_phase)] * len(animation.frames)
    titles[-8:] = [f"{titles[0]}: {1000 * outcome.distance_m:.1f} mm from the goal"] * 8
    return [_titled(*pair) for pair in zip(animation.frames, titles, strict=True)]


def _titled(picture: np.ndarray, title: str) -> np.ndarray:
    """Return the shown part of a picture under a line of text."""
    image = Image.new("RGB", (WIDTH, HEIGHT + 30), "white")
    image.paste(Image.fromarray(picture[TOP : TOP + HEIGHT, LEFT : LEFT + WIDTH]), (0, 30))
    font = ImageFont.truetype(font_manager.findfont("DejaVu Sans"), 14)
    ImageDraw.Draw(image).text((WIDTH / 2, 8), title, "black", font, anchor="ma")
    return np.asarray(image)


def main() -> None:
    """Record the full and the partial push, and write them side by side."""
    both = recorded("The full push", stop=False), recorded("Stopped at {:.0%} of it", stop=True)
    animation = FrameRecorder()
    for k in range(max(map(len, both))):
        animation.frames.append(np.hstack([side[min(k, len(side) - 1)] for side in both]))
    write_atomically(PICTURE, animation.encoded("GIF", frame_ms=80))


if __name__ == "__main__":
    main()
