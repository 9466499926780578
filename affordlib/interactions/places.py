"""Where files lie: a local folder, or any place that fsspec knows and all workers reach."""

from __future__ import annotations

import os
import shutil
import uuid
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from filelock import FileLock, Timeout
from fsspec import AbstractFileSystem
from fsspec.core import url_to_fs
from fsspec.implementations.local import LocalFileSystem
from fsspec.implementations.memory import MemoryFileSystem

_PARTIAL = ".partial"


@dataclass(frozen=True)
class Place:
    """A folder or file by its absolute URL or local path; `name`s of files are relative to it."""

    url: str

    @classmethod
    def of(cls, path: str | Path) -> Place:
        """The place of a path or fsspec URL; local ones, `file://` too, become absolute paths."""
        fs, root = url_to_fs(os.fspath(path))
        return cls(root if isinstance(fs, LocalFileSystem) else os.fspath(path).rstrip("/"))

    @property
    def fs(self) -> AbstractFileSystem:
        return url_to_fs(self.url)[0]

    @property
    def root(self) -> str:
        return url_to_fs(self.url)[1].rstrip("/")

    @property
    def is_local(self) -> bool:
        return isinstance(self.fs, LocalFileSystem)

    @property
    def is_private(self) -> bool:
        """Whether every process sees a place of its own."""
        return isinstance(self.fs, MemoryFileSystem)

    @property
    def name(self) -> str:
        return self.url.rpartition("/")[2]

    def holds_something(self) -> bool:
        """Whether there is a file, or a folder that is not empty."""
        there = self.fs.exists(self.root)
        return there and (self.fs.isfile(self.root) or bool(self.fs.ls(self.root, detail=False)))

    def sibling(self, name: str) -> Place:
        """The place of another name in the same folder."""
        return Place(f"{self.url.rpartition('/')[0]}/{name}")

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Hold the sole right to collect into a local place; the lock dies with its process.

        Raises RuntimeError while another one holds it. Other places have no lock: whoever collects
        into them writes the same bits.
        """
        if not self.is_local:
            yield
            return
        path = Path(self.sibling(f".{self.name}.lock").root)
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            lock = FileLock(path).acquire(timeout=0)
        except Timeout:
            raise RuntimeError(
                f"another process is collecting into {self.url}; wait for it or choose another path"
            ) from None
        with lock:
            try:
                yield
            finally:
                path.unlink(missing_ok=True)  # who has opened it meanwhile finds it gone

    def make_folders(self, names: Iterable[str]) -> None:
        """Make the folders in which files of these names lie; `write` makes none."""
        for folder in sorted({f"{self.root}/{name}".rpartition("/")[0] for name in names}):
            self.fs.makedirs(folder, exist_ok=True)

    def read(self, names: Iterable[str]) -> dict[str, bytes]:
        """The contents of those files that exist, by name; other failures are raised."""
        paths = {self.fs._strip_protocol(f"{self.root}/{name}"): name for name in names}
        if self.is_local:
            found = {path: Path(path).read_bytes() for path in paths if Path(path).is_file()}
        else:
            found = self.fs.cat(list(paths), on_error="return") if paths else {}
        for content in found.values():
            if isinstance(content, Exception) and not isinstance(content, FileNotFoundError):
                raise content
        return {paths[p]: content for p, content in found.items() if isinstance(content, bytes)}

    def write(self, name: str, content: bytes) -> None:
        """Write a file; a local one appears whole or not at all, in a folder that must exist."""
        if not self.is_local:
            self.fs.pipe_file(f"{self.root}/{name}", content)
            return
        target = Path(self.root, name)
        temporary = target.with_name(f".{uuid.uuid4().hex}{_PARTIAL}")
        try:
            temporary.write_bytes(content)
            os.replace(temporary, target)
        except BaseException:
            temporary.unlink(missing_ok=True)
            raise

    def delete(self, name: str) -> None:
        """Delete a file if it is there."""
        if self.read([name]):
            self.fs.rm_file(f"{self.root}/{name}")

    def delete_partials(self) -> None:
        """Delete what killed writers have left of local files."""
        if self.is_local:
            for path in Path(self.root).rglob(f".*{_PARTIAL}"):
                path.unlink(missing_ok=True)

    def delete_all(self) -> None:
        """Delete the folder with all that is in it, if it is there."""
        if self.is_local:
            # A worker that was given up may still be writing; what it leaves harms nothing.
            shutil.rmtree(self.root, ignore_errors=True)
        elif self.fs.exists(self.root):
            self.fs.rm(self.root, recursive=True)
