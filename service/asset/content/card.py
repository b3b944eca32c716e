"""Relit frames as the images of a card: colours that are not multiplied by their coverage, and the coverage.

Frames are premultiplied, and the surface of a material multiplies its emission by its opacity, so that the colours of a frame would be
multiplied twice. The images are therefore copies: R, G and B over A, and A by itself, without the other layers of the frames.

Source: Porter and Duff, "Compositing digital images", SIGGRAPH 1984 (premultiplied colours); OpenUSD, "UsdPreviewSurface Specification"
    (opacity).
"""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from service.asset.content.textures import BLEED_TEXELS, DISPLAY_SPACE, bleed, quantise, to_display
from service.errors import AssetError
from stage.capture.camera import Camera
from stage.colour.colour import convert
from stage.errors import ImageError
from stage.formats import exr, images
from stage.formats.images import write_png

LINEAR_SPACE = "lin_rec709_scene"
"""Colour space of the images that are EXR: clients read no other linear one."""

FILE_PATTERN = r"card(?:_opacity)?\.\d+\.(?:exr|png)"
"""Regular expression of every file that write_card can write."""


class CardImages(NamedTuple):
    """The written images of a card; frame numbers are its time codes."""

    colours: Mapping[int, str]  # frame number → file name
    opacities: Mapping[int, str]  # the same; empty where all frames cover the whole picture
    color_space: str  # DISPLAY_SPACE or LINEAR_SPACE
    clipped_pixels: int  # with a colour above 1, which a PNG cannot hold


def find_frames(pattern: Path, camera: Camera) -> dict[int, Path]:
    """Return the frames of a file name with a run of # for the number, or the one file, after a look at their headers."""
    runs = re.findall("#+", pattern.name)
    if len(runs) != 1 or "#" in str(pattern.parent):
        if runs or not pattern.is_file():
            raise AssetError(f"--card {pattern}: is neither a frame nor a file name with one run of # for the number, as in frame.####.exr")
        found = {1: pattern}
    else:
        before, after = pattern.name.split(runs[0])
        name = re.compile(re.escape(before) + rf"(\d{{{len(runs[0])},}})" + re.escape(after))
        there = sorted(pattern.parent.iterdir()) if pattern.parent.is_dir() else []
        found = {int(match[1]): file for file in there if (match := name.fullmatch(file.name))}
        if not found:
            raise AssetError(f"--card {pattern}: there is no such frame: make them with `relit relight`")
        missing = sorted(set(range(min(found), max(found) + 1)) - found.keys())
        if missing:
            more = f" and {len(missing) - 1} more" if len(missing) > 1 else ""
            raise AssetError(f"--card {pattern}: frame {missing[0]}{more} is missing between {min(found)} and {max(found)}")
    for file in found.values():
        if file.suffix.lower() != ".exr":
            raise ImageError(f"{file}: a frame of a card is an .exr")
        header = exr.read_header(file)
        if not {"R", "G", "B"} <= set(header.channels):
            raise ImageError(f"{file}: has no channels R, G and B")
        images.check_resolution(file, camera.resolution)
    return dict(sorted(found.items()))


def write_card(frames: Mapping[int, Path], folder: Path, *, as_png: bool) -> CardImages:
    """Write the images of a card; `as_png`: colours as PNG of 16 bits with the sRGB curve, clipped at 1, and not as half EXR."""
    colours: dict[int, str] = {}
    opacities: dict[int, str] = {}
    clipped_pixels, covered = 0, True
    for number, path in frames.items():
        colour, opacity, space = _read_straight(path)
        known = opacity > 0
        colours[number] = f"card.{number:04d}.{'png' if as_png else 'exr'}"
        if as_png:
            codes, clipped = quantise(to_display(colour, space), known, np.uint16)
            clipped_pixels += clipped
            write_png(folder / colours[number], bleed(codes, known, reach=BLEED_TEXELS), srgb=True)
        else:
            linear = np.clip(convert(colour, space, LINEAR_SPACE), -exr.HALF_MAX, exr.HALF_MAX).astype(np.float16)
            linear = bleed(linear, known, reach=BLEED_TEXELS)
            exr.write(folder / colours[number], {name: linear[..., index] for index, name in enumerate("RGB")},
                      color_space=LINEAR_SPACE, metadata={})
        covered = covered and bool((opacity == 1).all())
        opacities[number] = f"card_opacity.{number:04d}.png"
        write_png(folder / opacities[number], np.rint(opacity * 65535).astype(np.uint16), srgb=False)
    if covered:
        for name in opacities.values():
            (folder / name).unlink()
        opacities = {}
    return CardImages(colours, opacities, DISPLAY_SPACE if as_png else LINEAR_SPACE, clipped_pixels)


def _read_straight(path: Path) -> tuple[np.ndarray, np.ndarray, str]:
    """Return the colours [rows, cols, 3] and the coverage [rows, cols] of a frame, float32, and the colour space."""
    channels, metadata = exr.read(path)
    colour = np.stack([channels[name].astype(np.float32) for name in "RGB"], axis=-1)
    opacity = channels["A"].astype(np.float32) if "A" in channels else np.ones(colour.shape[:2], np.float32)
    bad = int(np.count_nonzero(~np.isfinite(colour).all(axis=-1) | ~np.isfinite(opacity)))
    if bad:
        raise ImageError(f"{path}: {bad} pixels are not finite (NaN or infinity): make the frame anew")
    if opacity.min() < 0 or opacity.max() > 1:
        raise ImageError(f"{path}: A is outside 0…1: it is not the coverage of a frame")
    try:
        space = exr.color_space_of(metadata)
        convert(np.zeros((1, 1, 3), np.float32), space, LINEAR_SPACE)
    except ValueError as error:
        raise ImageError(f"{path}: {error}") from error
    return np.divide(colour, opacity[..., None], out=np.zeros_like(colour), where=opacity[..., None] > 0), opacity, space
