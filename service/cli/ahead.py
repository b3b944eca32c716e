"""Reading the images of a capture on a second core while Python imports the solver on the first, which takes as long in a short run."""

import math
import os
import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from stage.capture import Capture
from stage.ingest import open_stack

MOST_PIXELS = 100_000_000
"""Pixels of all images of a capture that is read ahead; more may take seconds, for which a user wants to see progress."""
STANDARD_ERROR = 2
"""The file descriptor."""
THREADS = Path("/proc/self/task")
"""A folder for each thread of this process, on Linux."""
LOOKS, LOOK_S = 20, 0.001
"""Looks at the threads at most, and seconds between two."""


@contextmanager
def reading_ahead(capture: Capture, cache: Path | None) -> Iterator[None]:
    """Make the stack of a small capture in a process beside this one, which has ended when the context ends.

    It saves time and decides nothing: whoever opens the stack afterwards makes it where it is missing, and meets the fault that kept the
    other process from making it. Nothing is read ahead on one core, and where a forked process might wait for threads that it has not.

    Args:
        capture: an opened capture.
        cache: the folder of the stack, as for `stage.ingest.open_stack`.
    """
    pixels = len(capture.sources()) * math.prod(capture.image_resolution)
    if pixels > MOST_PIXELS or (os.cpu_count() or 1) < 2 or not _has_one_thread():
        yield
        return
    reader = os.fork()
    if reader == 0:
        _read(capture, cache)
    try:
        yield
    except BaseException:
        os.kill(reader, signal.SIGTERM)  # it removes what it has begun
        raise
    finally:
        os.waitpid(reader, 0)


def _has_one_thread() -> bool:
    """Return whether this process has no other thread, of Python or of a library; False where the system is not Linux, which says so.

    Threads that have ended are shown for a moment more, which is waited for.
    """
    for _ in range(LOOKS):
        if not THREADS.is_dir() or len(list(THREADS.iterdir())) == 1:
            return THREADS.is_dir()
        time.sleep(LOOK_S)
    return False


def _read(capture: Capture, cache: Path | None) -> None:
    """Make the stack, and end this process without a word."""
    try:
        os.dup2(os.open(os.devnull, os.O_WRONLY), STANDARD_ERROR)  # the libraries that decode images write there
        open_stack(capture, cache=cache)
    finally:
        os._exit(0)
