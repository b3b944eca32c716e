"""Reading of environment maps: lat-long images of the radiance from every direction, +y at the top and +z in the middle."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from stage.colour.colour import convert, linearise
from stage.colour.colour_spaces import is_linear
from stage.colour.radiance import CLIP_NEGATIVE, check_finite, check_radiance, clip_negative
from stage.errors import ImageError
from stage.formats import exr, images
from stage.formats.exif import SAME

SUFFIXES = {".exr", ".hdr"}
LEAST_FULL = 0.01
"""Part of light, from texels at the largest half value, from which on it is said."""
LEAST_OUTSIDE = 0.01
"""Part of light, added by colours outside of a space, from which on it is said."""

LOOKED_AT, LEAST_CODES = 256, 32
"""Rows and columns of a map that are looked at, and least count of their different values, for 8 bits to be told: maps that are drawn have
few values, and those of other maps are not all within the rounding of half floats of such codes, which hits each by chance one in four."""
HALF_ROUNDING = 2.0**-11


def encoding_sentence(name: str, pixels: np.ndarray, space: str) -> str | None:
    """Return a sentence about a map whose values are all those of an image of 8 bits, or are above the white of their space; or None.
    `pixels`: [rows, cols, 3] as recorded. `space`: the colour space in which they are taken."""
    if not is_linear(space) and (brightest := float(pixels.max())) > 1 + HALF_ROUNDING:
        return (f"environment {name}: its header declares {space}, by which its values are decoded, and they go up to {brightest:.4g}, "
                "where 1 is white: if they are linear, bright parts are far too bright; declare the space that they have (colorInteropID)")
    values = np.unique(pixels[:: -(-pixels.shape[0] // LOOKED_AT), :: -(-pixels.shape[1] // LOOKED_AT)])
    if not LEAST_CODES <= len(values) <= 256 or not 0 <= values[0] <= values[-1] <= 1 + HALF_ROUNDING:
        return None
    codes = np.arange(256, dtype=np.float32) / 255
    for encoded, levels in ((True, codes), (False, linearise(np.repeat(codes[:, None, None], 3, axis=2), "srgb_texture")[:, 0, 0])):
        if (np.abs(values[:, None] - levels).min(axis=1) <= HALF_ROUNDING * values + 1e-6).all():
            wrong = encoded and is_linear(space)
            taken = ", and they look display-encoded and are taken as linear: dark parts are too bright" if wrong else ""
            return (f"environment {name}: all its values are those of an image of 8 bits{taken}; what was brighter than white is clipped, "
                    "so that a sun or lamps in it are too dark: give a map of high dynamic range in linear light")
    return None


def full_sentences(full: Mapping[str, float]) -> list[str]:
    """Return a sentence about the map with the largest part of its light from texels at the largest half value, or none where it is small.
    `full`: that part by the names of the files, as read_environment tells."""
    most = max(full, key=lambda name: full[name], default=None)
    if most is None or full[most] < LEAST_FULL:
        return []
    return [f"environment {most}: {100 * full[most]:.0f} % of its light is from texels at {exr.HALF_MAX:g}, the largest half float, which "
            "stands for all that is brighter: its sun or lamps may be too dark; save the map as 32-bit float or .hdr"]


def multiplied_sentences(multiplied: Mapping[str, float]) -> list[str]:
    """Return a sentence about Radiance maps whose headers say that their values were multiplied, or none.
    `multiplied`: the factors by the names of the files."""
    if not multiplied or all(abs(factor - 1) <= SAME for factor in multiplied.values()):
        return []
    low, high = min(multiplied, key=lambda name: multiplied[name]), max(multiplied, key=lambda name: multiplied[name])
    factors = f"{multiplied[low]:.4g}" + ("" if low == high else f" ({low}) to {multiplied[high]:.4g}")
    return [f"environment {high}: its header says that the values were multiplied by {factors} (EXPOSURE), and they are taken as they are: "
            "divide them by that factor for the light of the scene"]


def outside_sentences(outside: dict[str, float], what: str, space: str, remedy: str) -> list[str]:
    """Return a sentence about the light that gains most by colours outside of the gamut of a space, or none where it gains little.
    `outside`: by the names of files, as read_environment tells. `what`: the kind of light. `space`, `remedy`: in words."""
    most = max(outside, key=lambda name: outside[name], default=None)
    if most is None or outside[most] < LEAST_OUTSIDE:
        return []
    return [f"{what} {most}: has colours outside of {space}, of which channels below 0 are set to 0: that adds {100 * outside[most]:.2g} % "
            f"of its light; {remedy}"]


def check_environment(path: Path) -> None:
    """Check the header of an environment map. Raises ImageError if it is not EXR or HDR, or not twice as wide as high."""
    if path.suffix.lower() not in SUFFIXES:
        raise ImageError(f"{path}: an environment is a lat-long .exr or .hdr")
    header = images.read_header(path)
    if header.width != 2 * header.height:
        raise ImageError(f"{path}: is {header.width}x{header.height}: a lat-long map is twice as wide as high")


def read_environment(path: Path, space: str, *, clipped: dict[str, int] | None = None,
                     outside: dict[str, float] | None = None, full: dict[str, float] | None = None,
                     encodings: dict[str, str] | None = None) -> np.ndarray:
    """Read an environment map in a colour space; HDR files are Rec.709, and so are EXR files that declare no other space.
    `path`: lat-long .exr or .hdr. `space`: the scene-linear colour space of the result. `clipped`: is given the number of pixels with
    values that are negative beyond the noise of the map and set to 0, by its file name; None refuses such maps. `outside`: is given the
    part of its light that colours outside of the gamut of `space` gain, 0 or above. `full`: is given the part of its light that texels at
    the largest half value hold, if it is EXR. `encodings`: is given the sentence of a map that seems to be encoded otherwise than it is
    taken. Returns [rows, cols, 3] float32, scene-linear, none of them negative: noise below zero is 0, and a colour outside the gamut of
    `space` has a channel that is 0."""
    pixels = images.read_pixels(path).astype(np.float32)
    if clipped is None:
        check_radiance(path, pixels, remedy=CLIP_NEGATIVE)
    else:
        check_finite(path, pixels)
        pixels, count = clip_negative(pixels)
        clipped |= {path.name: count} if count else {}
    try:
        given = exr.color_space_of(exr.read_header(path).metadata) if path.suffix.lower() == ".exr" else "lin_rec709_scene"
        converted = convert(pixels, given, space)
    except ValueError as error:
        raise ImageError(f"{path}: {error}") from error
    told = images.read_header(path).encoding
    said = encoding_sentence(path.name, pixels, given) if not told else (
        f"environment {path.name}: its header says {told}, which is not heeded: its values are taken as linear light of Rec.709; convert "
        "the map to that")
    if encodings is not None and said is not None:
        encodings[path.name] = said
    shown = np.maximum(converted, 0)
    height = np.sin(np.pi * (np.arange(len(shown)) + 0.5) / len(shown))
    if full is not None and path.suffix.lower() == ".exr" and (at_end := (pixels == exr.HALF_MAX).any(axis=-1)).any():
        whole = float(np.einsum("rck,r->", shown, height))
        full[path.name] = float(np.einsum("rck,rc,r->", shown, at_end, height)) / whole if whole > 0 else 0.0
    if outside is not None and given != space:
        whole = float(np.einsum("rck,r->", shown, height))
        outside[path.name] = float(np.einsum("rck,r->", shown - converted, height)) / whole if whole > 0 else 0.0
    return shown

