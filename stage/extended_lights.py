"""Lights of any extent of a capture as arrays: area sources as samples of the sphere, distant lights as one sample each."""

from typing import NamedTuple

import numpy as np

from stage.capture import SOURCES, Capture
from stage.errors import ManifestError
from stage.light import DistantLight, ExtendedLight
from stage.manifest import FILE_NAME

COLOUR_TOLERANCE = 0.02
"""Part of a source's light that may be of another colour than the whole: its samples are then shares of one spectrum."""
LEAST_SPREAD = 1e-3
"""Least ratio of the smallest to the largest singular value of all samples' directions: about 0.1° out of one plane."""


class ExtendedLights(NamedTuple):
    """Samples of every light, and one row a frame, in manifest order, as in the stack."""

    direction: np.ndarray  # [samples, 3] float64, unit, from the surface to the sample, camera frame
    solid_angle: np.ndarray  # [samples] float64, steradians; 0 for a distant light
    light: np.ndarray  # [samples] int, row of `irradiance`
    share: np.ndarray  # [samples] float64, of the light's irradiance; they add up to one
    irradiance: np.ndarray  # [lights, 3] float64: Σ radiance · solid angle, every sample at normal incidence


def extended_lights(capture: Capture) -> ExtendedLights:
    """The lights of the capture's stack, which must be extended or distant.

    Raises:
        ManifestError: another kind of light; a source whose colour changes over it; fewer than three lights; all light from one
            plane; a channel without light. Names the frame.
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
    spread = np.linalg.svd(lights.direction, compute_uv=False)
    if len(spread) < 3 or spread[2] < LEAST_SPREAD * spread[0]:
        raise ManifestError(f"{where}: frames[].light.directions: all light comes from one plane through the object: "
                            "a normal needs light from out of it")
    unlit = np.flatnonzero(~(lights.irradiance > 0).any(axis=0))
    if len(unlit):
        raise ManifestError(f"{where}: frames[].light.radiance: channel {'RGB'[unlit[0]]} is 0 for every light")
    return lights
