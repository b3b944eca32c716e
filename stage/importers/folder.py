"""A folder whose layout is looked for: its names and images, and what is said of it."""

import shlex
from collections import Counter
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import NamedTuple, TypeVar

import numpy as np

from stage.capture.manifest import FILE_NAME
from stage.errors import StageError, storage
from stage.formats.mat_file import read_mat_arrays
from stage.importers.layout import assumed_encoding, color_space_of
from stage.importers.opencv_file import read_matrices

T = TypeVar("T")

UNKNOWN_LIGHTS = " --lights unknown"
"""What ends the command of a solve that finds the lights."""


class Guess(NamedTuple):
    """The probable layout of a folder."""

    source: Path
    """The folder, or the file of it that is imported."""
    layout: str
    """The layout in words: `an object of the DiLiGenT benchmark`."""
    reason: str
    assumed: tuple[str, ...]
    """Assumptions of the command that the files do not tell."""
    arguments: tuple[str, ...]
    """The arguments of `relit import` without a folder for the capture; words in capitals are to be replaced."""
    sure: bool
    """Whether the files say all that the arguments do, but for conventions of the layout, which `assumed` names."""
    then: str
    """The command that makes the result."""
    summary: str
    """What the folder holds, for a person who has never seen a command: `96 photographs lit from 96 directions (lights.txt)`."""

    @property
    def has_unknown_lights(self) -> bool:
        """Return whether nothing says where the lights were, so that they are to be found from the images."""
        return self.then.endswith(UNKNOWN_LIGHTS)

    @property
    def command(self) -> str:
        """The command to run."""
        return shlex.join(["relit", "import", *self.arguments])


class Folder(NamedTuple):
    """The names of the files in a folder."""

    path: Path
    names: tuple[str, ...]
    pictures: tuple[str, ...]
    """Images that are neither mask nor ambient light, in natural order."""

    def with_suffix(self, *suffixes: str) -> list[Path]:
        """Return the files with one of these suffixes, and those of the folder above after them."""
        here = [self.path / name for name in self.names if Path(name).suffix.lower() in suffixes and name != FILE_NAME]
        with storage("read", self.path.parent):
            above = [path for path in sorted(self.path.absolute().parent.iterdir()) if path.suffix.lower() in suffixes and path.is_file()]
        return [*here, *above]


def made(layout: str, reason: str, words: list[object], source: Path, *, solve: bool, sure: bool = False,
         assumed: tuple[str, ...] = (), summary: str = "") -> Guess:
    """Return a guess. `solve`: whether `relit solve` makes the result; else `relit depth`."""
    program = "solve" if solve else "depth"
    return Guess(source, layout, reason, assumed, tuple(map(str, words)), sure,
                 shlex.join(["relit", program, str(source), "--out", f"{source.resolve().name}-{'maps' if solve else 'depth'}"]),
                 summary or layout)


def lit(count: int, lights: str, file: Path) -> str:
    """Return the summary of photographs under as many lights, which a file names: `lights` is `from` or `by` and their kind."""
    return f"{count} photographs lit {lights.format(count)} ({file.name})"


def tried(read: Callable[[], T]) -> T | None:
    """Return what a reader returns, or None where it refuses the file."""
    try:
        return read()
    except (StageError, ValueError):
        return None


def encoding(folder: Folder) -> list[str]:
    """Return what the import assumes of the encoding of 8-bit images, as its manifest says it."""
    space = tried(partial(color_space_of, folder.path / folder.pictures[0]))
    return [] if space is None else assumed_encoding(space)


def group_of(folder: Folder, count: int) -> list[str] | None:
    """Return the option --images that selects so many images: none if it is all, those of one spelling, or None if neither is so many."""
    if len(folder.pictures) == count:
        return []
    spelled = Counter(spelling(name) for name in folder.pictures)
    fitting = [spelling for spelling, number in spelled.items() if number == count]
    return ["--images", fitting[0]] if len(fitting) == 1 else None


def spelling(name: str) -> str:
    """Return a name with an asterisk in place of its last number: photo_*.png."""
    stem, suffix = Path(name).stem, Path(name).suffix
    return (stem.rstrip("0123456789") + "*" if stem[-1:].isdigit() else stem) + suffix


def arrays_of(path: Path) -> dict[str, np.ndarray]:
    """Return the arrays of a .mat or an OpenCV file by name; none where it cannot be read."""
    return tried(partial(read_mat_arrays if path.suffix.lower() == ".mat" else read_matrices, path)) or {}
