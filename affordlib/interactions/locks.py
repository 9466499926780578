"""One collector at a time: a lock that never outlives its owner for long, on any file system."""

from __future__ import annotations

import json
import os
import threading
import time
import uuid
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from affordlib.interactions.places import Place

LEASE_S = 30.0
"""A lease that nobody has renewed for so long has lost its owner."""
RENEW_S = 5.0
SETTLE_S = 1.0
"""Two that take a lease at once both see, after this time, whose it has become."""

_LEASE = "lease"


def _taken(place: Place) -> RuntimeError:
    return RuntimeError(
        f"another process is collecting into {place.url}; wait for it or choose another path"
    )


@contextmanager
def exclusive(place: Place) -> Iterator[Callable[[], None]]:
    """Hold the sole right to collect into a place; yields a check that raises once it is lost.

    Raises RuntimeError while another process holds it; one that was killed holds nothing.
    """
    lock = place.sibling(f".{place.name}.lock")
    if place.is_local:
        with _flock(lock.root, place):
            yield lambda: None
    else:
        lease = _Lease(lock, place)
        lease.take()
        try:
            yield lease.check
        finally:
            lease.release()


@contextmanager
def _flock(path: str, place: Place) -> Iterator[None]:
    import fcntl

    Path(path).parent.mkdir(parents=True, exist_ok=True)
    while True:
        file = open(path, "w")  # noqa: SIM115
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            file.close()
            raise _taken(place) from error
        # Its last owner may have unlinked the file between our two calls.
        if os.path.exists(path) and os.path.samestat(os.fstat(file.fileno()), os.stat(path)):
            break
        file.close()
    try:
        yield
    finally:
        os.unlink(path)
        file.close()


class _Lease:
    """A file with its owner's name and a counter that the owner keeps raising.

    Others judge by their own clock whether it moves; no two machines' clocks are compared.
    """

    def __init__(self, lock: Place, place: Place) -> None:
        self.folder, self.place = lock, place
        self.owner, self.count = uuid.uuid4().hex, 0
        self.renewed = time.monotonic()
        self.lost = False
        self.ended = threading.Event()
        self.thread = threading.Thread(target=self._keep, daemon=True)

    def _read(self) -> bytes | None:
        return self.folder.read([_LEASE]).get(_LEASE)

    def _content(self) -> bytes:
        return json.dumps({"owner": self.owner, "count": self.count}).encode()

    def _renew(self) -> None:
        self.count += 1
        self.folder.write(_LEASE, self._content())
        self.renewed = time.monotonic()

    def take(self) -> None:
        """Take the lease, over from an owner that does not move if need be."""
        before, began = self._read(), time.monotonic()
        while before is not None and time.monotonic() - began < LEASE_S:
            time.sleep(min(RENEW_S, LEASE_S) / 5)
            now = self._read()
            if now is not None and now != before:
                raise _taken(self.place)
            before = now
        self.folder.make_folders([_LEASE])
        self._renew()
        time.sleep(SETTLE_S)
        if self._read() != self._content():
            raise _taken(self.place)
        self.thread.start()

    def _keep(self) -> None:
        while not self.ended.wait(RENEW_S):
            try:
                if self._read() != self._content():
                    self.lost = True
                    return
                self._renew()
            except Exception:
                continue  # whatever the network raises: `check` tells when it has lasted too long

    def check(self) -> None:
        """Raise RuntimeError if another may have taken the lease over."""
        if self.lost or time.monotonic() - self.renewed > LEASE_S:
            raise RuntimeError(
                f"the lock on {self.place.url} was lost: this process did not renew it for "
                f"{LEASE_S:g} s, or another removed it; collect again into the same path"
            )

    def release(self) -> None:
        """Stop renewing, and remove the file if it still is this owner's."""
        self.ended.set()
        self.thread.join()
        if self._read() == self._content():
            self.folder.delete_all()
