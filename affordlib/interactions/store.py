"""Data sets of interactions: Zarr v3, a folder or one zip file, checked whole when opened.

A reader meets one call, `open_interactions("push")`. While a set grows, whoever makes a chunk
writes its files and then, last, a record of their hashes in `tasks/`. A finished set has a
`manifest.json` with the hash of every file, and a file `done` with the manifest's: nothing is ever
read as fill values.
"""

from __future__ import annotations

import hashlib
import json
import os
import tempfile
import zipfile
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from zarr.buffer.cpu import Buffer
from zarr.storage import MemoryStore

from affordlib.interactions.chunks import (
    AXIS,
    DONE,
    Layout,
    as_json,
    empty_set,
    is_record,
    metadata_files,
    read_chunk,
    record_name,
    sha256,
)
from affordlib.interactions.places import Place
from affordlib.paths import repo_root

SUFFIX = ".zarr.zip"
FOLDER_SUFFIX = ".zarr"
MANIFEST = "manifest.json"


class CorruptedDataError(ValueError):
    """A data set is damaged or unfinished: what was read is not what was written."""


def _array_digest(dtype: np.dtype, shape: tuple[int, ...]) -> Any:
    return hashlib.sha256(f"{dtype.str}{shape}".encode())


def _bytes(array: np.ndarray) -> np.ndarray:
    """An array's bytes (n,), for any type of its values."""
    return np.ascontiguousarray(array).reshape(-1).view(np.uint8)


def array_sha256(array: np.ndarray) -> str:
    """Hash of an array's type, shape and bytes."""
    digest = _array_digest(array.dtype, array.shape)
    digest.update(_bytes(array))
    return digest.hexdigest()


def _set_sha256(arrays: dict[str, str]) -> str:
    return sha256(json.dumps(arrays, sort_keys=True).encode())


def dataset_sha256(data: xr.Dataset) -> str:
    """One hash for all arrays of a data set; it depends neither on workers nor on the file."""
    return _set_sha256({str(name): array_sha256(data[name].values) for name in data.variables})


def finish(place: Place, layout: Layout) -> None:
    """Hash a set whose chunks are all there, chunk by chunk, and mark it as done."""
    contents, arrays = empty_set(layout)
    files = {name: sha256(content.to_bytes()) for name, content in contents.items()}
    digests = {n: _array_digest(array.dtype, array.shape) for n, array in arrays.items()}
    for number in range(layout.n_chunks):
        chunk = read_chunk(place, layout, number)
        if chunk is None:
            raise CorruptedDataError(
                f"{place.url}: the files of {record_name(number)} were changed or deleted after "
                "they were written; collect again into the same path"
            )
        files |= {name: sha256(content) for name, content in chunk.items()}
        contents.update({name: Buffer.from_bytes(content) for name, content in chunk.items()})
        rows = slice(layout.rows(number).start, layout.rows(number).stop)
        for name in layout.files(number).values():
            part = arrays[name][rows if AXIS in layout.variables[name].dims else ...]
            digests[name].update(_bytes(part))
        for name in chunk:
            del contents[name]
    hashes = {name: digest.hexdigest() for name, digest in digests.items()}
    manifest = as_json({"arrays": hashes, "files": files})
    place.delete_partials()
    place.write(MANIFEST, manifest)
    place.write(DONE, sha256(manifest).encode())


def pack(folder: Place, target: Place) -> None:
    """Zip a finished set; equal sets give equal bytes, whole under the target's name or not.

    Only what the manifest names is packed, in sorted order and with fixed times.
    """
    names = [*json.loads(folder.read([MANIFEST])[MANIFEST])["files"], MANIFEST, DONE]
    with tempfile.TemporaryDirectory(dir=folder.root if target.is_local else None) as work:
        packed = Path(work, "zip")
        with open(packed, "wb") as file:
            with zipfile.ZipFile(file, "w", zipfile.ZIP_STORED) as archive:
                for name in sorted(names):
                    entry = zipfile.ZipInfo(name, (1980, 1, 1, 0, 0, 0))
                    archive.writestr(entry, folder.read([name])[name])
            file.flush()
            os.fsync(file.fileno())
        if target.is_local:
            os.replace(packed, target.root)
            _sync_folder(Path(target.root).parent)
        else:
            target.fs.put_file(str(packed), target.root)


