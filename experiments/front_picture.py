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
FRAME_STEPS, LEAVES = 48, 6
"""Simulation steps between two frames; frames at the end in which the arm leaves the picture."""
WIDTH, HEIGHT = 840, 660
"""Size of one of the two pictures, below its title [pixels]; pages show it at half of that."""
VIEW = {"at_m": (-0.05, 0.0, 0.08), "distance_m": 1.15, "field_deg": 25.0}
GOAL_RGB = (0.0, 0.45, 0.70)
PICTURE = repo_root() / "figures" / "partial_push.gif"


def recorded(title: str, stop: bool) -> list[np.ndarray]:
    """Return frames (h, w, 3) of one planned push, stopped as planned or executed in full."""
    animation = FrameRecorder(FRAME_STEPS, WIDTH, HEIGHT, **VIEW)
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
    del animation.frames[-LEAVES:]
    titles = [title.format(plan.steps[0].stop_phase)] * len(animation.frames)
    titles[-8:] = [f"{titles[0]}: {1000 * outcome.distance_m:.1f} mm from the goal"] * 8
    return [_titled(*pair) for pair in zip(animation.frames, titles, strict=True)]


def _titled(picture: np.ndarray, title: str) -> np.ndarray:
    """Return a picture under a line of text."""
    image = Image.new("RGB", (WIDTH, HEIGHT + 60), "white")
    image.paste(Image.fromarray(picture), (0, 60))
    font = ImageFont.truetype(font_manager.findfont("DejaVu Sans"), 28)
    ImageDraw.Draw(image).text((WIDTH / 2, 16), title, "black", font, anchor="ma")
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
