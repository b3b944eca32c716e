"""Locks on files that come and go: whoever has the lock has it on the file that bears the name, not on one that was removed meanwhile."""

import fcntl
import os
from pathlib import Path


def take(path: Path, mode: int = 0o600) -> int | None:
    """Lock a file, which is made where there is none; its folder must be there.

    Args:
        path: of the file; no link.
        mode: of a file that is made.

    Returns:
        Its descriptor, open for reading and writing, whose closing lets go; None: another has the lock.

    Raises:
        OSError: the file cannot be opened.
    """
    while True:
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW, mode)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if is_named(descriptor, path):
                return descriptor
        except BlockingIOError:
            os.close(descriptor)
            return None
        except BaseException:
            os.close(descriptor)
            raise
        os.close(descriptor)  # it was removed, or moved, between our two calls


def is_named(descriptor: int, path: Path) -> bool:
    """Whether the file of a descriptor still bears the name."""
    try:
        return os.path.samestat(os.fstat(descriptor), path.stat(follow_symlinks=False))
    except FileNotFoundError:
        return False
