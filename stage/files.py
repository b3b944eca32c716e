"""Files that appear whole or not at all: a temporary name beside the target, flushed to disk, then renamed."""

import os
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from stage.errors import storage

_umask_lock = threading.Lock()


@contextmanager
def replacing(path: str | Path) -> Iterator[Path]:
    """Give a temporary path to write to; on a clean exit it takes the place of `path`, else it is removed.

    Convention:
        The temporary file lies in the same folder and keeps the suffix, so that writers which choose a format by
        suffix work. Missing parent folders are made.

    Raises:
        StorageError: the folder or file cannot be written.
    """
    target = Path(path)
    with storage("write", target):
        target.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(prefix=f".{target.stem}.", suffix=target.suffix, dir=target.parent)
        os.close(handle)
    temporary = Path(name)
    try:
        with storage("write", target):
            yield temporary
            os.chmod(temporary, 0o666 & ~_umask())
            with open(temporary, "rb") as written:
                os.fsync(written.fileno())
            os.replace(temporary, target)
    finally:
        temporary.unlink(missing_ok=True)


def write_text(path: str | Path, text: str) -> None:
    """Write a small UTF-8 file whole or not at all."""
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def resolved(path: Path) -> Path | None:
    """Where a path leads, links followed; None where it leads nowhere: in a circle, or to a name that cannot be."""
    try:
        return path.resolve()
    except (OSError, RuntimeError, ValueError):
        return None


def _umask() -> int:
    with _umask_lock:  # reading sets it to 0 for a moment, which another thread must not take for the umask
        current = os.umask(0)
        os.umask(current)
    return current
