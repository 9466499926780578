"""What several tests need: other processes, waiting for them or for threads, damage, full disks."""

import errno
import signal
import subprocess
import sys
import time


def start(command, **options):
    """Start a process as in a terminal: Ctrl-C reaches it, which background jobs ignore."""
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "stdin": subprocess.DEVNULL}
    options |= {"preexec_fn": lambda: signal.signal(signal.SIGINT, signal.SIG_DFL)}
    return subprocess.Popen(command, start_new_session=True, text=True, **pipes, **options)


def printed(code, **options):
    """What Python code prints in another process, in which nothing may fail or warn."""
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, capture_output=True, text=True, **options)
    assert (done.returncode, done.stderr) == (0, ""), done.stderr
    return done.stdout


def flipped(content, at, bit=0):
    """Bytes of which one bit is changed."""
    changed = bytearray(content)
    changed[at] ^= 1 << int(bit)
    return bytes(changed)


def no_room(*_):
    raise OSError(errno.ENOSPC, "No space left on device")


def wait_until(condition, seconds=60.0, process=None, otherwise="waited in vain"):
    end = time.monotonic() + seconds
    while not condition():
        assert process is None or process.poll() is None, process.communicate()
        assert time.monotonic() < end, otherwise
        time.sleep(0.02)
