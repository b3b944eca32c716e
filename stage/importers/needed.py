"""Which files of a folder an import needs, told from their names and lengths alone: before any of them is sent to another machine."""

from collections import defaultdict
from collections.abc import Mapping
from pathlib import PurePosixPath
from typing import NamedTuple

from stage.capture.manifest import FILE_NAME
from stage.errors import ManifestError
from stage.formats import images
from stage.importers import kinect, video
from stage.importers.camera_options import words_of
from stage.importers.guess import LOOKED_FOR, POINT_FILES
from stage.importers.guess_images import FITTED, LEFT_WORDS, RIGHT_WORDS

PROJECTS = (".lp", ".relight", ".dome")
"""The endings of files that name images, which may lie in folders below."""
ARRAYS = (".npy", ".npz", ".mat")
TABLES = (".csv", ".txt", ".json", ".xml", ".yml", ".yaml")
MOST_TABLE_BYTES = 64 << 20
"""Length of the longest text that can be a table of lights or a calibration."""
MOST_CAPTURES = 100
FEWEST_IMAGES = 3
"""Images in a folder that may be a capture: phases have three."""


class Needed(NamedTuple):
    """The files of one capture."""

    folder: str
    """The folder of the capture below the one that was looked at; empty: that folder."""
    files: dict[str, str]
    """The paths of the files below the folder that was looked at, and their names in the capture."""


def needed_files(lengths: Mapping[str, int]) -> tuple[Needed, ...]:
    """Return the files of each capture in a folder: those of the folder, or of each folder in it that has images or arrays.

    Calibrations and tables of the folder above a capture come with it, where its own folder has none of their name. `lengths`: the bytes of
    each file of the folder, by its path with / between folders. Raises ManifestError if no file can be part of a capture; the sentence says
    what was looked for."""
    shown = {path: length for path, length in lengths.items() if not any(part.startswith(".") for part in path.split("/"))}
    inside: dict[str, list[str]] = defaultdict(list)
    tables: dict[str, list[str]] = defaultdict(list)
    for path, length in shown.items():
        if _is_table(path, length):
            tables[_folder(path)].append(path)
        if _is_data(path, length):
            inside[_folder(path)].append(path)
    above = {_folder(folder) for folder, paths in inside.items()
             if folder and sum(_suffix(path) in images.SUFFIXES for path in paths) >= FEWEST_IMAGES}
    captures = [folder for folder, paths in inside.items()
                if (len(paths) >= FEWEST_IMAGES or any(_suffix(path) not in images.SUFFIXES for path in paths))
                and not (folder in above and all(_suffix(path) in ARRAYS for path in paths))] or list(inside)  # tables of images below
    if not captures:
        raise ManifestError(_nothing_found(shown))
    depth = min(map(_depth, captures))
    captures = sorted(folder for folder in captures if _depth(folder) == depth)
    if len(captures) > MOST_CAPTURES:
        raise ManifestError(f"the folder holds {len(captures)} folders with images, and {MOST_CAPTURES} are taken at one time: give some "
                            "of them")
    found = []
    for folder in captures:
        chosen = [*inside[folder], *tables.get(folder, [])]
        files = {path: PurePosixPath(path).name for path in chosen}
        if any(_suffix(path) in PROJECTS for path in chosen):
            below = f"{folder}/" if folder else ""
            files |= {path: path.removeprefix(below) for path in shown
                      if path.startswith(below) and path not in files and _suffix(path) in images.SUFFIXES}
        taken = set(files.values())
        if folder:
            files |= {path: PurePosixPath(path).name for path in tables.get(_folder(folder), []) if PurePosixPath(path).name not in taken}
        found.append(Needed(folder, files))
    sides = [words_of(PurePosixPath(needed.folder).name) for needed in found]
    if any(words & LEFT_WORDS for words in sides) and any(words & RIGHT_WORDS for words in sides):
        raise ManifestError("the folder looks like images of two cameras, left and right: docs/capture.md says how other_cameras and "
                            "stereo of a capture.json name them")
    return tuple(found)


def _is_data(path: str, length: int) -> bool:
    """Return whether a file may hold the pixels or the counts of a capture, or name those that do."""
    name = PurePosixPath(path).name
    if name == FILE_NAME or FITTED.fullmatch(name):
        return False
    return (_suffix(path) in images.SUFFIXES or _suffix(path) in PROJECTS or _suffix(path) in ARRAYS
            or length == max(kinect.PACKET_BYTES))


def _is_table(path: str, length: int) -> bool:
    """Return whether a file may hold lights, planes or a calibration."""
    name, suffix = PurePosixPath(path).name, _suffix(path)
    is_p0 = "p0" in name.lower() and kinect.P0_BYTES <= length <= MOST_TABLE_BYTES and suffix not in video.SUFFIXES
    return suffix in ARRAYS or is_p0 or (suffix in TABLES and length <= MOST_TABLE_BYTES and name != FILE_NAME)


def _nothing_found(lengths: Mapping[str, int]) -> str:
    """Return the sentence about files of which none can be part of a capture."""
    for endings, words in ((video.SUFFIXES, "is a video, and its frames are images only where relit import gray or phase has unpacked it"),
                           (POINT_FILES, "holds points, which relit import scans takes")):
        if name := next((path for path in lengths if _suffix(path) in endings), None):
            return f"no capture can be made of these files: {name} {words}"
    if name := next((path for path in lengths if FITTED.fullmatch(PurePosixPath(path).name)), None):
        return (f"{name} holds coefficients that were fitted to images under lights (RTI): give those images with their light list, which "
                "relit basis fits anew")
    return f"no capture can be made of these {len(lengths)} files: looked for {LOOKED_FOR}; docs/importing.md shows them"


def _suffix(path: str) -> str:
    return PurePosixPath(path).suffix.lower()


def _folder(path: str) -> str:
    return path.rpartition("/")[0]


def _depth(folder: str) -> int:
    return len(folder.split("/")) if folder else 0
