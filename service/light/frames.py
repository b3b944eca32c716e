"""Where frames go, and which of them are there already."""

import hashlib
import json
import os
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from service import __version__
from service.errors import RequestError
from stage import exr
from stage.errors import StageError, StorageError

ARITHMETIC = 1
"""Raised when frames of the same request come out otherwise, so that older ones are made anew."""
REQUEST_ATTRIBUTE = "relit:request"
"""Of a frame: the hash of all that its pixels depend on."""


def frame_path(pattern: str, number: int) -> Path:
    """Where a frame goes.

    Raises:
        RequestError: no run of # in the file name, several, or a suffix other than .exr.
    """
    folder, name = os.path.split(pattern)
    if len(re.findall(r"#+", name)) != 1 or "#" in folder:
        raise RequestError(f"--out {pattern}: the file name needs one run of # for the frame number, such as frame.####.exr")
    if not name.lower().endswith(".exr"):
        raise RequestError(f"--out {pattern}: frames are OpenEXR: end the name in .exr")
    return Path(folder) / numbered(name, number)


def numbered(name: str, number: int) -> str:
    """The name with its run of # replaced by the number, padded with zeros to the run's length."""
    return re.sub(r"#+", lambda run: f"{number:0{len(run[0])}d}", name)


def refuse_inputs(outputs: Iterable[tuple[str, Path]], inputs: Iterable[Path]) -> None:
    """Refuse to write over what is read, and one result over another.

    Args:
        outputs: (option as it was given, file) of every file that will be written.
        inputs: every file that will be read.

    Raises:
        RequestError: names the first input or result that would be replaced.
    """
    written: dict[Path, tuple[str, Path]] = {}
    for option, path in outputs:
        if (earlier := written.setdefault(path.resolve(), (option, path))) != (option, path):
            raise RequestError(f"{option}: {path} is what {earlier[0]} writes too: choose another name")
    for read in inputs:  # which may be many, of a long sequence
        if (found := written.get(read.resolve())) is not None:
            raise RequestError(f"{found[0]}: {found[1]} is an input: choose another folder or name")


def check_folders(paths: Iterable[Path]) -> None:
    """Refuse files whose folder cannot be written to, before any work is done; nothing is made.

    Raises:
        StorageError: names the first file.
    """
    folders: dict[Path, Path] = {}
    for path in paths:
        folders.setdefault(path.parent, path)
    for folder, path in folders.items():
        there = folder
        while not there.exists() and there != there.parent:
            there = there.parent
        if not there.is_dir():
            raise StorageError(f"cannot write {path}: not a directory")
        if not os.access(there, os.W_OK | os.X_OK, effective_ids=os.access in os.supports_effective_ids):
            raise StorageError(f"cannot write {path}: permission denied")


def request_hash(**parts: Any) -> str:
    """A hash of all that the pixels of a frame depend on, the version of this program among it."""
    text = json.dumps({"arithmetic": ARITHMETIC, "version": __version__, **parts}, sort_keys=True)
    return hashlib.blake2b(text.encode(), digest_size=16).hexdigest()


def is_complete(path: Path, request: str) -> bool:
    """Whether a whole frame of this request_hash lies there."""
    if not path.is_file():
        return False
    try:
        return bool(exr.read_header(path).metadata.get(REQUEST_ATTRIBUTE) == request)
    except StageError:  # not an EXR, cut short, unreadable: made anew
        return False
