"""Colour spaces: what a capture may declare, and the way from recorded to scene-linear values.

The arithmetic is OpenColorIO's (through OpenImageIO, with the built-in ACES configuration); this file only says which
names of the Color Interop Forum a capture may use and what each one is linearised to.
"""

from typing import Literal, get_args

import numpy as np
import OpenImageIO as oiio

CONFIG = "ocio://default"

ColorSpaceName = Literal[
    "lin_rec709_scene", "lin_ap1_scene", "lin_ap0_scene", "lin_rec2020_scene", "lin_p3d65_scene", "lin_adobergb_scene",
    "srgb_texture", "srgb_rec709_scene", "g22_rec709_scene", "g18_rec709_scene", "srgb_p3d65_scene", "g22_adobergb_scene",
]
"""What `color_space` may be: scene-linear spaces, and display-encoded ones of 8-bit cameras and textures."""

_LINEAR_OF: dict[str, str] = {
    "srgb_texture": "lin_rec709_scene",
    "srgb_rec709_scene": "lin_rec709_scene",
    "g22_rec709_scene": "lin_rec709_scene",
    "g18_rec709_scene": "lin_rec709_scene",
    "srgb_p3d65_scene": "lin_p3d65_scene",
    "g22_adobergb_scene": "lin_adobergb_scene",
}

GREY_WEIGHTS = (0.299, 0.587, 0.114)
"""Luma weights of ITU-R BT.601: the grey on which published photometric stereo figures are computed."""


def is_linear(space: str) -> bool:
    """Whether recorded values are already proportional to radiance."""
    return space not in _LINEAR_OF


def linear_space(space: str) -> str:
    """The scene-linear space with the primaries of `space`: the working space of a capture."""
    if space not in get_args(ColorSpaceName):
        raise ValueError(f"{space} is not a colour space that relit knows")
    return _LINEAR_OF.get(space, space)


def linearise(pixels: np.ndarray, space: str) -> np.ndarray:
    """Recorded values to scene-linear ones with the same primaries.

    Args:
        pixels: [rows, cols, channels] float32, encoded as `space` says.
        space: a ColorSpaceName.

    Returns:
        [rows, cols, channels] float32; the input itself when it is linear already.
    """
    return pixels if is_linear(space) else convert(pixels, space, linear_space(space))


def convert(pixels: np.ndarray, source: str, target: str) -> np.ndarray:
    """Convert between two colour spaces by their interchange names.

    Args:
        pixels: [rows, cols, 1 or 3] float32; one channel is taken as equal red, green and blue.

    Raises:
        ValueError: OpenColorIO does not know one of the names.
    """
    if source == target:
        return pixels
    grey = pixels.shape[2] == 1
    rgb = np.repeat(pixels, 3, axis=2) if grey else pixels
    buffer = oiio.ImageBufAlgo.colorconvert(oiio.ImageBuf(np.ascontiguousarray(rgb, dtype=np.float32)), source, target,
                                            colorconfig=CONFIG)
    if buffer.has_error:
        raise ValueError(f"cannot convert {source} to {target}: {buffer.geterror()}")
    converted = pixels_of(buffer)
    return converted[..., :1] if grey else converted


def rgb_matrix(source: str, target: str) -> np.ndarray:
    """The matrix between two scene-linear spaces.

    Returns:
        [3, 3] float32, column vectors: target = matrix @ source.

    Raises:
        ValueError: OpenColorIO does not know one of the names.
    """
    primaries = np.eye(3, dtype=np.float32)[None]  # one row of three pixels: red, green and blue
    return np.ascontiguousarray(convert(primaries, source, target)[0].T)


def pixels_of(buffer: oiio.ImageBuf) -> np.ndarray:
    """The pixels of an OpenImageIO buffer, [rows, cols, channels] float32.

    Raises:
        ValueError: the buffer holds an error in place of pixels.
    """
    pixels = buffer.get_pixels(oiio.FLOAT)
    if pixels is None:
        raise ValueError(buffer.geterror())
    return np.asarray(pixels)
