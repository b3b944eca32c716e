"""Reading of images (EXR, PNG, TIFF, HDR, JPEG, JPEG XL, AVIF, DPX, TGA, BMP, PPM, raw), the header first, then pixels; writing of PNG."""

import math
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np
import OpenImageIO as oiio

from stage import inputs
from stage.errors import ImageError
from stage.formats import avif, camera_raw, exr, integrity
from stage.formats.exif import TURNS, UPRIGHT, Exposure, radiance_encoding, radiance_multiplier, sound, upright, upright_size
from stage.pixels import Crop

OIIO_SUFFIXES = {".png", ".tif", ".tiff", ".hdr", ".jpg", ".jpeg", ".jxl", ".dpx", ".tga", ".bmp", ".ppm", ".pgm"}
ORIENTED_SUFFIXES = {".png", ".tif", ".tiff", ".hdr", ".jpg", ".jpeg"}
"""Suffixes of files with an orientation that their decoder leaves to the reader; that of JPEG XL turns the pixels by itself."""
SUFFIXES = {".exr", ".avif", *OIIO_SUFFIXES, *camera_raw.SUFFIXES}
FLOATING = {oiio.HALF, oiio.FLOAT, oiio.DOUBLE}
CODES = {oiio.UINT8, oiio.UINT16}
"""Integers that `read_recorded` leaves as they are: tables of what each stands for are short."""


PROFILES = {
    "linear.*(srgb|709)|(srgb|709).*(linear|g10)": "lin_rec709_scene", r"linear|gamma 1\.0|[_ ]g10": "",
    "prophoto|romm|wide gamut|eci ?rgb|apple rgb|colormatch|dot gain": "other", "adobe ?rgb": "g22_adobergb_scene",
    "display p3": "srgb_p3d65_scene", "srgb|s-?gr[ae]y": "srgb_rec709_scene", r"gamma 2\.2": "g22_rec709_scene",
    r"gamma 1\.8": "g18_rec709_scene",
}
"""Words in the descriptions of the ICC profiles that cameras and photo programs embed, and their colour spaces; the first that fit count.
Of linear ones many have primaries that the description does not say."""


class ImageHeader(NamedTuple):
    """The size and the channels of an image, which are known before any pixel is decoded."""

    width: int  # of the upright image
    height: int
    channels: int  # 1 for grey, 3 for RGB; alpha is not counted
    stored: int  # the count of all channels in the file, which are decoded together
    integer: bool  # integers, whose largest value a camera writes for everything brighter too
    orientation: int = UPRIGHT  # in which the pixels are recorded, a key of `stage.formats.exif.TURNS`; they are read upright
    exposure: Exposure = Exposure()  # as EXIF says
    half: bool = False  # whether all colour channels hold half values
    multiplied: float = 1.0  # the factor that a Radiance file says its values were multiplied by
    encoding: str = ""  # what a Radiance header or a profile says of values that are not linear ones of Rec.709
    space: str = ""  # the colour space that an EXR file declares, or that of an ICC profile; empty where it declares none
    pixel_aspect: float = 1.0  # the width of a pixel over its height, as an EXR file declares
    eight_bits: bool = False  # whether the file holds integers of eight bits


class Decoder(Protocol):
    """Reads images in place of the functions here."""

    def header(self, path: Path) -> ImageHeader:
        """Return what `read_header` returns."""

    def recorded(self, path: Path) -> np.ndarray:
        """Return what `read_recorded` returns."""


_elsewhere: list[Decoder] = []


@contextmanager
def decoded_by(decoder: Decoder) -> Iterator[None]:
    """Let another decoder read all images, in all threads of this process, until the block ends; of several, the latest."""
    _elsewhere.append(decoder)
    try:
        yield
    finally:
        _elsewhere.remove(decoder)


def read_header(path: str | Path) -> ImageHeader:
    """Read the size and the channels of an image."""
    if _elsewhere:
        return _elsewhere[-1].header(Path(path))
    _check_suffix(path)
    with inputs.opened(path) as source:
        return header_of(source)


def _pixel_aspect(metadata: Mapping[str, Any]) -> float:
    """Return the shape of pixels that an EXR file declares; 1 where it is no positive number."""
    declared = float(metadata.get("pixelAspectRatio", 1.0))
    return declared if math.isfinite(declared) and declared > 0 else 1.0


