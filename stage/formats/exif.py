"""Records of cameras in image files: exposure time, f-number and sensitivity, and how the recorded pixels are turned to be upright; and the
factor that a Radiance file says its values were multiplied by.

Source: CIPA DC-008, "Exchangeable image file format for digital still cameras: Exif", tags ExposureTime, FNumber and
PhotographicSensitivity, and Orientation, which TIFF 6.0 defines; in Radiance files the order of the rows and columns says the same.
Ward, "Radiance File Formats": every EXPOSURE of a header is a factor that the values have been multiplied by, and so are the three of every
COLORCORR; PRIMARIES are x and y of red, green, blue and white.
"""

import math
import re
from collections.abc import Mapping
from typing import BinaryIO, NamedTuple

import numpy as np

from stage.errors import ManifestError

SAME = 0.01
"""Part by which two recorded values of one setting may differ: they are fractions of small integers."""
RADIANCE_HEADER_BYTES = 1 << 16
"""Bytes of a Radiance file in which its header is looked for: programs add a line each."""
NEUTRAL = {b"GAMMA": (1.0,), b"COLORCORR": (1.0, 1.0, 1.0), b"PRIMARIES": (0.64, 0.33, 0.295, 0.6, 0.15, 0.06)}
"""First numbers of the lines of a Radiance header with which its values are linear and of Rec.709, whatever white it has."""
NEUTRAL_TOLERANCE = 0.015
"""Largest difference from these: Radiance's own primaries have their green at .29, those of Rec.709 at .30."""
UPRIGHT = 1
"""The orientation of images whose first row is the top and whose first column is the left."""


class Exposure(NamedTuple):
    """The settings with which a photograph was taken; None where the file does not say."""

    time_s: float | None = None
    f_number: float | None = None
    sensitivity: float | None = None  # ISO


def sound(value: float) -> float | None:
    """Return a recorded setting, or None if it is no positive number."""
    return value if math.isfinite(value) and value > 0 else None


def exposure_times(where: str, exposures: Mapping[str, Exposure]) -> dict[str, float]:
    """Return the exposure time of every image, in seconds.
    Raises ManifestError if an image has no exposure time, or images differ in f-number or sensitivity; the message names them."""
    times = {}
    for name, exposure in exposures.items():
        if exposure.time_s is None:
            raise ManifestError(f"{where}: exposure_from: {name} has no EXIF exposure time: give exposure_s for every frame instead")
        times[name] = exposure.time_s
    for setting, words in (("f_number", "f-number"), ("sensitivity", "ISO sensitivity")):
        values = {name: getattr(exposure, setting) for name, exposure in exposures.items() if getattr(exposure, setting) is not None}
        if values and max(values.values()) > (1 + SAME) * min(values.values()):
            low, high = min(values, key=lambda name: values[name]), max(values, key=lambda name: values[name])
            raise ManifestError(f"{where}: exposure_from: {low} has the {words} {values[low]:g}, {high} {values[high]:g}: readings are "
                                "divided by the exposure time alone; give exposure_s with the other settings multiplied in")
    return times


def unused_exposures(exposures: Mapping[str, Exposure]) -> list[str]:
    """Return a sentence where images without given exposures were exposed for different times; none otherwise."""
    times = [exposure.time_s for exposure in exposures.values() if exposure.time_s is not None]
    if len(times) < 2 or max(times) <= (1 + SAME) * min(times):
        return []
    return [f"frames[].exposure_s: is missing, and EXIF says that frames were exposed for {min(times):.4g} to {max(times):.4g} s: with "
            "\"exposure_from\": \"exif\" the readings are divided by these times"]


def _radiance_header(file: BinaryIO) -> bytes:
    """Return the lines of a Radiance header; empty where it does not end in time. Leaves the file at its beginning."""
    file.seek(0)
    header, end, _ = file.read(RADIANCE_HEADER_BYTES).partition(b"\n\n")
    file.seek(0)
    return header if end else b""


