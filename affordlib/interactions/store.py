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

import fsspec
import numpy as np
from fsspec.core import url_to_fs

from affordlib.paths import repo_root
from affordlib.results import write_atomically

SUFFIX = ".zarr.zip"
MANIFEST = "manifest.json"
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
        found[str(name)] = digest.hexdigest()
    return found


def _hash_of(hashes: dict[str, str]) -> str:
    return hashlib.sha256(json.dumps(hashes, sort_keys=True).encode()).hexdigest()


def dataset_sha256(data: "xarray.Dataset") -> str:
    """Return one hash of all arrays of a data set, independent of workers and file."""
    return _hash_of(_hashes(data))


def write_interactions(data: "xarray.Dataset", path: Path, level: int = 9) -> None:
    """Write a set as one file, atomically; equal sets give identical bytes.

    level: compression level from 0 to 9.
    """
    from zarr.codecs import BloscCodec
    from zarr.storage import MemoryStore

    codec = BloscCodec(cname="zstd", clevel=level, shuffle="shuffle")
    buffers = {}
    encoding = {
        name: {"compressors": [codec], "chunks": variable.shape, "_FillValue": None}
        for name, variable in data.variables.items()
    }
    data.to_zarr(MemoryStore(buffers), zarr_format=3, consolidated=False, encoding=encoding)
    files = {name: buffer.to_bytes() for name, buffer in buffers.items()}
    manifest = {
        "arrays": _hashes(data),
        "files": {name: hashlib.sha256(content).hexdigest() for name, content in files.items()},
    }
    files[MANIFEST] = json.dumps(manifest, indent=1, sort_keys=True).encode()
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_STORED) as archive:
        for name, content in sorted(files.items()):
            archive.writestr(zipfile.ZipInfo(name, (1980, 1, 1, 0, 0, 0)), content)
    write_atomically(path, packed.getvalue())


def _url_of(name_or_path: str | Path) -> str:
    """Return the path or URL of a set; raises FileNotFoundError if it does not exist."""
    url = os.fspath(name_or_path)
    if not url.endswith(SUFFIX):
        url = str(repo_root() / "data" / f"{url}{SUFFIX}")
    fs, path = url_to_fs(url)
    if not fs.exists(path):
        shipped = sorted(
            p.name.removesuffix(SUFFIX) for p in (repo_root() / "data").glob(f"*{SUFFIX}")
        )
        raise FileNotFoundError(
            f"interactions {str(name_or_path)!r}: there is no file {url}; give one of the shipped "
            f"names {shipped} or the path of a {SUFFIX} file, or collect them with `make data`"
        )
    return url


def _read(url: str, only: str | None = None) -> tuple[dict[str, dict[str, str]], dict[str, bytes]]:
    """Read the manifest of a set, and the files of its zip (all, or only one) by name."""
    found, name = {}, "its directory"
    try:
        with fsspec.open(url, "rb") as file, zipfile.ZipFile(file) as archive:
            for name in archive.namelist() if only is None else [only]:
                found[name] = archive.read(name)
            name = MANIFEST
            manifest = json.loads(found[MANIFEST])
            return {kind: dict(manifest[kind]) for kind in ("arrays", "files")}, found
    except Exception as error:
        raise CorruptedDataError(
            f"{url} cannot be read: {name} is damaged or missing ({error!r}); {_REMEDY}"
        ) from error


def stored_sha256(name_or_path: str | Path) -> str:
    """Return the `dataset_sha256` of a stored set from its manifest, without reading arrays."""
    url = _url_of(name_or_path)
    return _hash_of(_read(url, MANIFEST)[0]["arrays"])


def open_interactions(name_or_path: str | Path) -> "xarray.Dataset":
    """Read and verify a data set, given a shipped name (`"push"`), a path or an fsspec URL.

    Raises FileNotFoundError, or CorruptedDataError that names the damaged part.
    """
    import xarray
    from zarr.buffer.cpu import Buffer
    from zarr.storage import MemoryStore

    url = _url_of(name_or_path)
    manifest, files = _read(url)
    for name, digest in manifest["files"].items():
        if hashlib.sha256(files.get(name, b"")).hexdigest() != digest:
            raise CorruptedDataError(f"{url}: {name} is missing or damaged; {_REMEDY}")
    store = MemoryStore({n: Buffer.from_bytes(c) for n, c in files.items() if n != MANIFEST})
    try:
        with xarray.open_zarr(store, consolidated=False, zarr_format=3) as data:
            return data[sorted(data.data_vars)].load()
    except Exception as error:
        raise CorruptedDataError(f"{url} is not a data set ({error}); {_REMEDY}") from error
