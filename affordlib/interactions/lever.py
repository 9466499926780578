"""Lever-ups as trajectories of poses in the frame of the lever, ours and the older study's.

Section 4.1 and Table 1. The origin is the contact point, x the direction of the lever, as in the
image, which was moved and turned so when it was taken. A step is 150 ms, every twelfth sample: 26
poses, the first of them zero, since a pose is the object's change since the start.

A pose holds x, y, z [m] and the tilt [rad] of the object's upright axis. The stored yaw is left
out: it is the heading of an axis of the object's own that no image shows, and of a body that is
tilted by 65° it says little. So these are four of the six numbers of a rigid body's pose; the error
is of the position. Of the commanded action x and z change (the blade slides in, then lifts along
its arc), relative to the contact.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
import xarray as xr
from PIL import Image

from affordlib.interactions.batches import (
    Batch,
    Symmetry,
    TrainingArrays,
    believable,
    observe,
    turn,
)
from affordlib.types import LEVER_IMAGE_PIXELS, Observations

ACTION_CHANNELS = ("x", "z")
POSE_CHANNELS = ("x", "y", "z", "tilt")
EVERY = 12
"""Every twelfth of the 301 samples: 150 ms, the paper's step."""

SEEN, AHEAD = 15, 5
"""Steps of a window that are observed, and those to foresee (Table 1)."""

MIRRORED: tuple[Symmetry, ...] = ((0, False), (0, True))
"""A lever-up, and the same seen in a mirror along the lever: see `symmetric_copies`."""

_NEAR = slice(16, 112), slice(32, 128)


def lever_arrays(
    data: xr.Dataset, interactions: np.ndarray | None = None, view: str = "near"
) -> TrainingArrays:
    """Lever-ups as 26 steps of poses and commanded actions, in the frame of the lever.

    view: "near", the 42 cm of the image that objects reach into, 48×48 (pixels meaned in fours);
    "wide", all of its 56 cm, 48×48; "full", as taken, 128×128. Faults are left out.
    """
    channels = ("x", "y", "z"), POSE_CHANNELS
    arrays = TrainingArrays.from_dataset(data, interactions, *channels)
    chosen = np.arange(data.sizes["interaction"]) if interactions is None else interactions
    chosen = believable(data, chosen)
    theta = torch.from_numpy(data["theta"].values[chosen])
    back = torch.stack([theta.cos(), -theta.sin()], dim=-1).float()[:, None]
    contact = np.stack([data[f"contact_{k}"].values[chosen] for k in "xy"] + [0 * theta], axis=-1)
    action = arrays.action[:, ::EVERY] - torch.from_numpy(contact).float()[:, None]
    action = turn(action, channels[0], back, absolute_yaw=True)
    return TrainingArrays(
        viewed(arrays.image, view),
        arrays.phase[::EVERY],
        action[..., [0, 2]],
        turn(arrays.effect[:, ::EVERY], POSE_CHANNELS, back, absolute_yaw=False),
        ACTION_CHANNELS,
        POSE_CHANNELS,
        arrays.stop_phase,
    )


def viewed(image: torch.Tensor, view: str) -> torch.Tensor:
    """Images (N, C, 128, 128) as `lever_arrays` shows them to a model."""
    views = ("near", "wide", "full")
    if view not in views:
        raise ValueError(f"view must be one of {views}, got {view!r}")
    if view == "full":
        return image
    if view == "near":
        return F.avg_pool2d(image[..., _NEAR[0], _NEAR[1]], 2)
    return F.interpolate(image, (48, 48), mode="bilinear", antialias=True, align_corners=False)


def poses_seen(arrays: TrainingArrays, start: torch.Tensor, n_seen: int) -> Observations:
    """The commanded action at t = 0 and 1, and n_seen poses from the steps `start` (N,) on.

    With n_seen = 0 only the action is observed (w₁ = 1), else both (w₁ = 1/2).
    """
    n, last = len(arrays), len(arrays.phase) - 1
    both = torch.tensor([0, last]).expand(n, -1)
    yes = torch.ones(n, 2, dtype=torch.bool)
    at = start[:, None] + torch.arange(max(1, n_seen))
    seen = torch.full(at.shape, n_seen > 0)
    return observe(arrays, both, yes, at, seen, torch.full((n,), 0.5 if n_seen else 1.0))


def n_windows(arrays: TrainingArrays) -> int:
    """How many windows of 15 + 5 steps a trajectory has."""
    return len(arrays.phase) - SEEN - AHEAD + 1


def draw_windows(
    arrays: TrainingArrays,
    rows: torch.Tensor,
    n_targets: int,
    obs_max: int,
    generator: torch.Generator,
) -> Batch:
    """Windows anywhere: obs_max steps observed, the n_targets after them foreseen."""
    part = arrays.select(rows)
    latest = len(arrays.phase) - obs_max - n_targets
    start = torch.randint(0, latest + 1, (len(rows),), generator=generator)
    target = start[:, None] + obs_max + torch.arange(n_targets)
    return _asked(part, poses_seen(part, start, obs_max), target)


