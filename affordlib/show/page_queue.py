"""What a page asks of Python is done one after the other, in the background."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor


class PageQueue:
    """A thread for what a page asks for, so that the next click is heard meanwhile.

    say: is told, in words, what did not work; `last`: the future of what was asked for last.
    """

    def __init__(self, say: Callable[[str], None]) -> None:
        self._say, self._thread = say, ThreadPoolExecutor(1)
        self.last: Future | None = None

    @staticmethod
    def page_waits() -> bool:
        """Whether this is called for a page, whose messages come by an event loop."""
        try:
            asyncio.get_running_loop()
        except RuntimeError:
            return False
        return True

    def do(self, action: Callable[[], None]) -> None:
        """Do what is asked for: now in a script, for a page after all that it has asked before."""
        if self.page_waits():
            self.put(action)
        else:
            self.attempt(action)

    def put(self, action: Callable[[], None], after_s: float = 0.0) -> None:
        """Do it in the background, and not before so many seconds."""
        if after_s:
            timer = threading.Timer(after_s, self.put, [action])
            timer.daemon = True
            timer.start()
        else:
            self.last = self._thread.submit(self.attempt, action)

    def attempt(self, action: Callable[[], None]) -> None:
        """Do it now, and say what did not work."""
        try:
            action()
        except Exception as error:
            self._say(str(error) or type(error).__name__)
