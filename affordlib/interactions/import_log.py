"""Interactions of one's own: a folder with a table and images, as any robot's log can be written.

trajectories.csv     one row per interaction and moment: interaction, t, action_x, action_y, …,
                     effect_x, effect_y, …; t from 0 to 1, lengths in m, angles in rad, relative
                     to the object as it stood at t = 0
images/NAME.png      NAME is the entry in the column interaction: depth seen from above before
                     the action, 48×48 pixels, 16 cm wide, rows along -y, 16 bits of 0.1 mm from
                     a plane 1 m above the table (so the table is 10000)
images/NAME_mask.png the object, 8 bits, white where it fills the pixel; where there is none,
                     all that is higher than 2 mm is taken for the object

Likewise the lever-ups of Seker, Tekden and Ugur (2019): see `read_trajectories`.
"""

import io
from pathlib import Path

import numpy as np
import pandas as pd
import torch
from PIL import Image

from affordlib.interactions.dataset import InteractionTensors
from affordlib.interactions.lever_up import LEVER_ACTION_CHANNELS, POSE_CHANNELS, select_view
from affordlib.types import (
    ACTION_CHANNELS,
    EFFECT_CHANNELS,
    IMAGE_PIXELS,
    LEVER_IMAGE_PIXELS,
    check_count,
)

TABLE, IMAGES, POSES = "trajectories.csv", "images", "trajectories"
DEPTH_UNIT_M = 1e-4
TABLE_DEPTH_M = 1.0
_HIGHER_M = 0.002


def read_log(folder: str | Path, n_samples: int = 101) -> InteractionTensors:
    """The interactions of a folder, in the order of its table, at n_samples phases each.

    Between the rows of the table trajectories are interpolated. Raises FileNotFoundError or
    ValueError that says which file, which row and what is expected.
    """
    check_count("n_samples", n_samples, least=2)
    folder, phase = Path(folder), np.linspace(0, 1, n_samples)
    path = folder / TABLE
    if not path.is_file():
        raise FileNotFoundError(
            f"folder: there is no {path}; expected are {TABLE} with the columns interaction, t, "
            f"action_x, …, effect_x, …, and {IMAGES}/NAME.png for each interaction"
        )
    # Only an empty entry is missing: "NA" is a name as good as others.
    table = pd.read_csv(path, dtype={"interaction": str}, keep_default_na=False, na_values=[""])
    actions, effects = _columns(path, table)
    yaws = [name.endswith("yaw") for name in actions + effects]
    trajectories, images = [], []
    for name, rows in table.groupby("interaction", sort=False):
        t, values = rows["t"].to_numpy(float), rows[actions + effects].to_numpy(float)
        if not (np.isfinite(values).all() and np.isfinite(t).all()):
            raise ValueError(f"{path}: interaction {name!r} has an entry that is not a number")
        if len(t) < 2 or t[0] != 0 or t[-1] != 1 or (np.diff(t) <= 0).any():
            raise ValueError(f"{path}: t of interaction {name!r} must grow from 0 to 1")
        values[:, yaws] = np.unwrap(values[:, yaws], axis=0)
        trajectories.append(np.column_stack([np.interp(phase, t, column) for column in values.T]))
        images.append(_read_depth(folder / IMAGES / f"{name}.png"))
    if not trajectories:
        raise ValueError(f"{path}: there are no rows")
    both = torch.from_numpy(np.stack(trajectories)).float()
    return InteractionTensors(
        torch.from_numpy(np.stack(images)),
        torch.from_numpy(phase).float(),
        *both.split([len(actions), len(effects)], dim=-1),
        *(tuple(name.split("_", 1)[1] for name in names) for names in (actions, effects)),
    )


