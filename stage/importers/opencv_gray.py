"""Import of images in the order of OpenCV's GrayCodePattern, with an optional OpenCV calibration file.

The order is every bit of the columns, coarsest first, each followed by its inverse; the rows in the same way; then white and black.
"""

from pathlib import Path
from typing import Any

from stage.errors import ManifestError
from stage.importers.layout import image_names, image_resolution, write_capture
from stage.importers.patterns import camera_and_projector
from stage.importers.sequences import GrayStack
from stage.manifest import SCHEMA


def import_folder(source: Path, destination: Path, *, projector: tuple[int, int], calibration: Path | None = None,
                  unit_m: float = 1.0) -> Path:
    """Write a capture.json for a Gray-code scan.

    Args:
        source: the folder of the images, which are taken in the natural order of their names: 2 before 10.
        destination: the folder of the capture; another folder than `source` gets links to, or copies of, the images.
        projector: the width and height of the projector in pixels, which determine the count of bits.
        calibration: an OpenCV file with the intrinsics of camera and projector, R and T; None leaves them to `relit calibrate procam`, and
            the manifest has the size of the projector alone.
        unit_m: the metres in one unit of T.

    Returns:
        The path of the manifest.

    Raises:
        ManifestError: the count of images does not fit the projector, or the calibration file lacks a matrix.
    """
    names = image_names(source)
    patterns = gray_order(*projector)
    if len(names) != len(patterns):
        raise ManifestError(f"{source}: holds {len(names)} images, a projector of {projector[0]}x{projector[1]} px takes {len(patterns)}: "
                            "columns and rows with inverses, white, black")
    resolution = image_resolution(source / names[0])
    data: dict[str, Any] = {
        "schema": SCHEMA, "name": source.resolve().name,
        "color_space": "lin_rec709_scene",
        "camera": {"projection": "orthographic", "resolution": resolution},
        "projector": {"resolution": projector},
    }
    if calibration is not None:
        data |= camera_and_projector(calibration, resolution, projector, unit_m)
    data["frames"] = [{"image": name, "pattern": pattern} for name, pattern in zip(names, patterns, strict=True)]
    return write_capture(data, source / names[0], destination)


def gray_order(width: int, height: int) -> list[dict[str, Any]]:
    """Return the manifest entries of the patterns in the order of OpenCV's images."""
    return GrayStack().entries((width, height))
