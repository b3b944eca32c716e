"""Files of this machine that are to be sent: which, how large, and their hashes."""

import hashlib
import os
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

from service.client.errors import FileError
from service.client.tally import Tally

PIECE = 1 << 20
"""Bytes that are read at once."""


class LocalFile(NamedTuple):
    """One file to send."""

    path: Path
    name: str
    """Below the folder, / between folders."""
    size: int
    sha256: str
    """Hexadecimal."""


@contextmanager
def reading(path: Path, action: str = "read") -> Iterator[None]:
    """Turn what the file system refuses into a FileError."""
    try:
        yield
    except OSError as error:
        raise FileError(f"cannot {action} {path}: {(os.strerror(error.errno) if error.errno else str(error)).lower()}") from error


def files_of(path: Path) -> list[tuple[Path, str]]:
    """The file, or all files of the folder by name; those with a leading dot, and of folders with one, are left out.

    Raises:
        FileError: there is none, or a link leads to a folder.
    """
    if path.is_file():
        return [(path, path.name)]
    if not path.is_dir():
        raise FileError(f"{path}: there is no such file or folder")
    found = sorted(_below(path, ""), key=lambda one: one[1])
    if not found:
        raise FileError(f"{path}: has no files")
    return found


def hashed(files: list[tuple[Path, str]], *, parallel: int, tally: Tally) -> list[LocalFile]:
    """Sizes and hashes, several files at once.

    Raises:
        FileError: one cannot be read.
    """
    with ThreadPoolExecutor(parallel) as pool:
        return list(pool.map(lambda one: _hashed(one[0], one[1], tally), files))


def manifest_hash(files: list[LocalFile]) -> str:
    """A hash of names, sizes and contents: equal for equal folders, wherever they lie."""
    whole = hashlib.sha256()
    for file in files:
        whole.update(f"{file.name}\0{file.size}\0{file.sha256}\n".encode())
    return whole.hexdigest()


def _hashed(path: Path, name: str, tally: Tally) -> LocalFile:
    digest, size = hashlib.sha256(), 0
    with reading(path), open(path, "rb", buffering=0) as file:
        while piece := file.read(PIECE):
            digest.update(piece)
            size += len(piece)
            tally.add(len(piece))
    return LocalFile(path, name, size, digest.hexdigest())


def _below(folder: Path, before: str) -> Iterator[tuple[Path, str]]:
    with reading(folder):
        entries = [entry for entry in os.scandir(folder) if not entry.name.startswith(".")]
    for entry in entries:
        path = Path(entry.path)
        if entry.is_dir() and entry.is_symlink():
            raise FileError(f"{path}: is a link to a folder: put the folder itself there")
        if entry.is_dir():
            yield from _below(path, f"{before}{entry.name}/")
        else:
            yield path, before + entry.name
