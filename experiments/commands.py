"""Argument types and exit handling that all command lines share."""

import argparse
import functools
import inspect
import io
import signal
import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

Main = Callable[..., int]


def worker_type(text: str) -> int:
    """Read a number of processes, as an argparse `type`."""
    with suppress(ValueError):
        if 1 <= (number := int(text)) <= 256:
            return number
    raise argparse.ArgumentTypeError(f"must be a whole number from 1 to 256, got {text!r:.40}")


class _Terminated(KeyboardInterrupt):
    """Raised on SIGTERM, so that a command cleans up as it does after Ctrl-C."""


def _terminate(*_: object) -> None:
    raise _Terminated


def command(*errors: type[Exception], name: str = "") -> Callable[[Main], Main]:
    """Decorate a command's `main`, which returns its exit status.

    `errors`, Ctrl-C and SIGTERM end the command with a one-line message and status 1, 130 or 143.
    name: begins the message; by default that of the module.
    """

    def decorate(main: Main) -> Main:
        @functools.wraps(main)
        def run(*arguments: Any) -> int:
            for stream in (sys.stdout, sys.stderr):  # dots and dashes on a terminal without UTF-8
                if isinstance(stream, io.TextIOWrapper):
                    stream.reconfigure(errors="replace")
            before = signal.signal(signal.SIGTERM, _terminate)
            try:
                return main(*arguments)
            except KeyboardInterrupt as interrupt:
                print(file=sys.stderr)  # ends a progress bar
                why, code = "interrupted; finished work is kept; run it again to continue", 130
                code += 13 * isinstance(interrupt, _Terminated)
            except errors as error:
                why, code = str(error), 1
            finally:
                signal.signal(signal.SIGTERM, before)
            print(f"{name or Path(inspect.getfile(main)).stem}: {why}", file=sys.stderr)
            return code

        return run

    return decorate
