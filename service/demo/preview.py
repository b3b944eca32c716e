"""One picture of what was made: captured, normals, albedo, height, and the relit frames, side by side."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import OpenImageIO as oiio

from stage import exr
from stage.colour import CONFIG, convert, pixels_of
from stage.errors import StorageError
from stage.files import replacing
from stage.maps import SurfaceMaps

TILE = 320
"""Height of one picture, pixels."""
GAP, TITLE, MARGIN = 12, 26, 20
BACKGROUND = np.array([0.055, 0.058, 0.065], dtype=np.float32)
INK = (0.82, 0.84, 0.87)
EXPOSURE_PERCENTILE = 99.0
"""Of the object's luminance: this reading becomes EXPOSURE_TARGET before the display transform."""
EXPOSURE_TARGET = 0.8
DISPLAY, VIEW = "sRGB - Display", "ACES 2.0 - SDR 100 nits (Rec.709)"


def write_preview(path: Path, maps: SurfaceMaps, captured: np.ndarray, frames: Sequence[Path]) -> None:
    """Write preview.png.

    Args:
        path: the PNG.
        maps: solved maps.
        captured: [rows, cols, 3] scene-linear, one captured image.
        frames: relit EXR frames; two rows of them, evenly chosen, are shown.

    Raises:
        StorageError: the picture cannot be written.
    """
    mask = maps.mask
    top = [("captured, one light", display(captured * _exposure(captured[None], mask), maps.color_space))]
    if maps.normal is not None:
        top.append(("normals", np.where(mask[..., None], 0.5 + 0.5 * maps.normal, BACKGROUND)))
    if maps.diffuse_albedo is not None:
        albedo = convert(np.clip(maps.diffuse_albedo, 0, 1).astype(np.float32), maps.color_space, "srgb_rec709_scene")
        top.append(("diffuse albedo", np.where(mask[..., None], albedo, BACKGROUND)))
    if maps.roughness is not None:
        grey = np.repeat(maps.roughness.astype(np.float32)[..., None], 3, axis=-1)
        top.append(("roughness", np.where(mask[..., None], grey, BACKGROUND)))
    if maps.height is not None:
        top.append(("height", _relief(maps.height, mask)))
    count = min(2 * len(top), len(frames))
    shown = [frames[i] for i in np.linspace(0, len(frames), count, endpoint=False).astype(int)]
    relit = [read_frame(frame)[0] for frame in shown]
    exposure = _exposure(np.stack(relit), mask)
    bottom = [(f"relit, {frame.stem}", display(pixels * exposure, maps.color_space))
              for frame, pixels in zip(shown, relit, strict=True)]
    write_sheet(path, [row for row in (top, bottom[: len(top)], bottom[len(top) :]) if row])


def write_sheet(path: Path, rows: Sequence[Sequence[tuple[str, np.ndarray]]], *, height: int = TILE) -> None:
    """Write pictures with titles, row by row, as one PNG.

    Args:
        path: the PNG.
        rows: (title, [rows, cols, 3] display values 0…1) of each picture.
        height: that each picture is scaled to, pixels.

    Raises:
        StorageError: the picture cannot be written.
    """
    _write(path, _sheet([[(title, fit(image, height)) for title, image in row] for row in rows], height))


def read_frame(path: Path) -> tuple[np.ndarray, str]:
    """A relit frame.

    Returns:
        [rows, cols, 3] float32 radiance, and its colour space.

    Raises:
        ImageError, StorageError: it cannot be read.
    """
    channels, metadata = exr.read(path)
    return np.stack([channels[c] for c in "RGB"], axis=-1).astype(np.float32), exr.color_space_of(metadata)


def _exposure(images: np.ndarray, mask: np.ndarray) -> float:
    level = float(np.percentile(images[:, mask].mean(axis=-1), EXPOSURE_PERCENTILE))
    return EXPOSURE_TARGET / level if level > 0 else 1.0


def display(pixels: np.ndarray, space: str) -> np.ndarray:
    """Scene-linear to display values through OpenColorIO's ACES view.

    Args:
        pixels: [rows, cols, 3] radiance.
        space: its scene-linear colour space.

    Returns:
        [rows, cols, 3] float32, 0…1; black becomes the background of a sheet.
    """
    source = oiio.ImageBuf(np.ascontiguousarray(pixels, dtype=np.float32))
    shown = oiio.ImageBufAlgo.ociodisplay(source, DISPLAY, VIEW, space, colorconfig=CONFIG)
    if shown.has_error:
        raise ValueError(f"cannot show {space}: {shown.geterror()}")
    return np.maximum(pixels_of(shown), BACKGROUND * (pixels.max(axis=-1, keepdims=True) <= 0))


def _relief(height: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Height as grey, near bright."""
    low, high = np.percentile(height[mask], [0.5, 99.5])
    grey = np.clip((height - low) / max(high - low, 1e-12), 0, 1)
    return np.where(mask[..., None], np.repeat((0.12 + 0.83 * grey)[..., None], 3, axis=-1), BACKGROUND)


def fit(image: np.ndarray, height: int = TILE, *, kernel: str = "") -> np.ndarray:
    """Scale [rows, cols, 3] to a height; kernel: OpenImageIO's name of a filter, without it a sharp one that may ring."""
    rows, cols = image.shape[:2]
    if rows == height:
        return image
    width = max(1, round(cols * height / rows))
    source = oiio.ImageBuf(np.ascontiguousarray(image, dtype=np.float32))
    return pixels_of(oiio.ImageBufAlgo.resize(source, kernel, roi=oiio.ROI(0, width, 0, height, 0, 1, 0, 3)))


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


def _write(path: Path, sheet: oiio.ImageBuf) -> None:
    with replacing(path) as temporary:
        sheet.set_write_format("uint8")
        if not sheet.write(str(temporary)):
            raise StorageError(f"cannot write {path}: {sheet.geterror()}")
