"""Small pictures of EXR images, as a browser shows them."""

import tempfile
from pathlib import Path

import numpy as np

from stage.colour.colour import convert
from stage.errors import ImageError
from stage.formats import exr
from stage.formats.images import write_jpeg

SIDE = 512
"""Longest side of a picture, pixels."""
MOST_VALUES = 4 * 36_000_000
"""Values of a file that is decoded for a picture, in all of its channels: those of a frame of 8K with coverage."""
BACKDROP = 0.2
"""Display value of the grey behind the object, as on the page that relights."""
QUALITY = 85


def small_picture(path: Path) -> bytes:
    """Return the linear light of an EXR image as a JPEG of at most 512 × 512 pixels: clipped, encoded as sRGB, over a neutral grey.

    Raises ImageError if the file is damaged, has no R, G and B, or more than MOST_VALUES values in its channels, ColourError if its
    colours are those of no known space.
    """
    header = exr.read_header(path)
    if not {"R", "G", "B"} <= set(header.channels) or header.width * header.height * len(header.channels) > MOST_VALUES:
        raise ImageError(f"{path}: has no R, G and B, or more than {MOST_VALUES:,} values in its channels")
    channels, metadata = exr.read(path)
    step = -(-max(header.width, header.height) // SIDE)

    def reduced(plane: np.ndarray) -> np.ndarray:
        known = np.where(np.isfinite(plane), plane, 0).astype(np.float32)
        starts = [np.arange(0, side, step) for side in known.shape]
        sums = np.add.reduceat(np.add.reduceat(known, starts[0], axis=0), starts[1], axis=1)
        return np.clip(sums / np.outer(*(np.diff([*start, side]) for start, side in zip(starts, known.shape, strict=True))), 0, 1)

    colour = np.stack([reduced(channels[each]) for each in "RGB"], axis=-1).astype(np.float32)
    shown = convert(colour, exr.color_space_of(metadata), "srgb_texture")
    if "A" in channels:
        shown = shown + BACKDROP * (1 - reduced(channels["A"])[..., None])
    with tempfile.TemporaryDirectory() as folder:
        target = Path(folder) / "picture.jpg"
        write_jpeg(target, np.rint(255 * np.clip(shown, 0, 1)).astype(np.uint8), QUALITY, subsampled=True)
        return target.read_bytes()
