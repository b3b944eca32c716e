"""Arrays as sensors and programs write them: .npy, .npz, .mat, .json and raw .bin files."""

import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from fnmatch import fnmatch
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np

from stage import inputs
from stage.errors import ManifestError, StorageError, storage
from stage.folders import natural_order
from stage.formats.mat_file import read_mat_arrays
from stage.importers.layout import read_json
from stage.tof.raw_frames import read_array

SUFFIXES = (".npy", ".npz", ".mat", ".json", ".bin", ".raw", ".dat")
RAW = (".bin", ".raw", ".dat")
"""Suffixes of files that are numbers alone, whose shape and type are told."""
LEAST_NUMBERS, SAMPLE = 1000, 65536
"""Numbers of a raw file that tell the order of their bytes, and how many of them are compared."""
ROUGHER = 1.25
"""How much rougher whole numbers are in one order of bytes than in the other from which on they are of the other one: what varies least
from neighbour to neighbour are the high bytes, and right files are not rougher by more than 1.01."""
LOW_BYTES, DIFFERENT = 0.1, 10
"""Share of the numbers whose lowest byte is not 0 below which, and number of different ones above which, the bytes are of the other
order."""
LARGEST = 1e15
"""Largest size, and its inverse the least, of a number that a sensor writes."""


@dataclass(frozen=True, kw_only=True)
class ArrayFiles:
    """Names that choose the array files of a folder, and their layout where the files do not state it."""

    files: str | None = None
    """The names of the files, as the shell matches them; None: every file with one of SUFFIXES but capture.json."""
    variables: tuple[str, ...] = ()
    """The variables of .mat and .npz files, and the places in .json files (keys and numbers with points between, as 0.hists); none: the
    only array in the file."""
    dtype: str | None = None
    """The type of the numbers of raw files, as NumPy has it: uint16, float32, >i2."""
    size: tuple[int, int] | None = None
    """The width and height of an image of a raw file, or of the pixels of an array that has them in one row."""

    def names(self, folder: Path) -> list[str]:
        """Return the names of the files in natural order."""
        with storage("read", folder):
            found = natural_order(
                path.name for path in folder.iterdir() if not path.name.startswith(".") and path.name != "capture.json" and path.is_file()
                and (path.suffix.lower() in SUFFIXES if self.files is None else fnmatch(path.name, self.files)))
        if not found:
            what = f"that {self.files} names" if self.files else f"with one of the suffixes {', '.join(SUFFIXES)}"
            raise ManifestError(f"{folder}: holds no file {what}: give --arrays")
        return found

    def read(self, path: Path) -> list[np.ndarray]:
        """Return the arrays of a file, one for each of `variables`, or the only one."""
        suffix = path.suffix.lower()
        if suffix == ".npy":
            return [read_array(path)]
        if suffix in RAW:
            return [self._raw(path)]
        if suffix == ".json":
            data = read_json(path)
            return [_at(path, data, name) for name in self.variables or ("",)]
        arrays = _npz(path) if suffix == ".npz" else read_mat_arrays(path)
        return [arrays[name] for name in _chosen(path, arrays, self.variables)]

    def _raw(self, path: Path) -> np.ndarray:
        """Return the images of a raw file: [images, rows, cols]."""
        if self.dtype is None or self.size is None:
            raise ManifestError(f"{path}: is raw numbers: give their --dtype, such as uint16, and the --size of an image, such as 320x240")
        try:
            kind = np.dtype(self.dtype)
        except TypeError as error:
            raise ManifestError(f"--dtype {self.dtype}: is no type of numbers: give uint16, int16, float32 or such") from error
        if kind.kind not in "iuf":
            raise ManifestError(f"--dtype {self.dtype}: is no type of real numbers")
        content = inputs.read_bytes(path)
        width, height = self.size
        one = width * height * kind.itemsize
        if not content or len(content) % one:
            raise ManifestError(f"{path}: has {len(content)} bytes, which is no whole number of images of {width}x{height} {kind} "
                                f"({one} bytes)")
        values = np.frombuffer(content, kind)
        other = values.view(kind.newbyteorder())
        if len(values) >= LEAST_NUMBERS and (_misread(values, other) if kind.kind == "f" else
                                             _rougher(values, other, (1, width, width * height))):
            raise ManifestError(f"--dtype {self.dtype}: the numbers of {path} are {other.dtype.str}, in the other order of their bytes, in "
                                f"which neighbours are alike: give --dtype '{other.dtype.str}'")
        return values.reshape(-1, height, width)


