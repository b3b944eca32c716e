"""Writing of files and folders whole or not at all: a temporary one beside the target, files flushed to disk, then renamed."""

import os
import re
import shutil
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from stage.errors import StorageError, storage

_umask_lock = threading.Lock()
_TEMPORARY = re.compile(r"\..+\.[a-z0-9_]{8}(\.[^.]*)?")  # .STEM., eight characters of mkstemp, SUFFIX


@contextmanager
def replacing(path: str | Path, *, flush: bool = True) -> Iterator[Path]:
    """Yield the path of a temporary file, which replaces `path` when the block ends without an error and is removed otherwise.
    `flush`: whether to wait until the file is on the disk. False for a file that its reader checks and can make again: it may be damaged
    after a power failure.

    Convention:
        The temporary file lies in the same folder and has the same suffix, because writers choose a format by the suffix.
        Missing parent folders are made.
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
            if flush:
                with open(temporary, "rb") as written:
                    os.fsync(written.fileno())
            os.replace(temporary, target)
    finally:
        temporary.unlink(missing_ok=True)


def require_writable(path: Path) -> None:
    """Raise StorageError unless a file or folder can be made at a path, whose missing parents are made with it."""
    existing = path.parent
    while not existing.exists() and existing != existing.parent:
        existing = existing.parent
    if not existing.is_dir():
        raise StorageError(f"cannot write {path}: not a directory")
    if not os.access(existing, os.W_OK | os.X_OK, effective_ids=os.access in os.supports_effective_ids):
        raise StorageError(f"cannot write {path}: permission denied")


def remove_unfinished(folder: Path) -> None:
    """Remove the temporary files of `replacing` that killed processes left in a folder; nobody may be writing there."""
    with storage("write", folder):
        for path in folder.glob(".*"):
            if _TEMPORARY.fullmatch(path.name):
                path.unlink(missing_ok=True)


def write_text(path: str | Path, text: str) -> None:
    """Write a UTF-8 text file whole or not at all."""
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


@contextmanager
def folder_beside(path: str | Path) -> Iterator[Path]:
    """Yield a temporary folder beside `path`, which none but its owner reads and which is removed at the end."""
    target = Path(path).absolute()
    with storage("write", path):
        target.parent.mkdir(parents=True, exist_ok=True)
        temporary = Path(tempfile.mkdtemp(prefix=f".{target.stem}.", dir=target.parent))
    try:
        with storage("write", path):
            yield temporary
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


@contextmanager
def replacing_folder(path: Path) -> Iterator[Path]:
    """Yield an empty folder, which replaces `path` when the block ends without an error and is removed otherwise."""
    with folder_beside(path) as temporary:
        made, older = temporary / "made", temporary / "older"
        made.mkdir()
        yield made
        if path.exists():
            os.rename(path, older)
        try:
            os.rename(made, path)
        except BaseException:
            if older.exists():
                os.rename(older, path)
            raise


def resolved(path: Path) -> Path | None:
    """Return a path with its links followed, or None for a circle of links or an invalid name."""
    try:
        return path.resolve()
    except (OSError, RuntimeError, ValueError):
        return None


def _umask() -> int:
    with _umask_lock:  # reading sets it to 0 for a moment, which another thread must not take for the umask
        current = os.umask(0)
        os.umask(current)
    return current
