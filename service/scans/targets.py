"""Markers and boards that the images of range images show, as targets of their scans."""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from service.requests.register import RegisterOptions
from stage.colour import convert
from stage.errors import ManifestError
from stage.images import check_resolution, read_pixels
from stage.scans.found_targets import board_in, markers_in, placed
from stage.scans.records import ScanEntry
from stage.scans.scan import Scan, Target


class Looked(NamedTuple):
    """The targets of a scan, and those among them that were found in its image."""

    targets: tuple[Target, ...]
    found: int
    missed: str | None
    """Why it shows none, in words after its name; None: it shows some, or none was looked for."""


def with_found_targets(scan: Scan, entry: ScanEntry, options: RegisterOptions, file: Path, where: str) -> Looked:
    """Return the targets of a scan with the markers and board corners that its image shows.

    Args:
        scan: as it was read.
        entry: of the scan.
        options: which markers and which board to look for.
        file: the scan-set.json, which paths are relative to.
        where: what messages begin with.

    Raises:
        ManifestError: the image is not one of the scan's camera, or a target is found whose name is listed too.
        ImageError, StorageError: the image cannot be read.
    """
    if options.markers is None and options.board is None:
        return Looked(scan.targets, 0, None)
    if scan.camera is None:
        if entry.image is not None:
            raise ManifestError(f"{where}: image: {entry.path} is a set of points: an image belongs to a range image")
        return Looked(scan.targets, 0, "is a set of points: markers and boards are looked for in range images")
    if entry.image is not None:
        path = file.parent / entry.image
        check_resolution(path, scan.camera.resolution, declared="the depth")
        image = read_pixels(path).astype(np.float32).mean(axis=-1)
    elif scan.colours is not None:
        image = convert(scan.image(scan.colours).astype(np.float32) / 255, "srgb_rec709_scene", "lin_rec709_scene").mean(axis=-1)
    else:
        return Looked(scan.targets, 0, "has neither an image nor colours in which markers or a board could be found")
    points = ([] if options.markers is None else markers_in(image, options.markers.value)) + (
        [] if options.board is None else board_in(image, options.board))
    found = placed(points, scan)
    both = {target.name for target in scan.targets} & {target.name for target in found}
    if both:
        raise ManifestError(f"{where}: targets: {min(both)} is listed, and found in the image too: leave out one of them")
    missed = None if found else "no marker or board is found in its image" if not points else (
        f"{len(points)} marks are found in its image, but too few depths around them")
    return Looked((*scan.targets, *found), len(found), missed)
