"""A contact sheet of the frames, through the display transform, for review."""

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from service.demo.preview import display, fit, read_frame, write_sheet

TILE = 180
"""Height of one frame on the sheet, pixels."""
MOST = 60
"""Frames on a sheet; of more, evenly chosen ones are shown, the first among them."""


def contact_sheet(path: Path, frames: Sequence[Path]) -> None:
    """Write the sheet: the frames as they are, at the exposure that they were made with.

    Args:
        path: the PNG.
        frames: EXR files, in order.

    Raises:
        StorageError: the sheet cannot be written, or a frame cannot be read.
        ImageError: a frame is damaged.
    """
    shown = [frames[i] for i in np.linspace(0, len(frames), min(MOST, len(frames)), endpoint=False).astype(int)]
    tiles = []
    for frame in shown:
        pixels, space = read_frame(frame)
        # in linear light, and before the display transform: that is the slow part
        tiles.append((frame.stem, display(fit(pixels, TILE, kernel="triangle"), space)))
    across = max(1, math.ceil(math.sqrt(len(tiles) * TILE / max(tiles[0][1].shape[1], 1) * 16 / 9)))  # as wide as a screen
    write_sheet(path, [tiles[begin : begin + across] for begin in range(0, len(tiles), across)], height=TILE)