def radiance_multiplier(file: BinaryIO) -> float:
    """Return the factor that a Radiance file says its values were multiplied by; 1 where it says none. Leaves the file at its beginning."""
    factors = re.findall(rb"^EXPOSURE=\s*([0-9.eE+-]+)\s*$", _radiance_header(file), re.MULTILINE)
    try:
        return sound(math.prod(map(float, factors))) or 1.0
    except ValueError:  # no number
        return 1.0


def radiance_encoding(file: BinaryIO) -> str:
    """Return the lines of a Radiance header that say its values are not linear ones of Rec.709; empty where it has none. Leaves the file at
    its beginning."""
    found = []
    for name, numbers in re.findall(rb"^(GAMMA|COLORCORR|PRIMARIES)=([-+.0-9eE \t]+)$", _radiance_header(file), re.MULTILINE):
        try:
            values = [float(number) for number in numbers.split()]
        except ValueError:  # no number
            continue
        if any(abs(value - neutral) > NEUTRAL_TOLERANCE for value, neutral in zip(values, NEUTRAL[name], strict=False)):
            found.append(f"{name.decode()}={' '.join(f'{value:.4g}' for value in values)}")
    return ", ".join(found)


def multiplied_otherwise(multipliers: Mapping[str, float]) -> list[str]:
    """Return a sentence where Radiance images without given exposures were multiplied by different factors; none otherwise."""
    if not multipliers:
        return []
    low, high = min(multipliers, key=lambda name: multipliers[name]), max(multipliers, key=lambda name: multipliers[name])
    if multipliers[high] <= (1 + SAME) * multipliers[low]:
        return []
    return [f"frames[].exposure_s: is missing, and EXPOSURE in the headers says that values were multiplied by {multipliers[low]:.4g} "
            f"({low}) to {multipliers[high]:.4g} ({high}): give each factor as exposure_s, by which readings are divided"]


class _Turn(NamedTuple):
    """The turn that makes an image upright: rows and columns are exchanged first, then reversed."""

    exchanged: bool
    rows_reversed: bool
    cols_reversed: bool
    words: str


TURNS = {
    1: _Turn(False, False, False, "as recorded"),
    2: _Turn(False, False, True, "mirrored left to right"),
    3: _Turn(False, True, True, "turned by 180°"),
    4: _Turn(False, True, False, "mirrored top to bottom"),
    5: _Turn(True, False, False, "mirrored along the diagonal from the top left"),
    6: _Turn(True, False, True, "turned by 90° clockwise"),
    7: _Turn(True, True, True, "mirrored along the diagonal from the top right"),
    8: _Turn(True, True, False, "turned by 90° counterclockwise"),
}
"""The eight orientations."""


def upright(image: np.ndarray, orientation: int) -> np.ndarray:
    """Return an image, [rows, cols, ...], as it is seen upright; `image`: as recorded; `orientation`: 1 to 8."""
    turn = TURNS[orientation]
    turned = image.swapaxes(0, 1) if turn.exchanged else image
    turned = turned[::-1] if turn.rows_reversed else turned
    turned = turned[:, ::-1] if turn.cols_reversed else turned
    return np.ascontiguousarray(turned)


def upright_size(width: int, height: int, orientation: int) -> tuple[int, int]:
    """Return the width and the height of an image that is seen upright."""
    return (height, width) if TURNS[orientation].exchanged else (width, height)


def check_agreement(where: str, orientations: Mapping[str, int]) -> None:
    """Check that all frames of a capture are turned in the same way.

    A camera that looks straight down guesses its orientation anew for each photograph.
    """
    first: dict[int, str] = {}
    for name, orientation in orientations.items():
        first.setdefault(orientation, name)
    if len(first) > 1:
        (one, name), (other, second) = list(first.items())[:2]
        raise ManifestError(f"{where}: frames: {name} is to be {TURNS[one].words} (EXIF orientation {one}), {second} to be "
                            f"{TURNS[other].words} ({other}), but one camera took all from one position: write one orientation into "
                            "all of them")