def header_of(source: inputs.Source) -> ImageHeader:
    """Read the size and the channels of an image that is open; errors are those of `read_header`."""
    path, suffix = source.path, source.path.suffix.lower()
    if suffix == ".exr":
        header = exr.header_of(source)
        colours = _colour_channels(path, header.channels)
        try:
            space = exr.color_space_of(header.metadata, "")
        except ValueError:
            space = ""
        return ImageHeader(header.width, header.height, len(colours), len(header.channels), False, half=header.half.issuperset(colours),
                           space=space, pixel_aspect=_pixel_aspect(header.metadata))
    _check_suffix(path)
    if suffix == ".png":
        integrity.check_png(path, source.file, contents=False)
    elif suffix == ".jxl":
        source.check_pixels(*integrity.jxl_resolution_of(path, source.file))
    elif suffix == ".avif":
        found = avif.header_of(path, source.file)
        return ImageHeader(found.width, found.height, found.channels, found.channels + 1, True, eight_bits=found.bits == 8)
    elif suffix in camera_raw.SUFFIXES:
        raw = camera_raw.header_of(source)
        return ImageHeader(raw.width, raw.height, 3, 3, True, raw.orientation, raw.exposure)
    with _decoder(source) as decoder:
        spec = decoder.spec()
        orientation = _orientation(path, spec)
        space, encoding = _profile(str(spec.getattribute("ICCProfile:profile_description") or ""))
        stated = ImageHeader(*upright_size(spec.width, spec.height, orientation), 1 if spec.nchannels < 3 else 3, spec.nchannels,
                              spec.format.basetype not in FLOATING, orientation, _exposure(spec), eight_bits=spec.format == oiio.UINT8,
                              space=space, encoding=encoding)
    if suffix == ".hdr":
        return stated._replace(multiplied=radiance_multiplier(source.file), encoding=radiance_encoding(source.file))
    return stated


def read_pixels(path: str | Path) -> np.ndarray:
    """Read the recorded values of an image, upright: integers as fractions of full scale, floating-point values unchanged.
    Returns [rows, cols, 3] float32, or float16 when the file holds half values; grey images repeat their one channel."""
    recorded = read_recorded(path)
    return np.take(fractions(recorded.dtype), recorded) if recorded.dtype.kind == "u" else recorded


@cache
def fractions(kind: np.dtype) -> np.ndarray:
    """Return the fraction of full scale that each integer of an image stands for: [256] or [65536] float32, as OpenImageIO computes it."""
    full = np.iinfo(kind).max
    return np.arange(full + 1, dtype=np.float32) * np.float32(1 / full)


def read_recorded(path: str | Path) -> np.ndarray:
    """Read the recorded values of an image, upright, as the file has them; `fractions` converts them to those of `read_pixels`.
    Returns [rows, cols, 3] uint8 or uint16 when the file holds integers of up to so many bits, else float32 or float16 as `read_pixels`
    returns them; grey images repeat their one channel."""
    if _elsewhere:
        return _elsewhere[-1].recorded(Path(path))
    with inputs.opened(path) as source:
        return recorded_of(source)


def recorded_of(source: inputs.Source) -> np.ndarray:
    """Read the recorded values of an image that is open, as `read_recorded` does."""
    path, suffix = source.path, source.path.suffix.lower()
    if suffix == ".exr":
        channels, _ = exr.read_open(source)
        planes = [channels[name] for name in _colour_channels(path, tuple(channels))]
        if any(plane.dtype == np.uint32 for plane in planes):
            raise ImageError(f"{path}: holds integer identifiers, not radiance")
        pixels = np.moveaxis(np.stack(planes), 0, -1)  # planar in memory: what works on values alone leaves them so
    else:
        pixels = _decoded(source, suffix)
    return np.repeat(pixels, 3, axis=-1) if pixels.shape[-1] == 1 else pixels


def _decoded(source: inputs.Source, suffix: str) -> np.ndarray:
    """Return the channels of an image that is open, without alpha: [rows, cols, 1 or 3]."""
    if suffix == ".png":
        integrity.check_png(source.path, source.file, contents=True)
    elif suffix in (".jpg", ".jpeg"):
        integrity.check_jpeg(source.path, source.file)
    elif suffix == ".jxl":
        source.check_pixels(*integrity.jxl_resolution_of(source.path, source.file))
    elif suffix == ".avif":
        found = avif.header_of(source.path, source.file)
        source.check_pixels(found.width, found.height)
        return avif.decode(source.path, source.file, found)
    elif suffix in camera_raw.SUFFIXES:
        return camera_raw.decode(source)
    with _decoder(source) as decoder:
        spec = decoder.spec()
        source.check_pixels(spec.width, spec.height)
        channels = 1 if spec.nchannels < 3 else 3
        decoded = decoder.read_image(0, 0, 0, channels, spec.format if spec.format.basetype in CODES else oiio.FLOAT)
        if decoded is None:
            raise ImageError(f"{source.path}: cannot be decoded: {_reason(decoder.geterror())}")
        return upright(np.asarray(decoded), _orientation(source.path, spec))