def _misread(values: np.ndarray, other: np.ndarray) -> bool:
    """Return whether most numbers of floating point are of no measurement, and in the other order of bytes all are."""
    def measured(numbers: np.ndarray) -> float:
        size = np.abs(numbers[numbers != 0])
        return float(((size > 1 / LARGEST) & (size < LARGEST)).mean()) if len(size) else 1.0

    return measured(values) < 0.5 and measured(other) == 1


def _rougher(values: np.ndarray, other: np.ndarray, steps: tuple[int, ...]) -> bool:
    """Return whether neighbours at one of the distances differ less, beside any two numbers, in the other order of bytes; or whether the
    lowest byte is 0 in most numbers and different in others, as of counts of which few are above 255."""
    low = values[values != 0] & 0xff
    if len(low) and (low != 0).mean() < LOW_BYTES and len(np.unique(low)) > DIFFERENT:
        return True
    random = np.random.default_rng(0)

    def rough(numbers: np.ndarray) -> float:
        one, any_other = (numbers[random.integers(len(numbers), size=SAMPLE)].astype(np.float64) for _ in range(2))
        apart = max(float(np.abs(one - any_other).mean()), 1e-300)
        place = random.integers(len(numbers), size=SAMPLE)
        return min(float(np.abs(numbers[inside].astype(np.float64) - numbers[inside + step]).mean()) / apart
                   for step in steps if len(inside := place[place + step < len(numbers)]))

    def unsigned(numbers: np.ndarray) -> np.ndarray:  # signs of exchanged bytes heap the numbers at two ends
        return numbers.view(numbers.dtype.str.replace("i", "u"))

    return min(rough(values), rough(unsigned(values))) > ROUGHER * max(rough(other), rough(unsigned(other)))


def _chosen(path: Path, arrays: dict[str, np.ndarray], wanted: Sequence[str]) -> Sequence[str]:
    if not wanted:
        wanted = [name for name, value in arrays.items() if value.ndim >= 2 and min(value.shape) > 1]
        if len(wanted) != 1:
            raise ManifestError(f"{path}: holds {', '.join(arrays) or 'no array'}: name the arrays with --variable")
    for name in wanted:
        if name not in arrays:
            raise ManifestError(f"{path}: holds no array {name}, but {', '.join(arrays) or 'none at all'}")
    return wanted


def _npz(path: Path) -> dict[str, np.ndarray]:
    try:
        with storage("read", path), np.load(path, allow_pickle=False) as found:
            return {name: found[name] for name in found.files}
    except StorageError:
        raise
    except (ValueError, KeyError, EOFError, OSError, RuntimeError, BadZipFile, zlib.error, MemoryError) as error:
        raise ManifestError(f"{path}: is no whole .npz file of numbers") from error


def _at(path: Path, data: Any, place: str) -> np.ndarray:
    """Return the array at a place of a JSON file."""
    for part in place.split(".") if place else ():
        if isinstance(data, dict) and part in data:
            data = data[part]
        elif isinstance(data, list) and part.isdecimal() and int(part) < len(data):
            data = data[int(part)]
        else:
            held = f"the keys {', '.join(map(str, data))[:200]}" if isinstance(data, dict) else (
                f"a list of {len(data)}" if isinstance(data, list) else "a value")
            raise ManifestError(f"{path}: --variable {place}: there is no {part} in {held}")
    try:
        found = np.array(data, dtype=np.float64)
    except (ValueError, TypeError, OverflowError) as error:
        held = f": the keys are {', '.join(map(str, data))[:200]}" if isinstance(data, dict) else ""
        where = f" at {place}" if place else ""
        raise ManifestError(f"{path}: holds no array of numbers{where}: say with --variable where it is{held}") from error
    if np.all(found == np.rint(found)) and found.size and np.abs(found).max() < 2**31:
        return found.astype(np.int32)
    return found
