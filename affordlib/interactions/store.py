"""Data sets of interactions: xarray on Zarr v3, one zip file each, checked when opened.

A reader meets one call, `open_interactions("push")`. Chunks carry checksums, and the file's own
list of hashes makes a missing or changed array an error: nothing is ever read as fill values.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import tempfile
import zipfile
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import xarray as xr
import zarr
from zarr.codecs import BloscCodec, Crc32cCodec
from zarr.storage import LocalStore, ZipStore

from affordlib.paths import repo_root

if TYPE_CHECKING:
    from collections.abc import Iterable

CHUNK = 50
"""Interactions in one stored chunk, and in one task of collecting."""

SUFFIX = ".zarr.zip"
_CODECS = [BloscCodec(cname="zstd", clevel=7, shuffle="shuffle"), Crc32cCodec()]


class CorruptedDataError(ValueError):
    """A data set's file is damaged: what was read is not what was written."""


def array_sha256(array: np.ndarray) -> str:
    """Hash of an array's type, shape and bytes."""
    array = np.ascontiguousarray(array)
    digest = hashlib.sha256(f"{array.dtype.str}{array.shape}".encode())
    digest.update(array.tobytes())
    return digest.hexdigest()


def manifest(data: xr.Dataset) -> dict[str, str]:
    """Hash of every variable of a data set, by name."""
    return {str(name): array_sha256(data[name].values) for name in sorted(data.variables)}


def dataset_sha256(data: xr.Dataset) -> str:
    """One hash for all arrays of a data set; it depends neither on workers nor on the file."""
    return hashlib.sha256(json.dumps(manifest(data), sort_keys=True).encode()).hexdigest()


def _zip_folder(folder: Path, path: Path) -> None:
    """Zip a folder with sorted names and fixed times, so equal contents give equal bytes."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_STORED) as archive:
        for file in sorted(p for p in folder.rglob("*") if p.is_file()):
            entry = zipfile.ZipInfo(file.relative_to(folder).as_posix(), (1980, 1, 1, 0, 0, 0))
            archive.writestr(entry, file.read_bytes())


def write_interactions(parts: Iterable[xr.Dataset], path: str | Path) -> Path:
    """Write a data set given in order as parts of `CHUNK` interactions; returns the file's path.

    The file appears whole under its name, or not at all.
    """
    path = Path(path)
    if not path.name.endswith(SUFFIX):
        raise ValueError(f"path must end in {SUFFIX!r}, got {str(path)!r}")
    path.parent.mkdir(parents=True, exist_ok=True)
    work = Path(tempfile.mkdtemp(prefix=f".{path.name}.", dir=path.parent))
    try:
        store = LocalStore(work / "zarr")
        for k, part in enumerate(parts):
            if k == 0:
                encoding = {
                    name: {
                        "compressors": _CODECS,
                        "chunks": tuple(
                            CHUNK if dim == "interaction" else n
                            for dim, n in part[name].sizes.items()
                        ),
                    }
                    for name in part.variables
                }
                part.to_zarr(store, mode="w", zarr_format=3, consolidated=False, encoding=encoding)
            else:
                part.to_zarr(store, append_dim="interaction", zarr_format=3, consolidated=False)
        with xr.open_zarr(store, consolidated=False, zarr_format=3) as written:
            hashes = manifest(written)
        zarr.open_group(store, mode="r+").attrs["manifest_sha256"] = json.dumps(hashes)
        _zip_folder(work / "zarr", work / "zip")
        with open(work / "zip", "rb") as file:
            os.fsync(file.fileno())
        os.replace(work / "zip", path)
    finally:
        shutil.rmtree(work, ignore_errors=True)
    return path


def resolve_interactions(name_or_path: str | Path) -> Path:
    """The file of a shipped data set's name, or of a path; raises when there is none."""
    path = Path(name_or_path)
    if not str(name_or_path).endswith(SUFFIX):
        path = repo_root() / "data" / f"{name_or_path}{SUFFIX}"
    if not path.is_file():
        shipped = sorted(
            p.name.removesuffix(SUFFIX) for p in (repo_root() / "data").glob(f"*{SUFFIX}")
        )
        raise FileNotFoundError(
            f"interactions {str(name_or_path)!r}: there is no file {path}; give one of the shipped "
            f"names {shipped} or the path of a {SUFFIX} file, or make them again with `make data`"
        )
    return path


def open_interactions(name_or_path: str | Path) -> xr.Dataset:
    """Read a data set, whole and checked, given a shipped name (`"push"`) or a path.

    Dimensions: interaction, sample, action_channel, effect_channel, image_channel, row, column.
    Raises FileNotFoundError, or CorruptedDataError naming what is damaged.
    """
    path = resolve_interactions(name_or_path)
    remedy = "fetch the file again, or make it again with `make data`"
    try:
        with ZipStore(path, mode="r") as store:
            data = xr.open_zarr(store, consolidated=False, zarr_format=3).load()
            data.close()
    except Exception as error:
        raise CorruptedDataError(f"{path} cannot be read ({error}); {remedy}") from error
    try:
        expected = json.loads(data.attrs["manifest_sha256"])
    except (KeyError, ValueError) as error:
        raise CorruptedDataError(f"{path} has lost its list of hashes; {remedy}") from error
    found = manifest(data)
    wrong = sorted(n for n in expected.keys() | found.keys() if expected.get(n) != found.get(n))
    if wrong:
        raise CorruptedDataError(
            f"{path}: {', '.join(wrong)} differ from what was stored; {remedy}"
        )
    return data
