"""Storage of data sets: one zip file of Zarr v3, written atomically and verified when opened.

`manifest.json` in it contains the hash of every file, so that missing chunks are not read as fill
values, and of every array, so that sets can be compared without reading them.
"""

import hashlib
import io
import json
import os
import zipfile
from pathlib import Path
from typing import TYPE_CHECKING

import fsspec
import numpy as np
import psutil

from affordlib.results import file_at, from_root, write_atomically

if TYPE_CHECKING:
    import xarray

SUFFIX = ".zarr.zip"
MANIFEST = "manifest.json"
STORED_AS = {"category": "family", "estimated_xy": "believed_xy"}
"""Variables that have another name in the files."""
_REMEDY = "fetch it again, or collect it again (the shipped sets with `make data`)"


class CorruptedDataError(ValueError):
    """Raised when a stored data set is damaged."""


def _hashes(data: "xarray.Dataset") -> dict[str, str]:
    """Return a hash of the type, shape and bytes of each array."""
    found = {}
    for name in data.variables:
        array = data[name].values
        digest = hashlib.sha256(f"{array.dtype.str}{array.shape}".encode())
        digest.update(np.ascontiguousarray(array).reshape(-1).view(np.uint8))
        found[STORED_AS.get(name, name)] = digest.hexdigest()
    return found


def _hash_of(hashes: dict[str, str]) -> str:
    return hashlib.sha256(json.dumps(hashes, sort_keys=True).encode()).hexdigest()


def dataset_sha256(data: "xarray.Dataset") -> str:
    """Return one hash of all arrays of a data set, independent of workers and file."""
    return _hash_of(_hashes(data))


def write_interactions(data: "xarray.Dataset", path: Path, level: int = 9) -> None:
    """Write a set as one file, compressed at a level of 0 to 9; equal sets give equal bytes."""
    from zarr.codecs import BloscCodec
    from zarr.storage import MemoryStore

    data = data.rename({name: there for name, there in STORED_AS.items() if name in data})
    codec, buffers = BloscCodec(cname="zstd", clevel=level, shuffle="shuffle"), {}
    encoding = {
        name: {"compressors": [codec], "chunks": variable.shape, "_FillValue": None}
        for name, variable in data.variables.items()
    }
    data.to_zarr(MemoryStore(buffers), zarr_format=3, consolidated=False, encoding=encoding)
    files = {name: buffer.to_bytes() for name, buffer in buffers.items()}
    of_files = {name: hashlib.sha256(content).hexdigest() for name, content in files.items()}
    manifest = {"arrays": _hashes(data), "files": of_files}
    files[MANIFEST] = json.dumps(manifest, indent=1, sort_keys=True).encode()
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_STORED) as archive:
        for name, content in sorted(files.items()):
            archive.writestr(zipfile.ZipInfo(name, (1980, 1, 1, 0, 0, 0)), content)
    write_atomically(path, packed.getvalue())


def _url_of(name_or_path: str | Path) -> str:
    """Return the path or URL of a set; raises FileNotFoundError if it does not exist."""
    url = os.fspath(name_or_path)
    url = url if url.endswith(SUFFIX) else f"data/{url}{SUFFIX}"
    try:
        return url if "://" in url else str(file_at(url))
    except FileNotFoundError as error:
        shipped = sorted(p.name.removesuffix(SUFFIX) for p in from_root("data").glob(f"*{SUFFIX}"))
        raise FileNotFoundError(
            f"interactions {str(name_or_path)!r}: {error}; give one of the shipped names "
            f"{shipped} or the path of a {SUFFIX} file, or collect them with `make data`"
        ) from None


def _read(url: str, arrays: bool = True) -> tuple[dict[str, str], dict[str, bytes]]:
    """Read the hashes of a set's arrays and, if wanted, the verified files of its zip."""
    found, names, name = {}, [MANIFEST], "its directory"
    try:
        with fsspec.open(url, "rb") as file, zipfile.ZipFile(file) as archive:
            room = file.seek(0, os.SEEK_END)  # nothing in it is compressed as a member of the zip
            while names:
                name = names.pop()
                room -= archive.getinfo(name).file_size
                if room < 0:
                    raise ValueError("it is larger than the file")
                found[name] = archive.read(name)
                if name == MANIFEST:
                    plain = json.loads(found.pop(name))
                    manifest = {kind: dict(plain[kind]) for kind in ("arrays", "files")}
                    names = sorted(manifest["files"]) if arrays else []
                elif hashlib.sha256(found[name]).hexdigest() != manifest["files"][name]:
                    raise ValueError("its hash differs")
        return manifest["arrays"], found
    except Exception as error:
        raise CorruptedDataError(
            f"{url} cannot be read: {name} is damaged or missing ({error!r:.300}); {_REMEDY}"
        ) from error


def stored_sha256(name_or_path: str | Path) -> str:
    """Return the `dataset_sha256` of a stored set from its manifest, without reading arrays."""
    return _hash_of(_read(_url_of(name_or_path), arrays=False)[0])


def open_interactions(name_or_path: str | Path) -> "xarray.Dataset":
    """Read and verify a data set, given a shipped name (`"push"`), a path or an fsspec URL.

    Raises FileNotFoundError, or CorruptedDataError that names the damaged part.
    """
    import xarray
    from zarr.buffer.cpu import Buffer
    from zarr.storage import MemoryStore

    from affordlib.interactions.recipes import RECIPES, Recipe

    url = _url_of(name_or_path)
    store = MemoryStore({n: Buffer.from_bytes(c) for n, c in _read(url)[1].items()})
    try:
        with xarray.open_zarr(store, consolidated=False, zarr_format=3) as data:
            if data.nbytes > psutil.virtual_memory().total:
                raise ValueError(f"its arrays of {data.nbytes / 1e9:.0f} GB exceed the memory")
            data = data[sorted(data.data_vars)].load()
            data = data.rename({there: name for name, there in STORED_AS.items() if there in data})
            (data.attrs["action_channels"] + data.attrs["effect_channels"]).split()
            Recipe.from_json(data.attrs["recipe"])
            data["category"].attrs["flag_meanings"].split()[data["category"].values.max()]
            recipe = RECIPES.get(str(name_or_path))
            if recipe is not None and data.attrs.get("recipe") != recipe.to_json():
                raise ValueError(f"its recipe is not that of {name_or_path!r}")
            return data
    except Exception as error:
        raise CorruptedDataError(f"{url} is not a data set ({error!r:.300}); {_REMEDY}") from error
