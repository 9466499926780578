"""Make the README's picture: `python -m experiments.front_picture`.

An animation of one push, twice: the full push overshoots the goal; the partial push, stopped at the
planned phase, ends there.
"""

import itertools
from dataclasses import replace
from io import BytesIO

import numpy as np
from matplotlib import font_manager
from PIL import Image, ImageDraw, ImageFont

from affordlib.planning import Skills, execute_plan, plan_continuous
from affordlib.results import repo_root, write_atomically
from affordlib.types import Goal
from affordlib.world import Cuboid, Tabletop

BOX = Cuboid(0.05, 0.045, 0.05)
GOAL = Goal((0.0, 0.028))
FRAME_STEPS, COMES, LEAVES, FRAME_MS = 16, 12, 24, 40
"""Simulation steps between two frames; frames in which the arm comes, and leaves, that are not
shown; time for which a frame is shown [ms]."""
WIDTH, HEIGHT = 600, 470
"""Size of one of the two pictures, below its title [pixels]; pages show it smaller."""
VIEW = {"at_m": (-0.22, 0.0, 0.3), "distance_m": 1.4, "yaw_deg": 118.0, "pitch_deg": -23.0}
GOAL_RGB = (0.0, 0.45, 0.70)
FIGURES = repo_root() / "figures"


def recorded(title: str, stop: bool) -> list[np.ndarray]:
    """Return frames (h, w, 3) of one planned push, stopped as planned or executed in full."""
    frames, steps = [], itertools.count()

    def take(world):
        if next(steps) % FRAME_STEPS == 0:
            frames.append(world.picture(WIDTH, HEIGHT, **VIEW))

    with Tabletop() as world:
        world.place(BOX, (0.0, 0.0), 0.3)
        query = world.depth_image(), world.object_pose()[:2], GOAL, "single_partial"
        plan = plan_continuous(Skills.load().problem(*query))
        turned = 0.3 + plan.steps[0].predicted_turn_rad
        if not stop:
            plan = replace(plan, steps=(replace(plan.steps[0], stop_phase=1.0),))
        world.mark(GOAL.xy_m, GOAL_RGB, turned, scale=1.3)
        world.on_step = take
        outcome = execute_plan(world, plan)
    frames = frames[COMES:-LEAVES]
    titles = [title.format(plan.steps[0].stop_phase)] * len(frames)
    titles[-25:] = [f"{titles[0]}: {1000 * outcome.distance_m:.1f} mm from the goal"] * 25
    return [_titled(*pair) for pair in zip(frames, titles, strict=True)]


def animated(frames: list[np.ndarray]) -> bytes:
    """Return frames as a GIF that starts with the last one, shown longer."""
    frames = [frames[-1], *frames[:-1]]
    # One palette for all frames, made from a few of them, prevents flickering colours.
    few = np.vstack(frames[:: len(frames) // 3])
    octree, flat = Image.Quantize.FASTOCTREE, Image.Dither.NONE
    palette = Image.fromarray(few).quantize(255, method=octree, dither=flat)
    first, *others = (Image.fromarray(f).quantize(palette=palette, dither=flat) for f in frames)
    buffer = BytesIO()
    durations = [2000] + [FRAME_MS] * len(others)
    first.save(buffer, "GIF", save_all=True, append_images=others, duration=durations, loop=0)
    return buffer.getvalue()


def _titled(picture: np.ndarray, title: str) -> np.ndarray:
    """Return a picture under a line of text."""
    image = Image.new("RGB", (WIDTH, HEIGHT + 60), "white")
    image.paste(Image.fromarray(picture), (0, 60))
    font = ImageFont.truetype(font_manager.findfont("DejaVu Sans"), 22)
    ImageDraw.Draw(image).text((WIDTH / 2, 16), title, "black", font, anchor="ma")
    return np.asarray(image)


def main() -> None:
    """Record the full and the partial push, and write them side by side."""
    both = recorded("The full push", stop=False), recorded("Stopped at {:.0f} % of it", stop=True)
    longest = max(map(len, both))
    sides = [side + side[-1:] * (longest - len(side)) for side in both]
    frames = [np.hstack(pair) for pair in zip(*sides, strict=True)]
    write_atomically(FIGURES / "partial_push.gif", animated(frames), b"GIF8")


if __name__ == "__main__":
    main()
