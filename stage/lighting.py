"""The lights of a capture as arrays, and whether they can determine a normal."""

import numpy as np

from stage.capture import SOURCES, Capture
from stage.errors import ManifestError
from stage.extended_lights import ExtendedLights, extended_lights
from stage.light import DistantLight, ExtendedLight, GradientLight, PointLight
from stage.manifest import FILE_NAME
from stage.point_lights import DistantLights, PlacedLights, place_lights

MIN_SPREAD = 1e-3
"""Least ratio of the smallest to the largest singular value of the light directions: about 0.1° out of one plane."""


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


def check_solvable(capture: Capture) -> DistantLights | PlacedLights | ExtendedLights:
    """Refuse a capture from which no normal can be solved.

    Returns:
        Its lights: ExtendedLights where some are extended, PlacedLights where some are near, otherwise distant ones.

    Raises:
        ManifestError: fewer than three lights, lights in one plane (near ones as seen from the object's centre), near lights
            where none can be, an image of one pixel, a channel without light.
    """
    where = capture.folder / FILE_NAME
    if capture.lit_by(ExtendedLight):
        check_surface(capture)
        return extended_lights(capture)
    near = bool(capture.lit_by(PointLight))
    lights = place_lights(capture) if near else distant_lights(capture)
    count = len(lights.direction)
    if count < 3:
        raise ManifestError(f"{where}: frames: {count} lit by a {'distant or point' if near else 'distant'} light: "
                            "a normal needs three or more")
    spread = np.linalg.svd(lights.direction, compute_uv=False)
    if spread[2] < MIN_SPREAD * spread[0]:
        raise ManifestError(f"{where}: frames[].light.{'position_m' if near else 'direction'}: all {count} lights lie in one "
                            "plane through the object: a normal needs lights out of it")
    strength = lights.strength if isinstance(lights, PlacedLights) else lights.irradiance
    unlit = np.flatnonzero(~(strength > 0).any(axis=0))
    if len(unlit):
        raise ManifestError(f"{where}: frames[].light.{'intensity' if near else 'irradiance'}: channel {'RGB'[unlit[0]]} is 0 "
                            "for every light")
    check_surface(capture)
    return lights


def lights_from_centre(capture: Capture) -> DistantLights:
    """Every light as a distant one: near lights as the centre of the object sees them.

    Raises:
        ManifestError: as distant_lights, but point lights are taken too; near lights where none can be.
    """
    if not capture.lit_by(PointLight):
        return distant_lights(capture)
    placed = place_lights(capture)
    return DistantLights(placed.direction, placed.irradiance)


def check_surface(capture: Capture) -> None:
    """Refuse an image of one pixel.

    Raises:
        ManifestError: it is one.
    """
    if capture.camera.width * capture.camera.height == 1:
        raise ManifestError(f"{capture.folder / FILE_NAME}: camera.resolution: is 1x1: a surface needs two pixels or more")
