"""Waiting for another thread or process."""

import time


def wait_until(condition, seconds=60.0, process=None, otherwise="waited in vain"):
    end = time.monotonic() + seconds
    while not condition():
        assert process is None or process.poll() is None, process.communicate()
        assert time.monotonic() < end, otherwise
        time.sleep(0.02)
