"""What importers share: where images lie relative to the new manifest, tables of numbers, and writing the result."""

import os
import shutil
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from stage import images
from stage.errors import ManifestError, storage
from stage.files import replacing
from stage.manifest import FILE_NAME, Manifest, write_manifest


def read_table(path: Path, columns: int) -> np.ndarray:
    """Read whitespace-separated rows of numbers.

    Returns:
        [rows, columns] float64.

    Raises:
        ManifestError: a row has another count of numbers, or one is not a finite number; names file and line.
        StorageError: the file cannot be read.
    """
    with storage("read", path):
        lines = path.read_text(encoding="utf-8", errors="replace").splitlines()
    rows = []
    for number, line in enumerate(lines, start=1):
        if not line.strip():
            continue
        try:
            row = [float(part) for part in line.split()]
        except ValueError:
            row = []
        if len(row) != columns or not np.isfinite(row).all():
            raise ManifestError(f"{path}: line {number}: {line.strip()[:60]!r} is not {columns} numbers")
        rows.append(row)
    return np.array(rows, dtype=np.float64).reshape(-1, columns)


def image_resolution(path: Path) -> tuple[int, int]:
    """Width and height of an image, from its header."""
    header = images.read_header(path)
    return header.width, header.height


def place(source: Path, destination: Path, names: Sequence[str]) -> None:
    """Put the named files of `source` into `destination`: hard links where the file system allows, else copies.

    Files that are there already with the same size and time stay; other files of the same name are not overwritten.

    Raises:
        ManifestError: a file is missing, or another file of that name is there already.
        StorageError: the file system refuses.
    """
    if source.resolve() == destination.resolve():
        return
    for name in names:
        origin, target = source / name, destination / name
        if not origin.is_file():
            raise ManifestError(f"{source}: {name} is not in the folder")
        if target.exists():
            if target.samefile(origin) or _alike(origin, target):
                continue
            raise ManifestError(f"{target}: is there already and differs from {origin}: choose another folder")
        with storage("write", target):
            target.parent.mkdir(parents=True, exist_ok=True)
            try:
                os.link(origin, target)
            except OSError:
                with replacing(target) as temporary:
                    shutil.copy2(origin, temporary)


def finish(manifest: Manifest, source: Path, destination: Path, names: Sequence[str]) -> Path:
    """Place the images and write the manifest last, so that a capture.json never names files that are not there.

    Returns:
        The path of the manifest.
    """
    place(source, destination, names)
    path = destination / FILE_NAME
    write_manifest(manifest, path)
    return path


def _alike(a: Path, b: Path) -> bool:
    first, second = a.stat(), b.stat()
    return first.st_size == second.st_size and int(first.st_mtime) == int(second.st_mtime)
