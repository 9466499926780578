"""Interactions of your own: a folder of one table and of images, as any robot's log can be written.

courses.csv          one row per interaction and moment: interaction, t, action_x, action_y, …,
                     effect_x, effect_y, …; t from 0 to 1, lengths in m, angles in rad, relative
                     to the object as it stood at t = 0
images/NAME.png      NAME is the entry in the column interaction: depth seen from above before
                     the action, 48×48 pixels, 16 cm wide, rows along -y, 16 bits of 0.1 mm from
                     a plane 1 m above the table (so the table is 10000)
images/NAME_mask.png the object, 8 bits, white where it fills the pixel; where there is none,
                     all that is higher than 2 mm is taken for the object
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import torch
from PIL import Image

from affordlib.interactions.batches import TrainingArrays
from affordlib.types import ACTION_CHANNELS, EFFECT_CHANNELS, IMAGE_PIXELS, check_count

COURSES, IMAGES = "courses.csv", "images"
DEPTH_UNIT_M = 1e-4
TABLE_M = 1.0
_HIGHER_M = 0.002


def read_folder(folder: str | Path, n_samples: int = 101) -> TrainingArrays:
    """The interactions of a folder, in the order of its table, at n_samples phases each.

    Between the rows of the table courses are interpolated. Raises FileNotFoundError or ValueError
    that says which file, which row and what is expected.
    """
    folder = Path(folder)
    check_count("n_samples", n_samples, least=2)
    path = folder / COURSES
    if not path.is_file():
        raise FileNotFoundError(
            f"folder: there is no {path}; expected are {COURSES} with the columns interaction, t, "
            f"action_x, …, effect_x, …, and {IMAGES}/NAME.png for each interaction"
        )
    # Only an empty entry is missing: "NA" is a name as good as others.
    table = pd.read_csv(path, dtype={"interaction": str}, keep_default_na=False, na_values=[""])
    actions = _channels(path, table, "action", ACTION_CHANNELS)
    effects = _channels(path, table, "effect", EFFECT_CHANNELS)
    if table["interaction"].isna().any():
        row = 2 + int(table["interaction"].isna().argmax())
        raise ValueError(f"{path}: line {row} has no entry in the column 'interaction'")
    phase = np.linspace(0, 1, n_samples)
    courses, images = [], []
    for name, rows in table.groupby("interaction", sort=False):
        t = rows["t"].to_numpy(dtype=float)
        values = rows[actions + effects].to_numpy(dtype=float)
        if not (np.isfinite(values).all() and np.isfinite(t).all()):
            raise ValueError(f"{path}: interaction {name!r} has an entry that is not a number")
        if len(t) < 2 or t[0] != 0 or t[-1] != 1 or (np.diff(t) <= 0).any():
            raise ValueError(f"{path}: t of interaction {name!r} must grow from 0 to 1")
        for k, channel in enumerate(actions + effects):
            if channel.endswith("yaw"):
                values[:, k] = np.unwrap(values[:, k])
        courses.append(np.column_stack([np.interp(phase, t, column) for column in values.T]))
        images.append(_read_image(folder / IMAGES, name))
    if not courses:
        raise ValueError(f"{path}: there are no rows")
    action, effect = (
        torch.from_numpy(np.stack(courses)).float().split([len(actions), len(effects)], dim=-1)
    )
    return TrainingArrays(
        torch.from_numpy(np.stack(images)),
        torch.from_numpy(phase).float(),
        action,
        effect,
        *(tuple(name.split("_", 1)[1] for name in names) for names in (actions, effects)),
    )


def write_folder(folder: str | Path, arrays: TrainingArrays) -> Path:
    """Write interactions as `read_folder` reads them; returns the folder."""
    folder = Path(folder)
    (folder / IMAGES).mkdir(parents=True, exist_ok=True)
    columns = [f"action_{c}" for c in arrays.action_channels]
    columns += [f"effect_{c}" for c in arrays.effect_channels]
    values = torch.cat([arrays.action, arrays.effect], dim=-1).numpy()
    names = [f"{k:04d}" for k in range(len(arrays))]
    table = pd.DataFrame(values.reshape(-1, values.shape[-1]), columns=columns)
    table.insert(0, "t", arrays.phases(torch.arange(len(arrays.phase))).numpy().ravel())
    table.insert(0, "interaction", np.repeat(names, len(arrays.phase)))
    for name, (depth, mask) in zip(names, arrays.image.numpy(), strict=True):
        units = np.round(depth / DEPTH_UNIT_M).astype(np.uint16)
        Image.fromarray(units).save(folder / IMAGES / f"{name}.png")
        inside = np.round(255 * mask).astype(np.uint8)
        Image.fromarray(inside).save(folder / IMAGES / f"{name}_mask.png")
    table.to_csv(folder / COURSES, index=False)
    return folder


def _channels(path: Path, table: pd.DataFrame, kind: str, known: tuple[str, ...]) -> list[str]:
    """The table's columns of actions or effects."""
    missing = [name for name in ("interaction", "t") if name not in table]
    if missing:
        raise ValueError(f"{path}: the column {missing[0]!r} is missing")
    found = [name for name in table if name.startswith(f"{kind}_")]
    unknown = [name for name in found if name.removeprefix(f"{kind}_") not in known]
    if unknown or not found:
        wrong = f"{unknown[0]!r} is unknown" if unknown else f"there is no column {kind}_…"
        expected = ", ".join(f"{kind}_{name}" for name in known)
        raise ValueError(f"{path}: {wrong}; choose from {expected}")
    words = [name for name in [*found, "t"] if not pd.api.types.is_numeric_dtype(table[name])]
    if words:
        raise ValueError(f"{path}: the column {words[0]!r} must hold numbers only")
    return found


def _read_image(folder: Path, name: str) -> np.ndarray:
    """Depth [m] and mask (2, 48, 48)."""
    path = folder / f"{name}.png"
    if not path.is_file():
        raise FileNotFoundError(f"the image of interaction {name!r} is missing: {path}")
    with Image.open(path) as file:
        units = np.asarray(file)
    size = (IMAGE_PIXELS, IMAGE_PIXELS)
    if units.shape != size or not np.issubdtype(units.dtype, np.integer) or units.max() <= 255:
        raise ValueError(
            f"{path} must be a gray image of {size[0]}×{size[1]} pixels with 16 bits of 0.1 mm, "
            f"got {units.shape}, {units.dtype}, at most {units.max()}"
        )
    depth = units * DEPTH_UNIT_M
    mask = TABLE_M - depth > _HIGHER_M
    if (masked := folder / f"{name}_mask.png").is_file():
        with Image.open(masked) as file:
            values = np.asarray(file)
        if values.shape != size or values.dtype != np.uint8 or 0 < values.max() < 128:
            raise ValueError(
                f"{masked} must be a gray image of {size[0]}×{size[1]} pixels with 8 bits, white "
                f"(255) where the object is, got {values.shape}, {values.dtype}, at most "
                f"{values.max()}"
            )
        mask = values / 255.0
    return np.stack([depth, mask]).astype(np.float32)