def read_mask(path: str | Path, resolution: tuple[int, int], crop: Crop | None = None) -> np.ndarray:
    """Read a mask, which is True where the first channel of an image is above one half.
    Returns [rows, cols] bool. Raises ImageError if the mask has another size, is unreadable, or is True nowhere."""
    values = read_mask_values(path, resolution)
    mask = (values if crop is None else crop.of(values)) > 0.5
    if not mask.any():
        raise ImageError(f"{path}: the mask is empty{'' if crop is None else f' in --crop {crop}'}: no pixel is above one half in its "
                         f"first channel, the highest is {values.max():.3g} of 1: the object is to be white")
    return mask


def read_mask_values(path: str | Path, resolution: tuple[int, int]) -> np.ndarray:
    """Read the values of a mask: the first channel of an image, where partial values stand for pixels that the object covers in part.
    Returns [rows, cols] float32, 0…1; values outside are clipped, and what is no number is 0."""
    check_resolution(path, resolution)
    recorded = read_recorded(path)[..., 0]
    values = np.take(fractions(recorded.dtype), recorded) if recorded.dtype.kind == "u" else recorded.astype(np.float32)
    return np.clip(np.nan_to_num(values, nan=0.0), 0, 1)


PNG_ROWS = 256
"""Rows of a PNG that are handed to its writer at one time: they bound its memory."""
PNG16_LEVEL = 2
"""Level at which deflate packs 16-bit images, whose lower bytes are noise: it takes two thirds of the time of the usual 6, for 0.4 % more
bytes. Images of 8 bits keep the usual level, which saves a tenth of their bytes."""
PNG_FILTER_NONE = 8
"""OpenImageIO's code for unfiltered rows. Filtered rows of 16-bit images are 1 to 30 % larger, and take twice the time, because a
difference of noise is more noise; only images of 8 bits are filtered."""


def write_png(path: Path, codes: np.ndarray, *, srgb: bool, texts: Mapping[str, str] | None = None) -> None:
    """Write a PNG file; `replacing` makes it appear whole or not at all.
    `codes`: [rows, cols] or [rows, cols, 3] uint8 or uint16. `srgb`: True for colours that are encoded in sRGB, False for data that no
    reader should convert. `texts`: text chunks by their keywords. Raises OSError if the file cannot be written."""
    pixels = np.ascontiguousarray(codes[..., None] if codes.ndim == 2 else codes)  # two dimensions would be transposed
    rows, cols, channels = pixels.shape
    spec = oiio.ImageSpec(cols, rows, channels, str(codes.dtype))
    spec.attribute("oiio:ColorSpace", "srgb_rec709_scene" if srgb else "data")  # without it the file would claim to be sRGB
    for keyword, text in (texts or {}).items():
        spec.attribute(keyword, text)
    if codes.dtype == np.uint16:
        spec.attribute("png:compressionLevel", PNG16_LEVEL)
        spec.attribute("png:filter", PNG_FILTER_NONE)
    output = oiio.ImageOutput.create(str(path))
    if output is None:
        raise OSError(f"{path.name}: {oiio.geterror()}")
    written = output.open(str(path), spec)
    for first in range(0, rows, PNG_ROWS):  # the writer copies what it is given
        last = min(first + PNG_ROWS, rows)
        written = written and output.write_scanlines(first, last, 0, pixels[first:last])
    if not (written and output.close()):
        raise OSError(f"{path.name}: {output.geterror() or 'the PNG writer gave up'}")
    try:
        with inputs.opened(path) as source:
            integrity.check_png(path, source.file, contents=False)
    except ImageError as error:  # the writer reports success when the disk is full
        raise OSError(f"{path.name}: the disk took only part of it") from error


