"""thumbnails.jpg: a small picture of every frame on one sheet, all at one exposure."""

import math
from pathlib import Path

import numpy as np
import OpenImageIO as oiio

from service.viewing.capture_frames import WHITE_PERCENTILE, CaptureImages
from stage.colour import convert, pixels_of
from stage.files import replacing

CELL = 96
"""Longer side of a picture, pixels."""
MOST_BYTES = 2_000_000
"""Largest file; the quality of the JPEG is lowered until it is reached."""
QUALITIES = (88, 75, 60, 40, 20, 5)


def write_thumbnails(path: Path, found: CaptureImages, space: str) -> list[list[int] | None]:
    """Write the sheet, and return where the picture of each frame lies in it: x, y, width and height, or None where there is none.

    Args:
        path: the JPEG.
        found: the frames.
        space: scene-linear colour space of the frames.

    Raises:
        StorageError: the sheet cannot be written.
    """
    shown = [image for image in found.images if image is not None]
    rows, cols = found.inside.shape
    height, width = (max(1, round(CELL * side / max(rows, cols))) for side in (rows, cols))
    across = max(1, math.ceil(math.sqrt(len(shown) * height / width)))
    down = max(1, -(-len(shown) // across))
    sheet = np.zeros((down * height, across * width, 3), dtype=np.float32)
    white = _white(found)
    places: list[list[int] | None] = []
    for image in found.images:
        if image is None:
            places.append(None)
            continue
        row, col = divmod(sum(place is not None for place in places), across)
        places.append([col * width, row * height, width, height])
        sheet[row * height : (row + 1) * height, col * width : (col + 1) * width] = _fit(image.preview, height, width)
    encoded = convert(np.clip(sheet / white, 0, 1) if white > 0 else sheet, space, "srgb_texture")
    bytes_ = np.rint(255 * np.clip(encoded, 0, 1)).astype(np.uint8)
    for quality in QUALITIES:
        with replacing(path) as temporary:
            _write_jpeg(temporary, bytes_, quality)
        if path.stat().st_size <= MOST_BYTES:
            break
    return places


def _white(found: CaptureImages) -> float:
    """Return the radiance of white: the median over the frames of a percentile of each, so that one bright frame does not darken all."""
    whites = [float(np.percentile(image.preview[found.inside].max(axis=-1), WHITE_PERCENTILE)) for image in found.images
              if image is not None and found.inside.any()]
    lit = [white for white in whites if white > 0]
    return float(np.median(lit)) if lit else 0.0


def _fit(preview: np.ndarray, height: int, width: int) -> np.ndarray:
    """Return a preview [rows, cols, 3] with another size."""
    source = oiio.ImageBuf(np.ascontiguousarray(preview, dtype=np.float32))
    return pixels_of(oiio.ImageBufAlgo.resize(source, "triangle", roi=oiio.ROI(0, width, 0, height, 0, 1, 0, 3)))


def _write_jpeg(path: Path, pixels: np.ndarray, quality: int) -> None:
    rows, cols, _ = pixels.shape
    spec = oiio.ImageSpec(cols, rows, 3, "uint8")
    spec.attribute("Compression", f"jpeg:{quality}")
    output = oiio.ImageOutput.create(str(path))
    if output is None or not (output.open(str(path), spec) and output.write_image(pixels) and output.close()):
        raise OSError(f"{path.name}: {oiio.geterror() if output is None else output.geterror()}")
