"""Small animations of the robot at work: recorded frames, encoded as a GIF or PNG by Pillow."""

import io
from pathlib import Path

import numpy as np
from IPython.display import Image as NotebookImage
from matplotlib.figure import Figure
from PIL import Image

from affordlib.results import write_atomically
from affordlib.types import check_count
from affordlib.world import Tabletop


class FrameRecorder:
    """Takes a picture every `every` simulation steps (1/240 s); give it to `world.on_step`.

    Figures can be added as frames as well, with `add`.
    """

    def __init__(self, every: int = 30, width: int = 320, height: int = 240) -> None:
        self.every = check_count("every", every, 1, 100_000)
        self.width = check_count("width", width, 16, 2048)
        self.height = check_count("height", height, 16, 2048)
        self.frames: list[np.ndarray] = []
        self._steps = 0

    def __call__(self, world: Tabletop) -> None:
        if self._steps % self.every == 0:
            self.frames.append(world.picture(self.width, self.height))
        self._steps += 1

    def add(self, figure: Figure) -> None:
        """Add a picture of a figure, in the recorder's height; all frames must be as wide."""
        frame = _drawn(figure, self.height)
        if self.frames and frame.shape != self.frames[0].shape:
            sizes = [f"{f.shape[1]}×{f.shape[0]}" for f in (frame, self.frames[0])]
            raise ValueError(
                f"figure makes a frame of {sizes[0]} pixels, the others have {sizes[1]}; "
                "give it their shape, or show it with beside="
            )
        self.frames.append(frame)

    def encoded(self, kind: str = "GIF", frame_ms: int = 60, beside: Figure | None = None) -> bytes:
        """The frames as an animated picture that loops and rests on its last frame.

        kind: "GIF" or "PNG"; beside: a figure shown to the left of every frame.
        """
        if not self.frames:
            raise RuntimeError(
                "there are no frames; set world.on_step to the recorder before the robot moves"
            )
        frames = self.frames
        if beside is not None:
            left = _drawn(beside, frames[0].shape[0])
            frames = [np.hstack([left, frame]) for frame in frames]
        # One palette for all frames, drawn from a few of them, or colours flicker.
        few = [frames[round(k * (len(frames) - 1) / 3)] for k in range(4)]
        palette = Image.fromarray(np.vstack(few)).quantize(
            255, method=Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE
        )
        indexed = [
            Image.fromarray(frame).quantize(palette=palette, dither=Image.Dither.NONE)
            for frame in frames
        ]
        buffer = io.BytesIO()
        durations = [frame_ms] * (len(indexed) - 1) + [1500]
        indexed[0].save(
            buffer, kind, save_all=True, append_images=indexed[1:], duration=durations, loop=0
        )
        return buffer.getvalue()


def _drawn(figure: Figure, height: int) -> np.ndarray:
    """A figure as pixels (height, width, 3)."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=2 * height / figure.get_figheight())
    picture = Image.open(buffer).convert("RGB")
    size = (picture.width // 2, picture.height // 2)
    return np.asarray(picture.resize(size, Image.Resampling.LANCZOS))


def show_animation(
    recorder: FrameRecorder, path: str | Path | None = None, beside: Figure | None = None
) -> NotebookImage:
    """The frames as an animation that a notebook displays; saved to `path` as a GIF too, if given.

    beside: a figure shown to the left of every frame.
    """
    if path is not None:
        write_atomically(Path(path), recorder.encoded("GIF", beside=beside), b"GIF8")
    # A PNG: pages made from a notebook leave GIFs out, and it is a third smaller.
    return NotebookImage(recorder.encoded("PNG", beside=beside), format="png")
