"""Locks on files that are created and deleted: the lock is on the file that has the name, not on one that was deleted meanwhile."""

import fcntl
import os
from contextlib import ExitStack, suppress
from pathlib import Path


def take(path: Path, mode: int = 0o600) -> int | None:
    """Lock a file, which is created if there is none, and return its descriptor; None: another process has the lock.

    Its folder must exist, and its path must be no link. Closing the descriptor releases the lock.
    """
    while True:
        with ExitStack() as held:
            descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW, mode)
            held.callback(os.close, descriptor)
            with suppress(BlockingIOError):
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
                if not is_named(descriptor, path):  # the file was deleted or moved between the two calls
                    continue
                held.pop_all()
                return descriptor
            return None


def is_named(descriptor: int, path: Path) -> bool:
    """Return whether the file of a descriptor still has the name `path`."""
    try:
        return os.path.samestat(os.fstat(descriptor), path.stat(follow_symlinks=False))
    except FileNotFoundError:
        return False
