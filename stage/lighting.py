"""The distant lights of a capture as arrays, and whether they can determine a normal."""

from typing import NamedTuple

import numpy as np

from stage.capture import SOURCES, Capture
from stage.errors import ManifestError
from stage.light import DistantLight, GradientLight
from stage.manifest import FILE_NAME

MIN_SPREAD = 1e-3
"""Least ratio of the smallest to the largest singular value of the light directions: about 0.1° out of one plane."""


class DistantLights(NamedTuple):
    """One row a frame, in manifest order, as in the stack."""

    direction: np.ndarray  # [lights, 3] float64, unit, from the surface to the light, camera frame
    irradiance: np.ndarray  # [lights, 3] float64, relative


def distant_lights(capture: Capture) -> DistantLights:
    """The lights of the capture's stack, which must all be distant.

    Raises:
        ManifestError: a frame is lit by another kind of light, or there is none; names the frame.
    """
    where = capture.folder / FILE_NAME
    for index, frame in enumerate(capture.manifest.frames):
        if isinstance(frame.light, SOURCES) and not isinstance(frame.light, DistantLight):
            hint = " (relit solve --method gradient solves gradients)" if isinstance(frame.light, GradientLight) else ""
            raise ManifestError(f"{where}: frames[{index}].light: is {frame.light.type}: this needs distant lights{hint}")
    lights = [light for _, light in capture.lit_by(DistantLight)]
    if not lights:
        raise ManifestError(f"{where}: frames: none is lit by a distant light")
    return DistantLights(np.array([light.direction for light in lights]), np.array([light.irradiance for light in lights]))


def check_solvable(capture: Capture) -> DistantLights:
    """Refuse a capture from which no normal can be solved.

    Returns:
        Its distant lights.

    Raises:
        ManifestError: fewer than three lights, lights in one plane, an image of one pixel, a channel without light.
    """
    where = capture.folder / FILE_NAME
    lights = distant_lights(capture)
    count = len(lights.direction)
    if count < 3:
        raise ManifestError(f"{where}: frames: {count} lit by a distant light: a normal needs three or more")
    spread = np.linalg.svd(lights.direction, compute_uv=False)
    if spread[2] < MIN_SPREAD * spread[0]:
        raise ManifestError(f"{where}: frames[].light.direction: all {count} lights lie in one plane through the object: "
                            "a normal needs lights out of it")
    unlit = np.flatnonzero(~(lights.irradiance > 0).any(axis=0))
    if len(unlit):
        raise ManifestError(f"{where}: frames[].light.irradiance: channel {'RGB'[unlit[0]]} is 0 for every light")
    check_surface(capture)
    return lights


def check_surface(capture: Capture) -> None:
    """Refuse an image of one pixel.

    Raises:
        ManifestError: it is one.
    """
    if capture.camera.width * capture.camera.height == 1:
        raise ManifestError(f"{capture.folder / FILE_NAME}: camera.resolution: is 1x1: a surface needs two pixels or more")
