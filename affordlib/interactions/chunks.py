"""The files of a data set that is being made: empty arrays, then one whole chunk after another.

Whoever makes a chunk writes its encoded files and then, last, a record of their hashes in `tasks/`.
No two tasks touch one file, and a chunk whose record does not fit its files is not there.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass, field

import numpy as np
import zarr
from zarr.buffer.cpu import Buffer
from zarr.codecs import BloscCodec, Crc32cCodec
from zarr.storage import MemoryStore

from affordlib.interactions.places import Place

CHUNK = 50
"""Interactions in one stored chunk, and in one task of collecting."""

AXIS = "interaction"
DONE = "done"
_CODECS = [BloscCodec(cname="zstd", clevel=7, shuffle="shuffle"), Crc32cCodec()]


def sha256(content: bytes) -> str:
    """Hash of a file's content."""
    return hashlib.sha256(content).hexdigest()


@dataclass(frozen=True)
class Variable:
    """One array of a data set; `interaction`, where it has that dimension, comes first."""

    dims: tuple[str, ...]
    dtype: str
    attrs: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Layout:
    """What a data set will hold, known before it is made; sizes: of its dimensions by name."""

    variables: dict[str, Variable]
    sizes: dict[str, int]
    attrs: dict[str, str]
    chunk: int = CHUNK

    @property
    def n_chunks(self) -> int:
        return -(-self.sizes[AXIS] // self.chunk)

    def rows(self, number: int) -> range:
        """The interactions of a chunk."""
        return range(self.sizes[AXIS])[number * self.chunk : (number + 1) * self.chunk]

    def shape(self, name: str) -> tuple[int, ...]:
        """The shape of a whole variable."""
        return tuple(self.sizes[dim] for dim in self.variables[name].dims)

    def files(self, number: int) -> dict[str, str]:
        """The variables of a task by the file it writes; task 0 also writes what is common."""
        files = {}
        for name, variable in self.variables.items():
            along = AXIS in variable.dims
            if along or number == 0:
                first = number if along else 0
                key = [first if dim == AXIS else 0 for dim in variable.dims]
                files["/".join([name, ".".join(["c", *map(str, key)])])] = name
        return files


def empty_set(layout: Layout) -> tuple[dict[str, Buffer], dict[str, zarr.Array]]:
    """An empty set in memory: its files so far, those of metadata, and its arrays."""
    files: dict[str, Buffer] = {}
    group = zarr.create_group(MemoryStore(files), attributes=layout.attrs, zarr_format=3)
    arrays = {
        name: group.create_array(
            name,
            shape=layout.shape(name),
            dtype=variable.dtype,
            chunks=tuple(layout.chunk if d == AXIS else layout.sizes[d] for d in variable.dims),
            compressors=_CODECS,
            attributes=variable.attrs,
            dimension_names=variable.dims,
            # One folder for each variable, and none for each chunk.
            chunk_key_encoding={"name": "default", "separator": "."},
            config={"write_empty_chunks": True},
        )
        for name, variable in sorted(layout.variables.items())
    }
    return files, arrays


def metadata_files(layout: Layout) -> dict[str, bytes]:
    """The metadata files of a set by name."""
    return {name: content.to_bytes() for name, content in empty_set(layout)[0].items()}


def create(place: Place, layout: Layout) -> None:
    """Write an empty set's metadata, or make sure that the place already holds this very set.

    Raises ValueError if it holds another one.
    """
    expected = metadata_files(layout)
    found = place.read(expected)
    differing = sorted(name for name in found if found[name] != expected[name])
    if differing:
        raise ValueError(
            f"path {place.url} holds a set of another recipe, or of other package versions "
            f"({differing[0]} differs); choose another path or delete it"
        )
    if not found and place.holds_something():
        raise ValueError(
            f"path {place.url} is there and is no set of interactions; choose another path, or "
            "delete it"
        )
    place.delete(DONE)
    place.make_folders([*expected, record_name(0)])
    for name in sorted(expected.keys() - found.keys()):
        place.write(name, expected[name])


def record_name(number: int) -> str:
    """The name of the record that a task writes last."""
    return f"tasks/{number:08d}.json"


def is_record(name: str) -> bool:
    """Whether a file is a task's record, and so no part of the Zarr hierarchy."""
    return name.startswith("tasks/")


def write_chunk(place: Place, layout: Layout, number: int, arrays: dict[str, np.ndarray]) -> None:
    """Encode and write one chunk of every variable, and last the record of its files.

    Raises ValueError if the arrays are not those of the layout.
    """
    contents, targets = empty_set(layout)
    metadata = set(contents)
    rows = layout.rows(number)
    if arrays.keys() != targets.keys():
        raise ValueError(
            f"arrays: {sorted(arrays.keys() ^ targets.keys())} are in the layout or the chunk, "
            "not in both"
        )
    for name in layout.files(number).values():
        along = AXIS in layout.variables[name].dims
        shape = (len(rows), *layout.shape(name)[1:]) if along else layout.shape(name)
        if arrays[name].shape != shape or arrays[name].dtype != targets[name].dtype:
            raise ValueError(
                f"arrays[{name!r}] must be {targets[name].dtype} of shape {shape}, got "
                f"{arrays[name].dtype} of shape {arrays[name].shape}; mend it or the layout"
            )
        targets[name][slice(rows.start, rows.stop) if along else ...] = arrays[name]
    hashes = {}
    for name in sorted(contents.keys() - metadata):
        content = contents[name].to_bytes()
        place.write(name, content)
        hashes[name] = sha256(content)
    record = {"interactions": [rows.start, rows.stop], "sha256": hashes}
    place.write(record_name(number), as_json(record))


def as_json(value: object) -> bytes:
    """A JSON file's content; equal values give equal bytes."""
    return json.dumps(value, indent=1, sort_keys=True).encode()


def read_chunk(place: Place, layout: Layout, number: int) -> dict[str, bytes] | None:
    """A finished chunk's files by name, its record too; None if any is missing or differs."""
    name = record_name(number)
    record = place.read([name])
    try:
        hashes = json.loads(record[name])["sha256"]
        if hashes.keys() != layout.files(number).keys():
            return None
    except (KeyError, TypeError, AttributeError, ValueError):
        return None
    files = place.read(hashes)
    if any(n not in files or sha256(files[n]) != h for n, h in hashes.items()):
        return None
    return files | record