def _sync_folder(folder: Path) -> None:
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _resolve(name_or_path: str | Path) -> Place:
    """The place of a shipped data set's name, of a path or of a URL; raises when it is empty."""
    path = os.fspath(name_or_path)
    if not path.rstrip("/").endswith((SUFFIX, FOLDER_SUFFIX)):
        path = str(repo_root() / "data" / f"{path}{SUFFIX}")
    place = Place.of(path)
    if not place.fs.exists(place.root):
        shipped = sorted(
            p.name.removesuffix(SUFFIX) for p in (repo_root() / "data").glob(f"*{SUFFIX}")
        )
        raise FileNotFoundError(
            f"interactions {str(name_or_path)!r}: there is no file {place.url}; give one of the "
            f"shipped names {shipped} or the path of a {SUFFIX} file or {FOLDER_SUFFIX} folder, "
            "or make them again with `make data`"
        )
    return place


_REMEDY = "fetch it again, or collect it again (the shipped sets with `make data`)"


def _read(place: Place, names: Iterable[str]) -> dict[str, bytes]:
    """Those files of a set, a folder or a zip, that exist."""
    if not place.name.endswith(SUFFIX):
        return place.read(names)
    found, name = {}, "its directory"
    try:
        with place.fs.open(place.root, "rb") as file, zipfile.ZipFile(file) as archive:
            there = set(archive.namelist())
            for name in there.intersection(names):
                found[name] = archive.read(name)
    except Exception as error:
        raise CorruptedDataError(
            f"{place.url} cannot be read: {name} is damaged ({error}); {_REMEDY}"
        ) from error
    return found


def _read_manifest(place: Place) -> dict[str, dict[str, str]]:
    found = _read(place, (DONE, MANIFEST))
    if DONE not in found:
        raise CorruptedDataError(
            f"{place.url} is not finished: it has no file {DONE!r}; collect again into the same "
            f"path to finish it, or {_REMEDY}"
        )
    if MANIFEST not in found:
        raise CorruptedDataError(f"{place.url}: {MANIFEST} is missing; {_REMEDY}")
    if found[DONE] != sha256(found[MANIFEST]).encode():
        raise CorruptedDataError(
            f"{place.url}: {MANIFEST} is not the one whose hash {DONE!r} holds, one of the two was "
            f"changed; {_REMEDY}"
        )
    try:
        manifest = json.loads(found[MANIFEST])
        if all(isinstance(manifest[kind], dict) for kind in ("arrays", "files")):
            return manifest
    except (KeyError, TypeError, ValueError, RecursionError):
        pass
    raise CorruptedDataError(f"{place.url}: {MANIFEST} does not list a data set; {_REMEDY}")


def stored_sha256(name_or_path: str | Path) -> str:
    """The `dataset_sha256` of a stored set, told by its manifest without reading the arrays."""
    return _set_sha256(_read_manifest(_resolve(name_or_path))["arrays"])


def open_interactions(name_or_path: str | Path) -> xr.Dataset:
    """Read a data set, whole and checked, given a shipped name (`"push"`), a path or a URL.

    Dimensions: interaction, sample, action_channel, effect_channel, image_channel, row, column.
    Raises FileNotFoundError, or CorruptedDataError naming what is damaged.
    """
    place = _resolve(name_or_path)
    files = _read_checked(place)
    store = MemoryStore(
        {name: Buffer.from_bytes(files[name]) for name in files if not is_record(name)}
    )
    try:
        with xr.open_zarr(store, consolidated=False, zarr_format=3) as data:
            return data[sorted(data.data_vars)].load()
    except Exception as error:
        raise CorruptedDataError(f"{place.url} holds no data set ({error}); {_REMEDY}") from error


def _read_checked(place: Place) -> dict[str, bytes]:
    """All files of a finished set, or CorruptedDataError naming what is damaged."""
    hashes = _read_manifest(place)["files"]
    files = _read(place, hashes)
    missing = sorted(hashes.keys() - files.keys())
    changed = sorted(name for name in files if sha256(files[name]) != hashes[name])
    for names, what in ((missing, "missing"), (changed, "not what was stored")):
        if names:
            more = f" (and {len(names) - 1} others)" if len(names) > 1 else ""
            raise CorruptedDataError(f"{place.url}: {names[0]}{more} is {what}; {_REMEDY}")
    return files


def is_finished(place: Place, layout: Layout) -> bool:
    """Whether a zip holds this very set, whole; ValueError if something else is there."""
    if not (place.fs.exists(place.root) or (place.is_local and Path(place.root).is_symlink())):
        return False
    remedy = "choose another path, delete it, or pass replace=True"
    try:
        files = _read_checked(place)
    except CorruptedDataError as error:
        raise ValueError(
            f"path {place.url} is no whole set of interactions ({error}); {remedy}"
        ) from error
    expected = metadata_files(layout)
    differing = sorted(name for name in expected if files.get(name) != expected[name])
    if differing:
        raise ValueError(
            f"path {place.url} holds a set of another recipe, or of other package versions "
            f"({differing[0]} differs); {remedy}"
        )
    return True
