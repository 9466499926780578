"""Import and export of interactions as a folder with a table and images, for any robot's log.

trajectories.csv     one row per interaction and time: interaction, t, action_x, action_y, …,
                     effect_x, effect_y, …; t from 0 to 1, lengths in m, angles in rad, relative
                     to the object's pose at t = 0
images/NAME.png      NAME is the value in the column interaction: depth image from above, taken
                     before the action, 48×48 pixels, 16 cm wide, rows along -y, 16 bits in units
                     of 0.1 mm from a plane 1 m above the table (so the table is 10000)
images/NAME_mask.png mask of the object (optional), 8 bits, white where the object fills the pixel;
                     without it, all points higher than 2 mm belong to the object
"""

from pathlib import Path

import numpy as np
import pandas as pd
import torch
from PIL import Image

from affordlib.interactions.dataset import InteractionTensors
from affordlib.types import ACTION_CHANNELS, EFFECT_CHANNELS, IMAGE_PIXELS, check_count

TABLE, IMAGES = "trajectories.csv", "images"
DEPTH_UNIT_M = 1e-4
TABLE_DEPTH_M = 1.0
_HIGHER_M = 0.002


def read_folder(folder: str | Path, n_samples: int = 101) -> InteractionTensors:
    """Read the interactions of a folder, in the order of its table, at n_samples phases each.

    Trajectories are interpolated between the rows of the table. Raises FileNotFoundError or
    ValueError that names the file, the row and the expected content.
    """
    check_count("n_samples", n_samples, least=2)
    folder, phase = Path(folder), np.linspace(0, 1, n_samples)
    path = folder / TABLE
    if not path.is_file():
        raise FileNotFoundError(
            f"folder: there is no {path}; write a {TABLE} with the columns interaction, t, "
            f"action_x, …, effect_x, …, and {IMAGES}/NAME.png for each interaction"
        )
    try:  # only an empty entry counts as missing; "NA" is a valid name
        table = pd.read_csv(path, dtype={"interaction": str}, keep_default_na=False, na_values=[""])
    except ValueError as error:
        raise ValueError(f"{path} is not a table of comma-separated values: {error}") from error
    actions, effects = _columns(path, table)
    yaws = [name.endswith("yaw") for name in actions + effects]
    trajectories, images = [], []
    for name, rows in table.groupby("interaction", sort=False):
        t, values = rows["t"].to_numpy(float), rows[actions + effects].to_numpy(float)
        if len(t) < 2 or t[0] != 0 or t[-1] != 1 or (np.diff(t) <= 0).any():
            raise ValueError(f"{path}: t of interaction {name!r} must increase from 0 to 1")
        values[:, yaws] = np.unwrap(values[:, yaws], axis=0)
        trajectories.append(np.column_stack([np.interp(phase, t, column) for column in values.T]))
        images.append(_read_depth(folder / IMAGES / f"{name}.png"))
    if not trajectories:
        raise ValueError(f"{path} has no rows; write one per interaction and time")
    both = torch.from_numpy(np.stack(trajectories)).float()
    return InteractionTensors(
        torch.from_numpy(np.stack(images)),
        torch.from_numpy(phase).float(),
        *both.split([len(actions), len(effects)], dim=-1),
        *(tuple(name.split("_", 1)[1] for name in names) for names in (actions, effects)),
    )


def write_folder(folder: str | Path, tensors: InteractionTensors) -> Path:
    """Write interactions in the format of `read_folder` and return the folder."""
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
    """Return the names of the table's action and effect columns, in the order of the channels.

    Raises ValueError if columns are missing or unknown, or entries are not numbers.
    """
    for name in ("interaction", "t"):
        if name not in table:
            raise ValueError(f"{path}: the column {name!r} is missing")
    found = []
    for kind, channels in (("action", ACTION_CHANNELS), ("effect", EFFECT_CHANNELS)):
        known = [f"{kind}_{channel}" for channel in channels]
        there = [name for name in table if name.startswith(f"{kind}_")]
        if not there or not {*there} <= {*known}:
            raise ValueError(f"{path}: the columns of the {kind} are {there}; choose from {known}")
        found.append(sorted(there, key=known.index))
    for name in ("t", *found[0], *found[1]):
        wrong = ~np.isfinite(pd.to_numeric(table[name], errors="coerce"))
        if wrong.any():
            row = int(wrong.argmax())
            raise ValueError(
                f"{path}: the column {name!r} must hold only numbers, but line {row + 2} has "
                f"'{table[name][row]}'"
            )
    if (empty := table["interaction"].isna()).any():
        row = 2 + int(empty.argmax())
        raise ValueError(f"{path}: line {row} has no entry in the column 'interaction'")
    return found


def _pixels(path: Path) -> np.ndarray:
    """Read the values (48, 48) of an image."""
    n = IMAGE_PIXELS
    if not path.is_file():
        raise FileNotFoundError(f"there is no image {path} for the interaction of that name")
    try:
        with Image.open(path) as file:
            values = np.asarray(file)
    except (OSError, SyntaxError, ValueError) as error:
        raise ValueError(f"{path} is damaged, or is not an image: {error}") from error
    if values.shape != (n, n):
        raise ValueError(f"{path} must be a gray image of {n}×{n} pixels, got {values.shape}")
    return values


def _read_depth(path: Path) -> np.ndarray:
    """Read depth [m] and mask (2, 48, 48) of an image."""
    units, mask_path = _pixels(path), path.with_name(f"{path.stem}_mask.png")
    if not np.issubdtype(units.dtype, np.integer) or units.max() <= 255:
        got = f"{units.dtype}, at most {units.max()}"
        raise ValueError(f"{path} must hold depth in 16 bits of 0.1 mm, got {got}")
    depth = units * DEPTH_UNIT_M
    if not mask_path.is_file():
        return np.stack([depth, TABLE_DEPTH_M - depth > _HIGHER_M]).astype(np.float32)
    mask = _pixels(mask_path)
    if mask.dtype != np.uint8 or 0 < mask.max() < 128:
        got = f"{mask.dtype}, at most {mask.max()}"
        raise ValueError(
            f"{mask_path} must have 8 bits, white (255) where the object is, got {got}"
        )
    return np.stack([depth, mask / 255.0]).astype(np.float32)