def draw_beginnings(
    arrays: TrainingArrays,
    rows: torch.Tensor,
    n_targets: int,
    obs_max: int,
    generator: torch.Generator,
) -> Batch:
    """All later steps, from the first pose and the image; of every other batch without the pose.

    n_targets and obs_max are not used.
    """
    part = arrays.select(rows)
    told = int(torch.randint(0, 2, (1,), generator=generator))
    target = torch.arange(1, len(arrays.phase)).expand(len(rows), -1)
    start = torch.zeros(len(rows), dtype=torch.long)
    return _asked(part, poses_seen(part, start, told), target)


def _asked(part: TrainingArrays, seen: Observations, target: torch.Tensor) -> Batch:
    index = torch.arange(len(part))[:, None]
    return Batch(
        part.image,
        seen,
        part.phases(target),
        part.action[index, target],
        part.effect[index, target],
    )


IMAGE_ENDINGS = (".png", ".jpg", ".pgm")


def read_trajectories(
    folder: str | Path, steps: int | None = None, view: str = "full"
) -> TrainingArrays:
    """A folder of the older study's layout (Seker, Tekden and Ugur, 2019) as arrays.

    folder/trajectories/NAME.txt: one row a step, six numbers x y z [m] roll pitch yaw [rad] of the
    object, in the frame of the lever, separated by blanks or commas; folder/images/NAME.png (or
    .jpg, .pgm): the grayscale image 128×128, moved and turned by contact point and direction, the
    object darker or brighter than the table, whose gray is that of the border. All trajectories
    need `steps` rows (default: those of the first). view: of the image, see `lever_arrays`.

    Poses become changes since the first row, tilt is the angle of the upright axis. There is no
    commanded action in that layout, so both of its channels are zero. The image's first channel is
    the gray value in [0, 1], the second the mask.
    """
    folder = Path(folder)
    files = sorted((folder / "trajectories").glob("*.txt"))
    if not files:
        raise FileNotFoundError(
            f"folder: {folder} has no file trajectories/*.txt; expected are trajectories/NAME.txt "
            "with six numbers a row and images/NAME.png beside it"
        )
    poses, images = [], []
    for file in files:
        rows = _read_poses(file)
        steps = steps or len(rows)
        if len(rows) != steps:
            raise ValueError(f"{file} has {len(rows)} rows, expected {steps} as in {files[0].name}")
        poses.append(_changes(rows))
        images.append(_read_image(folder / "images", file.stem))
    effect = torch.from_numpy(np.stack(poses)).float()
    return TrainingArrays(
        viewed(torch.from_numpy(np.stack(images)), view),
        torch.linspace(0, 1, effect.shape[1]),
        torch.zeros(*effect.shape[:2], len(ACTION_CHANNELS)),
        effect,
        ACTION_CHANNELS,
        POSE_CHANNELS,
    )


def _read_poses(file: Path) -> np.ndarray:
    """Rows (n, 6) of a file of poses."""
    try:
        rows = [
            [float(v) for v in line.replace(",", " ").split()]
            for line in file.read_text().splitlines()
            if line.strip()
        ]
        poses = np.array(rows, dtype=float)
    except ValueError as error:
        raise ValueError(f"{file}: every row must hold six numbers ({error})") from None
    if poses.ndim != 2 or poses.shape[1] != 6 or not np.isfinite(poses).all():
        raise ValueError(f"{file}: every row must hold six finite numbers, got {poses.shape}")
    return poses


def _changes(poses: np.ndarray) -> np.ndarray:
    """Change of position and tilt (n, 4) of poses (n, 6) since the first."""
    roll, pitch = poses[:, 3], poses[:, 4]
    tilt = np.arccos(np.clip(np.cos(roll) * np.cos(pitch), -1, 1))
    return np.column_stack([poses[:, :3] - poses[0, :3], tilt - tilt[0]])


def _read_image(folder: Path, name: str) -> np.ndarray:
    """Gray values and mask (2, 128, 128) of an image."""
    found = [folder / f"{name}{ending}" for ending in IMAGE_ENDINGS]
    file = next((path for path in found if path.is_file()), None)
    if file is None:
        raise FileNotFoundError(f"{folder} has no image {name}.png (or .jpg, .pgm) of {name}.txt")
    n = LEVER_IMAGE_PIXELS
    with Image.open(file) as picture:
        if picture.size != (n, n):
            raise ValueError(f"{file} must be {n}×{n} pixels, got {picture.size}")
        gray = np.asarray(picture.convert("L"), dtype=np.float32) / 255
    table = np.median(np.concatenate([gray[0], gray[-1], gray[:, 0], gray[:, -1]]))
    return np.stack([gray, (np.abs(gray - table) > 0.1).astype(np.float32)])


def write_trajectories(
    folder: str | Path, poses: np.ndarray, images: np.ndarray, first: int = 0
) -> None:
    """Write poses (N, S, 6) and gray images (N, 128, 128) in [0, 1] as `read_trajectories` reads.

    first: the number that the first file is named by.
    """
    folder = Path(folder)
    for kind in ("trajectories", "images"):
        (folder / kind).mkdir(parents=True, exist_ok=True)
    for number, (rows, gray) in enumerate(zip(poses, images, strict=True), first):
        np.savetxt(folder / "trajectories" / f"{number:04}.txt", rows, fmt="%.6f")
        picture = Image.fromarray((255 * np.clip(gray, 0, 1)).round().astype(np.uint8))
        picture.save(folder / "images" / f"{number:04}.png")