def write_log(folder: str | Path, tensors: InteractionTensors) -> Path:
    """Write interactions as `read_log` reads them; returns the folder."""
    folder = Path(folder)
    (folder / IMAGES).mkdir(parents=True, exist_ok=True)
    columns = [f"action_{c}" for c in tensors.action_channels]
    columns += [f"effect_{c}" for c in tensors.effect_channels]
    values = torch.cat([tensors.action, tensors.effect], dim=-1).numpy()
    names = [f"{k:04d}" for k in range(len(tensors))]
    table = pd.DataFrame(values.reshape(-1, values.shape[-1]), columns=columns)
    table.insert(0, "t", tensors.phases(torch.arange(len(tensors.phase))).numpy().ravel())
    table.insert(0, "interaction", np.repeat(names, len(tensors.phase)))
    for name, (depth, mask) in zip(names, tensors.image.numpy(), strict=True):
        units = np.round(depth / DEPTH_UNIT_M).astype(np.uint16)
        Image.fromarray(units).save(folder / IMAGES / f"{name}.png")
        inside = np.round(255 * mask).astype(np.uint8)
        Image.fromarray(inside).save(folder / IMAGES / f"{name}_mask.png")
    table.to_csv(folder / TABLE, index=False)
    return folder


def _columns(path: Path, table: pd.DataFrame) -> list[list[str]]:
    """The table's columns of actions and of effects; raises ValueError for what is wrong."""
    for name in ("interaction", "t"):
        if name not in table:
            raise ValueError(f"{path}: the column {name!r} is missing")
    found = []
    for kind, channels in (("action", ACTION_CHANNELS), ("effect", EFFECT_CHANNELS)):
        known = [f"{kind}_{channel}" for channel in channels]
        found.append([name for name in table if name.startswith(f"{kind}_")])
        if not found[-1] or not {*found[-1]} <= {*known}:
            raise ValueError(
                f"{path}: the columns of the {kind} are {found[-1]}; choose from {known}"
            )
    for name in ("t", *found[0], *found[1]):
        if not pd.api.types.is_numeric_dtype(table[name]):
            raise ValueError(f"{path}: the column {name!r} must hold numbers only")
    if (empty := table["interaction"].isna()).any():
        row = 2 + int(empty.argmax())
        raise ValueError(f"{path}: line {row} has no entry in the column 'interaction'")
    return found


def _pixels(path: Path, n: int, mode: str | None = None) -> np.ndarray:
    """The values (n, n) of an image, converted to a mode of Pillow if one is given."""
    if not path.is_file():
        raise FileNotFoundError(f"there is no image {path} of the interaction of that name")
    with Image.open(path) as file:
        values = np.asarray(file.convert(mode) if mode else file)
    if values.shape != (n, n):
        raise ValueError(f"{path} must be a gray image of {n}×{n} pixels, got {values.shape}")
    return values


def _read_depth(path: Path) -> np.ndarray:
    """Depth [m] and mask (2, 48, 48)."""
    units, mask_path = _pixels(path, IMAGE_PIXELS), path.with_name(f"{path.stem}_mask.png")
    if not np.issubdtype(units.dtype, np.integer) or units.max() <= 255:
        got = f"{units.dtype}, at most {units.max()}"
        raise ValueError(f"{path} must hold depth in 16 bits of 0.1 mm, got {got}")
    depth = units * DEPTH_UNIT_M
    if not mask_path.is_file():
        return np.stack([depth, TABLE_DEPTH_M - depth > _HIGHER_M]).astype(np.float32)
    mask = _pixels(mask_path, IMAGE_PIXELS)
    if mask.dtype != np.uint8 or 0 < mask.max() < 128:
        got = f"{mask.dtype}, at most {mask.max()}"
        raise ValueError(
            f"{mask_path} must have 8 bits, white (255) where the object is, got {got}"
        )
    return np.stack([depth, mask / 255.0]).astype(np.float32)