def write_jpeg(path: Path, codes: np.ndarray, quality: int, *, subsampled: bool) -> None:
    """Write [rows, cols, 3] uint8 as a JPEG file.
    `subsampled`: whether colour has half of the resolution of brightness. Raises OSError if the file cannot be written."""
    rows, cols, _ = codes.shape
    spec = oiio.ImageSpec(cols, rows, 3, "uint8")
    spec.attribute("compression", f"jpeg:{quality}")
    spec.attribute("jpeg:subsampling", "4:2:0" if subsampled else "4:4:4")
    output = oiio.ImageOutput.create(str(path))
    if output is None or not (output.open(str(path), spec) and output.write_image(np.ascontiguousarray(codes)) and output.close()):
        raise OSError(f"{path.name}: {oiio.geterror() if output is None else output.geterror()}")


def check_resolution(path: str | Path, resolution: tuple[int, int], *, declared: str = "camera.resolution") -> ImageHeader:
    """Check that an image has the width and height that a camera declares, and return its header."""
    header = read_header(path)
    if (header.width, header.height) != resolution:
        turned = "" if header.orientation == UPRIGHT else f" once it is {TURNS[header.orientation].words} (EXIF orientation)"
        raise ImageError(f"{path}: is {header.width}x{header.height}{turned}, {declared} says {resolution[0]}x{resolution[1]}")
    return header


@contextmanager
def _decoder(source: inputs.Source) -> Iterator[oiio.ImageInput]:
    config = oiio.ImageSpec()
    config.attribute("oiio:UnassociatedAlpha", 1)  # colours as recorded, not multiplied by alpha
    with source.reopened() as same:
        decoder = oiio.ImageInput.open(same, config)
        if decoder is None:
            raise ImageError(f"{source.path}: cannot be read: {_reason(oiio.geterror()).replace(same, source.path.name)}")
        try:
            yield decoder
        finally:
            decoder.close()


def pixels_of(buffer: oiio.ImageBuf) -> np.ndarray:
    """Return the pixels of an OpenImageIO buffer, [rows, cols, channels] float32."""
    pixels = buffer.get_pixels(oiio.FLOAT)
    if pixels is None:
        raise ValueError(buffer.geterror())
    return np.asarray(pixels)


def _orientation(path: Path, spec: oiio.ImageSpec) -> int:
    """Return the orientation in which the pixels of a file are recorded."""
    found = int(spec.get_int_attribute("Orientation", UPRIGHT)) if path.suffix.lower() in ORIENTED_SUFFIXES else UPRIGHT
    return found if found in TURNS else UPRIGHT


def _profile(description: str) -> tuple[str, str]:
    """Return the colour space of an ICC profile, by its description, and what to say of one whose values are encoded otherwise."""
    space = next((space for words, space in PROFILES.items() if re.search(words, description, re.IGNORECASE)), "")
    return ("", f"ICC profile {description}") if space == "other" else (space, "")


def _exposure(spec: oiio.ImageSpec) -> Exposure:
    names = ("ExposureTime", "FNumber", "Exif:PhotographicSensitivity")
    return Exposure(*(sound(float(spec.get_float_attribute(name, 0.0))) for name in names))


def _check_suffix(path: str | Path) -> None:
    if Path(path).suffix.lower() not in SUFFIXES:
        listed = ", ".join(sorted(SUFFIXES - camera_raw.SUFFIXES))
        raise ImageError(f"{path}: has an unknown suffix: relit reads {listed} and camera raw ({', '.join(sorted(camera_raw.SUFFIXES))})")


def _colour_channels(path: str | Path, names: tuple[str, ...]) -> tuple[str, ...]:
    layers = {name[:-1] for name in names if {f"{name[:-1]}{letter}" for letter in "RGB"} <= set(names)}
    if len(layers) == 1 or "" in layers:  # the only layer, or the one without a name
        layer = "" if "" in layers else layers.pop()
        return (f"{layer}R", f"{layer}G", f"{layer}B")
    if {"X", "Y", "Z"} <= set(names) or "RY" in names or "BY" in names:
        raise ImageError(f"{path}: has channels {', '.join(names)}, of which Y alone is grey: convert its colours to R, G, B")
    if "Y" in names:
        return ("Y",)
    flat = [name for name in names if name != "A"]
    if len(flat) == 1:
        return (flat[0],)
    raise ImageError(f"{path}: has channels {', '.join(names)}: an image needs R, G, B, in one layer, or one grey channel")


def _reason(text: str) -> str:
    lines = text.strip().splitlines()
    return lines[0].rstrip(".") if lines else "its data is damaged"


