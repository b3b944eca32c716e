"""Open the files of captures and environments for reading; no other module does.

Whoever owns a registered folder may replace a file in it by a link at any moment. So a file below a folder that `confined` names is found
from a descriptor of that folder, name by name, without following a link out of it (as openat2 does with RESOLVE_BENEATH), and opened once:
its checks and its decoder read the same file. Elsewhere a path is opened as the system does.
"""

import errno
import os
import stat
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from stage.errors import ImageError, ManifestError, storage

MOST_LINKS = 16
"""The most links that one name may lead through."""
FOLDER = os.O_CLOEXEC | os.O_NOFOLLOW | os.O_DIRECTORY | getattr(os, "O_PATH", os.O_RDONLY)
FILE = os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_RDONLY
"""Flags of a file that is found by its descriptor's folder; without O_NONBLOCK the opening of a pipe would wait for ever."""
OPEN_FILES = Path("/proc/self/fd")


@dataclass(frozen=True)
class Confined:
    """A folder whose files are opened without following links out of it."""

    folder: Path
    descriptor: int
    max_pixels: int | None
    """The most pixels of an image that is decoded; None for any."""


_folders: list[Confined] = []
_enclosed = False
_lock = threading.Lock()


@dataclass(frozen=True)
class Source:
    """An open file."""

    path: Path
    """The path as it was given, for messages."""
    file: BinaryIO
    confined: bool
    """True if it lies in a folder that `confined` names."""
    max_pixels: int | None

    @contextmanager
    def reopened(self) -> Iterator[str]:
        """Yield a path with the same suffix under which a library opens the same file, whatever the path leads to meanwhile."""
        text = str(self.path)
        if (not self.confined and text.isprintable()) or not OPEN_FILES.exists():
            yield text  # libraries take no names that are not text
            return
        with tempfile.TemporaryDirectory(prefix="relit-") as folder:
            link = os.path.join(folder, f"image{self.path.suffix}")
            os.symlink(OPEN_FILES / str(self.file.fileno()), link)
            yield link

    def check_pixels(self, width: int, height: int) -> None:
        """Check that an image may be decoded."""
        if self.max_pixels is not None and width * height > self.max_pixels:
            raise ImageError(f"{self.path}: has {width}x{height} pixels, {self.max_pixels} are allowed")


@contextmanager
def confined(folder: Path, root: Path, *, max_pixels: int | None = None) -> Iterator[None]:
    """Open the files below a folder, in all threads of this process, without following links out of it.
    `folder`: below `root`, or `root`; no part of its path below `root` may be a link. `root`: a folder that is trusted, links in its path
    included. `max_pixels`: the most pixels of an image that is decoded; None for any. Raises ManifestError if the folder is a link, or
    leads through one."""
    with storage("read", folder):
        top = os.open(root, os.O_CLOEXEC | os.O_DIRECTORY | getattr(os, "O_PATH", os.O_RDONLY))
        try:
            for part in folder.relative_to(root).parts:
                try:
                    inner = os.open(part, FOLDER, dir_fd=top)
                except OSError as error:
                    if error.errno in (errno.ELOOP, errno.ENOTDIR):
                        raise ManifestError(f"{folder}: is no folder, or a link leads to it") from error
                    raise
                os.close(top)
                top = inner
        except BaseException:
            os.close(top)
            raise
    held = Confined(folder, top, max_pixels)
    with _lock:
        _folders.append(held)
    try:
        yield
    finally:
        with _lock:
            _folders.remove(held)
        os.close(top)


def enclose() -> None:
    """Open files in confined folders alone, from now on: what was uploaded names files, and this process reads for whoever did."""
    global _enclosed
    _enclosed = True


def is_allowed(path: Path) -> bool:
    """Return whether this process opens files at a path, which need not exist."""
    return not _enclosed or _folder_of(path) is not None


def is_file(path: Path) -> bool:
    """Return whether this process opens files at a path and there is one; where it opens none, nothing is looked for."""
    return is_allowed(path) and path.is_file()


@contextmanager
def opened(path: str | Path) -> Iterator[Source]:
    """Open a file for reading. Raises ManifestError if the path leads out of a confined folder."""
    given = Path(path)
    folder = _folder_of(given)
    if folder is None and _enclosed:
        raise ManifestError(f"{given}: leads out of the folder")
    with storage("read", given):
        if folder is None:
            file: BinaryIO = open(given, "rb")  # noqa: SIM115 - it is closed below
        else:
            file = os.fdopen(_beneath(folder, given), "rb")
    with file:
        yield Source(given, file, folder is not None, None if folder is None else folder.max_pixels)


def read_bytes(path: str | Path) -> bytes:
    """Return the content of a file."""
    with opened(path) as source, storage("read", path):
        return source.file.read()


def _folder_of(path: Path) -> Confined | None:
    """Return the innermost confined folder that a path lies in."""
    if not _folders:
        return None
    whole = Path(os.path.abspath(path))
    with _lock:
        found = [folder for folder in _folders if whole.is_relative_to(folder.folder)]
    return max(found, key=lambda folder: len(folder.folder.parts), default=None)


def _beneath(confined: Confined, path: Path) -> int:
    """Return the descriptor of a regular file below a folder; links are followed as far as they stay in the folder."""
    def outside() -> ManifestError:
        return ManifestError(f"{path}: leads out of the folder")

    waiting = list(reversed(Path(os.path.abspath(path)).relative_to(confined.folder).parts))
    folders, links = [os.dup(confined.descriptor)], 0
    try:
        while waiting:
            part = waiting.pop()
            if part == os.pardir:
                if len(folders) == 1:
                    raise outside()
                os.close(folders.pop())
                continue
            try:
                descriptor = os.open(part, FOLDER if waiting else FILE, dir_fd=folders[-1])
            except OSError as error:
                target = _link(part, folders[-1]) if error.errno in (errno.ELOOP, errno.ENOTDIR) else None
                if target is None:
                    raise
                links += 1
                if target.is_absolute() or links > MOST_LINKS:
                    raise outside() from error
                waiting += reversed(target.parts)
                continue
            if waiting:
                folders.append(descriptor)
            elif stat.S_ISREG(os.fstat(descriptor).st_mode):
                return descriptor
            else:
                os.close(descriptor)
        raise ManifestError(f"{path}: is no file")
    finally:
        for descriptor in folders:
            os.close(descriptor)


def _link(name: str, folder: int) -> Path | None:
    """Return where a link leads, or None if the name is no link."""
    try:
        return Path(os.readlink(name, dir_fd=folder))
    except OSError:
        return None
