"""Scans that are in a set twice, byte by byte or as point sets that were written anew in another format, unit or order, or thinned: they
tell nothing that the first one has not told, and would make it look surer.

A scan of the same points that is said to stand elsewhere, or to have other targets, another σ or maps, is another scan.
"""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial import KDTree

from service.scans.points.ply_points import read_ply_points, vertices_of
from stage.errors import storage
from stage.results.depth_maps import DEPTH_FILE
from stage.sets.scan_set import UNITS_M, ScanEntry, ScanSet
from stage.stack.fingerprint import digest

COMPARED = 1000
"""About how many points of a set must be points of the other, beside the bounds of both."""
ROUNDING = 1e-5
"""Distance, in the largest coordinate, up to which two points are one that was rounded: six digits are kept. Noise is larger."""


class Distinct(NamedTuple):
    """A set without its duplicates."""

    scans: ScanSet
    same_as: dict[str, str]
    """The name of the scan that each duplicate repeats, by the name of the duplicate."""

    def warnings(self) -> list[str]:
        """Return a sentence for each duplicate."""
        return [f"scan {name}: holds no points but those of {first}, and counts once" for name, first in self.same_as.items()]


def distinct(file: Path, listed: ScanSet) -> Distinct:
    """Return a set, whose file is given, without the scans that are an earlier one under another name."""
    same_as: dict[str, str] = {}
    for numbers in _alike(file, listed):
        first: dict[tuple[str, str], str] = {}
        for number in numbers:
            entry = listed.scans[number]
            name = first.setdefault((digest(_measured(file, entry.path)), entry.model_dump_json(exclude={"name", "path"})), entry.name)
            if name != entry.name:
                same_as[entry.name] = name
    same_as |= _written_anew(file, [entry for entry in listed.scans if entry.name not in same_as])
    if not same_as:
        return Distinct(listed, {})
    kept = [number for number, entry in enumerate(listed.scans) if entry.name not in same_as]
    table = listed.turntable
    if table is not None and table.angles_deg is not None:
        table = table.model_copy(update={"angles_deg": tuple(table.angles_deg[number] for number in kept)})
    return Distinct(listed.model_copy(update={"scans": tuple(listed.scans[number] for number in kept), "turntable": table}), same_as)


def _alike(file: Path, listed: ScanSet) -> Iterator[list[int]]:
    """Yield the numbers of scans whose files have one size; what is no file is left to those who read it."""
    by_size: dict[int, list[int]] = {}
    for number, entry in enumerate(listed.scans):
        with storage("read", file.parent / entry.path):
            if (path := _measured(file, entry.path)).is_file():
                by_size.setdefault(path.stat().st_size, []).append(number)
    return (numbers for numbers in by_size.values() if len(numbers) > 1)


def _written_anew(file: Path, entries: Sequence[ScanEntry]) -> dict[str, str]:
    """Return which point sets have no points but those of another one, which has as many and is earlier, or has more; by their names."""
    alike: dict[str, list[ScanEntry]] = {}
    for entry in entries:
        if (path := file.parent / entry.path).suffix.lower() == ".ply" and path.is_file():
            alike.setdefault(entry.model_dump_json(exclude={"name", "path", "unit"}), []).append(entry)
    same_as: dict[str, str] = {}
    for several in alike.values():
        by_size = sorted(several, key=lambda entry: -vertices_of(file.parent / entry.path)) if len(several) > 1 else []
        left = [_Some.of(file, entry) for entry in by_size]
        while left:
            whole, *left = left
            within = [part for part in left if part.within(whole)]
            points = _points(file, whole.entry) if within else whole.points
            parts = {part.entry.name for part in within if part.is_part_of(points)}
            same_as |= dict.fromkeys(parts, whole.entry.name)
            left = [part for part in left if part.entry.name not in parts]
    return same_as


class _Some(NamedTuple):
    """Some of the points of a set, and the bounds of all."""

    entry: ScanEntry
    points: np.ndarray  # [n, 3] metres
    bounds: np.ndarray  # [2, 3] metres
    rounding: float  # metres

    @classmethod
    def of(cls, file: Path, entry: ScanEntry) -> "_Some":
        points = _points(file, entry)
        return cls(entry, points[::max(len(points) // COMPARED, 1)], np.stack([points.min(axis=0), points.max(axis=0)]),
                   ROUNDING * float(np.abs(points).max()))

    def within(self, whole: "_Some") -> bool:
        """Return whether the bounds lie in those of another set."""
        return bool((self.bounds[0] >= whole.bounds[0] - self.rounding).all() and (self.bounds[1] <= whole.bounds[1] + self.rounding).all())

    def is_part_of(self, points: np.ndarray) -> bool:
        """Return whether the points are points of another set; a few are looked for first, because most sets have not even these."""
        few = self.points[::max(len(self.points) // 3, 1)]
        return all((np.abs(points - point) <= self.rounding).all(axis=1).any() for point in few) and \
            bool(KDTree(points).query(self.points)[0].max() <= self.rounding)


def _points(file: Path, entry: ScanEntry) -> np.ndarray:
    """Return the points of a set, [n, 3] metres."""
    return read_ply_points(file.parent / entry.path).points * UNITS_M[entry.unit]


def _measured(file: Path, path: str) -> Path:
    """Return the file with the measurements of a scan."""
    place = file.parent / path
    return place / DEPTH_FILE if place.is_dir() else place
