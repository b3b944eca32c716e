"""Writing of files and folders whole or not at all: a temporary one beside the target, files flushed to disk, then renamed.

A temporary file or folder is locked while its process lives. The next process that writes into the same folder removes those without a
lock, which killed processes left; those of another machine, whose locks some file systems do not show, after a day.
"""

import fcntl
import os
import platform
import re
import shutil
import tempfile
import threading
import time
import zlib
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from functools import lru_cache
from pathlib import Path

from stage.errors import StorageError, storage

_umask_lock = threading.Lock()
_MARK = f"relit-{zlib.crc32(platform.node().encode()):08x}-"
_TEMPORARY = re.compile(r"\..+\.relit-[0-9a-f]{8}-[a-z0-9_]{8}(\.[^.]*)?")  # .STEM., the mark, eight characters of mkstemp, SUFFIX
_DAY_S = 86400
_FOLDERS = 1024  # whose sweep a process remembers


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

    def make() -> str:
        handle, name = tempfile.mkstemp(prefix=f".{target.stem}.{_MARK}", suffix=target.suffix, dir=target.parent)
        os.close(handle)
        return name

    with _locked(target, make) as temporary:
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


def require_writable(path: Path, *, folder: bool = False) -> None:
    """Raise StorageError unless a file, or with `folder` the files of a folder, can be made at a path, whose missing parents are made with
    it."""
    if not folder and os.path.isdir(path):  # False of names that are too long, which others refuse with a number
        raise StorageError(f"cannot write {path}: is a directory")
    existing = path if folder else path.parent
    while not existing.exists() and existing != existing.parent:
        existing = existing.parent
    if not existing.is_dir():
        raise StorageError(f"cannot write {path}: not a directory")
    if not os.access(existing, os.W_OK | os.X_OK, effective_ids=os.access in os.supports_effective_ids):
        raise StorageError(f"cannot write {path}: permission denied")


def write_text(path: str | Path, text: str) -> None:
    """Write a UTF-8 text file whole or not at all."""
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


@contextmanager
def folder_beside(path: str | Path) -> Iterator[Path]:
    """Yield a temporary folder beside `path`, which none but its owner reads and which is removed at the end."""
    with _folder(Path(path).absolute()) as temporary, storage("write", path):
        yield temporary


def temporary_folder(name: str) -> AbstractContextManager[Path]:
    """Return a temporary folder where the system has them, named after what it is for, which is removed at the end."""
    return _folder(Path(tempfile.gettempdir(), name))


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


@contextmanager
def _folder(target: Path) -> Iterator[Path]:
    with _locked(target, lambda: tempfile.mkdtemp(prefix=f".{target.stem}.{_MARK}", dir=target.parent)) as temporary:
        try:
            yield temporary
        finally:
            shutil.rmtree(temporary, ignore_errors=True)


@contextmanager
def _locked(target: Path, make: Callable[[], str]) -> Iterator[Path]:
    """Yield the temporary file or folder that is made beside a target, locked; what killed processes left there is removed first."""
    with storage("write", target):
        target.parent.mkdir(parents=True, exist_ok=True)
        _remove_unfinished(target.parent)
        while (lock := _lock(temporary := Path(make()), wait=True)) is None and not temporary.exists():
            pass  # another process took it for one that was left, before it had its lock
    try:
        yield temporary
    finally:
        if lock is not None:
            os.close(lock)


@lru_cache(_FOLDERS)
def _remove_unfinished(folder: Path) -> None:
    """Remove the temporary files and folders that killed processes left in a folder, once in the life of this one."""
    with storage("write", folder):
        for path in folder.glob(".*"):
            if _TEMPORARY.fullmatch(path.name) and (lock := _lock(path)) is not None:
                if _MARK in path.name or os.fstat(lock).st_mtime < time.time() - _DAY_S:
                    shutil.rmtree(path, ignore_errors=True) if path.is_dir() else path.unlink(missing_ok=True)
                os.close(lock)


def _lock(path: Path, *, wait: bool = False) -> int | None:
    """Lock a file or folder and return its descriptor; None: it is locked or gone, or the file system has no locks."""
    with suppress(OSError):
        descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_CLOEXEC)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
            if os.path.samestat(os.fstat(descriptor), path.stat(follow_symlinks=False)):
                return descriptor
        except OSError:
            pass
        os.close(descriptor)
    return None


def _umask() -> int:
    with _umask_lock:  # reading sets it to 0 for a moment, which another thread must not take for the umask
        current = os.umask(0)
        os.umask(current)
    return current