def read_trajectories(folder: str | Path, view: str = "full") -> InteractionTensors:
    """Lever-ups in the layout of Seker, Tekden and Ugur (2019).

    folder/trajectories/NAME.txt: one row a step, as many in every file, of six numbers x y z [m]
    roll pitch yaw [rad] of the object in the frame of the lever, separated by blanks or commas;
    folder/images/NAME.png (or .jpg, .pgm): gray, 128×128, moved and turned by contact point and
    direction, the object darker or brighter than the table, whose gray is that of the border.
    view: of the image, see `lever_up_tensors`.

    Poses become changes since the first row, tilt is the angle of the upright axis. That layout
    has no commanded action, so both of its channels are zero. The image's first channel is the
    gray value in [0, 1], the second the mask.
    """
    folder = Path(folder)
    files = sorted((folder / POSES).glob("*.txt"))
    if not files:
        raise FileNotFoundError(
            f"folder: {folder} has no file {POSES}/*.txt; expected are {POSES}/NAME.txt "
            f"with six numbers a row and {IMAGES}/NAME.png beside it"
        )
    poses = [_read_poses(file) for file in files]
    for file, rows in zip(files, poses, strict=True):
        if len(rows) != len(poses[0]):
            expected = f"expected {len(poses[0])} as in {files[0].name}"
            raise ValueError(f"{file} has {len(rows)} rows, {expected}")
    xyz, roll, pitch, _ = np.split(np.stack(poses), (3, 4, 5), axis=-1)
    tilt = np.arccos(np.clip(np.cos(roll) * np.cos(pitch), -1, 1))
    since_start = np.concatenate([xyz - xyz[:, :1], tilt - tilt[:, :1]], axis=-1)
    images = np.stack([_read_gray(folder / IMAGES, file.stem) for file in files])
    effect = torch.from_numpy(since_start).float()
    return InteractionTensors(
        select_view(torch.from_numpy(images), view),
        torch.linspace(0, 1, effect.shape[1]),
        torch.zeros(*effect.shape[:2], len(LEVER_ACTION_CHANNELS)),
        effect,
        LEVER_ACTION_CHANNELS,
        POSE_CHANNELS,
    )


def _read_poses(file: Path) -> np.ndarray:
    """Rows (n, 6) of a file of poses."""
    try:
        poses = np.loadtxt(io.StringIO(file.read_text().replace(",", " ")), ndmin=2)
    except ValueError as error:
        raise ValueError(f"{file}: every row must hold six numbers ({error})") from None
    if poses.shape[1] != 6 or not np.isfinite(poses).all():
        raise ValueError(f"{file}: every row must hold six finite numbers, got {poses.shape}")
    return poses


def _read_gray(folder: Path, name: str) -> np.ndarray:
    """Gray values in [0, 1] and mask (2, 128, 128) of an image."""
    files = [folder / f"{name}{ending}" for ending in (".png", ".jpg", ".pgm")]
    file = next((file for file in files if file.is_file()), files[0])
    gray = _pixels(file, LEVER_IMAGE_PIXELS, "L").astype(np.float32) / 255
    table = np.median(np.concatenate([gray[0], gray[-1], gray[:, 0], gray[:, -1]]))
    return np.stack([gray, (np.abs(gray - table) > 0.1).astype(np.float32)])


def write_trajectories(folder: str | Path, poses: np.ndarray, images: np.ndarray) -> None:
    """Write poses (N, S, 6) and gray images (N, 128, 128) in [0, 1] for `read_trajectories`."""
    folder = Path(folder)
    for kind in (POSES, IMAGES):
        (folder / kind).mkdir(parents=True, exist_ok=True)
    for number, (rows, gray) in enumerate(zip(poses, images, strict=True)):
        np.savetxt(folder / POSES / f"{number:04}.txt", rows, fmt="%.6f")
        picture = Image.fromarray((255 * np.clip(gray, 0, 1)).round().astype(np.uint8))
        picture.save(folder / IMAGES / f"{number:04}.png")
