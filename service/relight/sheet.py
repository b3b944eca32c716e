"""Pictures for review: frames through a display transform, each as a PNG, or side by side with titles on a sheet."""

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import OpenImageIO as oiio

from service.reporting.provenance import colour_configuration
from stage.colour.colour import through_view
from stage.colour.colour_spaces import Review
from stage.colour.configuration import current
from stage.files import replacing
from stage.formats import exr
from stage.formats.images import pixels_of, write_png

TILE = 320
"""Height of one picture, pixels."""
FRAME_TILE = 180
"""Height of one frame on a contact sheet, pixels."""
MOST_FRAMES = 60
"""Most frames on a contact sheet; of a longer range, evenly spaced frames are shown, beginning with the first."""
GAP, TITLE, MARGIN = 12, 26, 20
"""Pixels between two pictures, above each picture for its title, and around all pictures."""
BACKGROUND = np.array([0.055, 0.058, 0.065], dtype=np.float32)
INK = (0.82, 0.84, 0.87)
EXPOSURE_PERCENTILE = 99.0
"""This percentile of what is shown becomes EXPOSURE_TARGET before the display transform."""
EXPOSURE_TARGET = 0.8
AS_EVER = Review()
"""The view of pictures for which no other is chosen."""


def contact_sheet(path: Path, frames: Sequence[Path], review: Review = AS_EVER) -> None:
    """Write a contact sheet, a PNG, of EXR frames at the exposure that they were made with, through a view of OpenColorIO."""
    shown = [frames[i] for i in np.linspace(0, len(frames), min(MOST_FRAMES, len(frames)), endpoint=False).astype(int)]
    tiles = []
    for frame in shown:
        pixels, space = read_frame(frame, "RGBA")
        # in linear light, and before the display transform: that is the slow part
        tiles.append((frame.stem, display(fit(pixels, FRAME_TILE, kernel="triangle"), space, review)))
    across = max(1, math.ceil(math.sqrt(len(tiles) * FRAME_TILE / max(tiles[0][1].shape[1], 1) * 16 / 9)))  # as wide as a screen
    write_sheet(path, [tiles[begin : begin + across] for begin in range(0, len(tiles), across)], height=FRAME_TILE)


def display_frame(path: Path, frame: Path, review: Review) -> None:
    """Write a PNG of 8 bits of an EXR frame as a display shows it through a view of OpenColorIO, at the exposure that it was made with."""
    pixels, space = read_frame(frame)
    shown = np.rint(255 * np.clip(through_view(pixels, space, review), 0, 1)).astype(np.uint8)
    view = current().view(review.view)
    with replacing(path) as temporary:
        write_png(temporary, shown, srgb=view is None or "srgb" in view[0].lower(),  # other displays have no name in the file
                  texts=colour_configuration())


def write_sheet(path: Path, rows: Sequence[Sequence[tuple[str, np.ndarray]]], *, height: int = TILE) -> None:
    """Write (title, [rows, cols, 3] display values 0…1) of pictures, each scaled to a height in pixels, row by row as one PNG."""
    sheet = _sheet([[(title, fit(image, height)) for title, image in row] for row in rows], height)
    with replacing(path) as temporary:
        write_png(temporary, np.asarray(sheet.get_pixels(oiio.UINT8)), srgb=True, texts=colour_configuration())


def read_frame(path: Path, wanted: str = "RGB") -> tuple[np.ndarray, str]:
    """Return the wanted channels that a relit frame has, [rows, cols, channels] float32, and its colour space."""
    channels, metadata = exr.read(path)
    return np.stack([channels[c] for c in wanted if c in channels], axis=-1).astype(np.float32), exr.color_space_of(metadata)


def display(pixels: np.ndarray, space: str, review: Review = AS_EVER) -> np.ndarray:
    """Return display values, [rows, cols, 3] float32, 0…1, of scene-linear ones in a colour space, through a view of OpenColorIO.

    The background of a sheet is behind what a fourth channel, the matte of premultiplied pixels, does not cover; without it, behind black.
    """
    colour, matte = np.split(pixels, [3], axis=-1)
    covered = np.clip(matte, 0, 1) if matte.size else np.float32(1) * (colour.max(axis=-1, keepdims=True) > 0)
    shown = (1 - covered) * BACKGROUND
    lit = covered[..., 0] > 0
    if lit.any():  # the transform takes a microsecond a pixel, and most of an object's picture is black
        shown[lit] += through_view(colour[lit][None], space, review)[0]
    return shown


def exposure_of(images: np.ndarray, mask: np.ndarray) -> float:
    """Return the factor that makes the object of pictures [pictures, rows, cols, 3], where the mask [rows, cols] is true, bright."""
    if not mask.any():
        return 1.0
    return display_gain(images[:, mask].mean(axis=-1))


def display_gain(readings: np.ndarray) -> float:
    """Return the factor that makes scene-linear readings, of any shape, bright where they are displayed."""
    level = float(np.percentile(readings, EXPOSURE_PERCENTILE))
    return EXPOSURE_TARGET / level if level > 0 else 1.0


def fit(image: np.ndarray, height: int = TILE, *, kernel: str = "") -> np.ndarray:
    """Return an image [rows, cols, channels] scaled to a height; `kernel`: OpenImageIO's name of a filter, by default one that may ring."""
    rows, cols, channels = image.shape
    if rows == height:
        return image
    width = max(1, round(cols * height / rows))
    source = oiio.ImageBuf(np.ascontiguousarray(image, dtype=np.float32))
    return pixels_of(oiio.ImageBufAlgo.resize(source, kernel, roi=oiio.ROI(0, width, 0, height, 0, 1, 0, channels)))


def dome_places(directions: np.ndarray, *, side: int, reach: float, widest_degrees: float) -> np.ndarray:
    """Return where directions stand on a picture of the dome as the camera sees it: equal angles from the view axis are equal distances.

    Args:
        directions: [n, 3] unit vectors, z towards the camera.
        side: of the picture, whose middle shows the view axis, pixels.
        reach: distance of a direction at the widest angle from the middle, pixels.
        widest_degrees: that angle.

    Returns:
        [n, 2] float64 row and column, pixels.
    """
    angle = np.degrees(np.arccos(np.clip(directions[:, 2], -1, 1)))
    across = np.maximum(np.hypot(directions[:, 0], directions[:, 1]), 1e-9)
    return np.asarray(side / 2 + np.stack([-directions[:, 1], directions[:, 0]], axis=1) / across[:, None] * angle[:, None]
                      / widest_degrees * reach)


def _sheet(rows: list[list[tuple[str, np.ndarray]]], tile: int) -> oiio.ImageBuf:
    width = max(sum(image.shape[1] + GAP for _, image in row) - GAP for row in rows) + 2 * MARGIN
    height = len(rows) * (tile + TITLE + GAP) - GAP + 2 * MARGIN
    canvas = np.empty((height, width, 3), dtype=np.float32)
    canvas[:] = BACKGROUND
    titles = []
    y = MARGIN
    for row in rows:
        x = MARGIN
        for title, image in row:
            canvas[y + TITLE : y + TITLE + tile, x : x + image.shape[1]] = image
            titles.append((x, y + TITLE - 8, title))
            x += image.shape[1] + GAP
        y += TITLE + tile + GAP
    sheet = oiio.ImageBuf(canvas)
    for x, y, title in titles:
        oiio.ImageBufAlgo.render_text(sheet, x, y, title, 15, "", INK)
    return sheet
