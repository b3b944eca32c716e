"""The exposure that cameras record in image files: exposure time, f-number and sensitivity.

Source: CIPA DC-008, "Exchangeable image file format for digital still cameras: Exif", tags ExposureTime, FNumber and
PhotographicSensitivity.
"""

import math
from collections.abc import Mapping
from typing import NamedTuple

from stage.errors import ManifestError

SAME = 0.01
"""Part by which two recorded values of one setting may differ: they are fractions of small integers."""


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

    Raises:
        ManifestError: an image has no exposure time, or images differ in f-number or sensitivity; the message names them.
    """
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
