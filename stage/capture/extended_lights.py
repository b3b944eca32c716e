"""The extended and distant lights of a capture as arrays: samples of area sources, and one sample for each distant light.

Source: Nayar, Ikeuchi and Kanade, "Determining shape and reflectance of hybrid surfaces by photometric sampling", IEEE Trans.
    Robotics and Automation 6(4), 1990.
"""

from typing import NamedTuple

import numpy as np

from stage.capture.capture import SOURCES, Capture
from stage.capture.light import DistantLight, ExtendedLight
from stage.capture.manifest import FILE_NAME
from stage.errors import ManifestError

COLOUR_TOLERANCE = 0.02
"""The largest part of the light of a source that may differ in colour from the whole: each sample is then a share of one spectrum."""
LEAST_SPREAD = 1e-3
"""The least ratio of the smallest to the largest singular value of directions that determine a normal: about 0.1° out of a plane."""


class ExtendedLights(NamedTuple):
    """The samples of all lights, and the irradiance of each light, in the order of the frames in the manifest and in the stack."""

    direction: np.ndarray  # [samples, 3] float64, unit, from the surface to the sample, camera frame
    solid_angle: np.ndarray  # [samples] float64, steradians; 0 for a distant light
    light: np.ndarray  # [samples] int, the light of the sample: a row of `irradiance`
    share: np.ndarray  # [samples] float64, part of the irradiance of its light; the parts of a light add up to one
    irradiance: np.ndarray  # [lights, 3] float64, Σ radiance · solid angle: every sample at normal incidence


def lie_in_one_plane(direction: np.ndarray) -> bool:
    """Return whether directions [n, 3] lie in one plane through the origin, so that no normal can be solved from them."""
    spread = np.linalg.svd(direction, compute_uv=False)
    return len(spread) < 3 or bool(spread[2] < LEAST_SPREAD * spread[0])


def extended_lights(capture: Capture) -> ExtendedLights:
    """Return the lights of the stack of a capture, all of which must be extended or distant.

    Raises:
        ManifestError: a light of another type, a source whose colour changes over its extent, fewer than three lights, light from
            one plane only, or a channel without light; the message names the frame.
    """
    where = capture.folder / FILE_NAME
    direction, solid_angle, share, irradiance = [], [], [], []
    for index, frame in enumerate(capture.manifest.frames):
        light = frame.light
        if isinstance(light, DistantLight):
            direction.append(np.array([light.direction]))
            solid_angle.append(np.zeros(1))
            share.append(np.ones(1))
            irradiance.append(np.array(light.irradiance))
        elif isinstance(light, ExtendedLight):
            steradians = np.array(light.solid_angle)
            power = np.array(light.radiance) * steradians[:, None]
            total = power.sum(axis=0)
            along = power @ total / (total @ total)
            if np.abs(power - np.outer(along, total)).sum() > COLOUR_TOLERANCE * power.sum():
                raise ManifestError(f"{where}: frames[{index}].light.radiance: its colour changes over the source: "
                                    "give samples that differ in brightness alone")
            shining = along > 0
            direction.append(np.array(light.directions)[shining])
            solid_angle.append(steradians[shining])
            share.append(along[shining])
            irradiance.append(total)
        elif isinstance(light, SOURCES):
            raise ManifestError(f"{where}: frames[{index}].light: is {light.type}: beside extended lights a frame has "
                                "an extended or a distant one")
    count = len(irradiance)
    if count < 3:
        raise ManifestError(f"{where}: frames: {count} lit by an extended or distant light: a normal needs three or more")
    lights = ExtendedLights(np.concatenate(direction), np.concatenate(solid_angle),
                            np.repeat(np.arange(count), [len(part) for part in share]), np.concatenate(share),
                            np.array(irradiance))
    if lie_in_one_plane(lights.direction):
        raise ManifestError(f"{where}: frames[].light.directions: all light comes from one plane through the object: "
                            "a normal needs light from out of it")
    unlit = np.flatnonzero(~(lights.irradiance > 0).any(axis=0))
    if len(unlit):
        raise ManifestError(f"{where}: frames[].light.radiance: channel {'RGB'[unlit[0]]} is 0 for every light")
    return lights
