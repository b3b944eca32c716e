"""Scans that are in a set twice, byte by byte: they tell nothing that the first one has not told, and would make it look surer.

A scan of the same file that is said to stand elsewhere, or to have other targets, another σ or maps, is another scan.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from stage.errors import storage
from stage.results.depth_maps import DEPTH_FILE
from stage.sets.scan_set import ScanSet
from stage.stack.fingerprint import digest


class Distinct(NamedTuple):
    """A set without its duplicates."""

    scans: ScanSet
    same_as: dict[str, str]
    """The name of the scan that each duplicate repeats, by the name of the duplicate."""

    def warnings(self) -> list[str]:
        """Return a sentence for each duplicate."""
        return [f"scan {name}: is the same file as {first}, byte by byte, and counts once" for name, first in self.same_as.items()]


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


def _measured(file: Path, path: str) -> Path:
    """Return the file with the measurements of a scan."""
    place = file.parent / path
    return place / DEPTH_FILE if place.is_dir() else place
