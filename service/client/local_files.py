"""Local files that are to be uploaded: their names, sizes and hashes."""

import hashlib
import os
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

from service.client.errors import FileError
from service.client.transfer import PIECE_BYTES, TransferProgress


class LocalFile(NamedTuple):
    """One file to upload."""

    path: Path
    name: str
    """Path below the uploaded folder, with / between folders."""
    size: int
    sha256: str
    """Hexadecimal."""


@contextmanager
def file_errors(path: Path, action: str = "read") -> Iterator[None]:
    """Raise a FileError, which says that `action` failed for `path`, in place of an OSError of the body."""
    try:
        yield
    except OSError as error:
        raise FileError(f"cannot {action} {path}: {(os.strerror(error.errno) if error.errno else str(error)).lower()}") from error


def files_of(path: Path) -> list[tuple[Path, str]]:
    """Return the file, or all files below the folder, with their names in an upload, sorted by name.

    Files and folders whose names begin with a dot are left out. A FileError names what cannot be sent: a folder without files, a link that
    leads out of it or to a folder, or something else that is no file.
    """
    if path.is_file():
        return [(path, path.name)]
    if not path.is_dir():
        raise FileError(f"{path}: there is no such file or folder")
    found = sorted(_below(path, "", path.resolve()), key=lambda one: one[1])
    if not found:
        raise FileError(f"{path}: has no files")
    return found


def hash_files(files: list[tuple[Path, str]], *, parallel: int, progress: TransferProgress) -> list[LocalFile]:
    """Return the sizes and hashes of files, which are read in several threads."""
    with ThreadPoolExecutor(parallel) as pool:
        return list(pool.map(lambda one: _hash_file(one[0], one[1], progress), files))


def hash_of_all(files: list[LocalFile]) -> str:
    """Return one hash of the names, sizes and contents of files, which does not depend on the folder they are in."""
    whole = hashlib.sha256()
    for file in files:
        whole.update(f"{file.name}\0{file.size}\0{file.sha256}\n".encode())
    return whole.hexdigest()


def _hash_file(path: Path, name: str, progress: TransferProgress) -> LocalFile:
    digest, size = hashlib.sha256(), 0
    with file_errors(path), open(path, "rb", buffering=0) as file:
        while piece := file.read(PIECE_BYTES):
            digest.update(piece)
            size += len(piece)
            progress.add(len(piece))
    return LocalFile(path, name, size, digest.hexdigest())


def _below(folder: Path, before: str, root: Path) -> Iterator[tuple[Path, str]]:
    with file_errors(folder):
        entries = [entry for entry in os.scandir(folder) if not entry.name.startswith(".")]
    for entry in entries:
        path = Path(entry.path)
        if path.is_dir() and path.is_symlink():
            raise FileError(f"{path}: is a link to a folder: put the folder itself there")
        if path.is_dir():
            yield from _below(path, f"{before}{entry.name}/", root)
            continue
        if path.is_symlink() and not _leads_below(path, root):
            raise FileError(f"{path}: is a link that leads out of {root}: put the file itself there")
        if not path.is_file():
            raise FileError(f"{path}: is no file")
        yield path, before + entry.name


def _leads_below(link: Path, root: Path) -> bool:
    try:
        return link.resolve().is_relative_to(root)
    except (OSError, RuntimeError):  # links in a circle
        return False
