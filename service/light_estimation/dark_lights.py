"""Frames that are dark though their lamp stands before the object: it did not burn, or the shutter missed it.

A dark reading is a shadow to every method, and a frame of nothing else says that the whole object lies in shadow: normals turn away from
its lamp, and heights grow walls. But of what a camera sees, a lamp on its side lights a part.
"""

from collections.abc import Sequence

import numpy as np

from kernels.photometric.model.samples import some_of
from service.light_estimation.explanations import grey_readings
from stage.capture.point_lights import DistantLights, PlacedLights
from stage.stack.stack import Stack

PIXELS = 1024
"""Pixels, spread over the object, that are compared."""
LEAST_Z = 0.2
"""Least z of the direction to a lamp that stands before the object."""
MOST_MEAN, MOST_PEAK = 0.03, 0.1
"""Largest mean and largest brightest reading of a dark frame, over the medians of those of all frames whose lamp stands before the object.
Noise is what peaks; a lamp at the least z gives a flat object that faces the camera a fifth."""
MOST_DARK, LEAST_LEFT = 0.25, 3
"""Largest part of the lights that is told to be dark, and least count of the others: where more are dark, the object was so lit."""


def dark_frames(stack: Stack, lights: DistantLights | PlacedLights, mask: np.ndarray) -> np.ndarray:
    """Return which lights of a stack did not burn, [lights] bool. `mask`: [rows, cols] bool, the object."""
    readings = grey_readings(stack.pick_radiance(some_of(mask, PIXELS))[0], lights.irradiance)
    dark = dark_lights(readings, lights.direction)
    if dark.any():  # small highlights of bare metal may lie between the pixels
        readings[dark] = _means(stack, lights.irradiance, mask.reshape(-1), dark)[:, None]
        dark &= dark_lights(readings, lights.direction)
    return dark


def dark_lights(readings: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """Return which lights seem not to burn, [lights] bool.

    Args:
        readings: [lights, pixels] radiance over irradiance of pixels that are spread over the object.
        direction: [lights, 3] unit vectors to the lights, from the middle of the object.
    """
    before, dark = direction[:, 2] > LEAST_Z, np.zeros(len(readings), dtype=bool)
    if not before.any() or not readings.shape[1]:
        return dark
    mean, peak = readings.mean(axis=1), readings.max(axis=1)
    dark = before & (mean < MOST_MEAN * np.median(mean[before])) & (peak < MOST_PEAK * np.median(peak[before]))
    few = dark.sum() <= MOST_DARK * len(dark) and (~dark).sum() >= LEAST_LEFT
    return dark if few else np.zeros_like(dark)


def dark_sentence(images: Sequence[str], dark: np.ndarray, what: str) -> str:
    """Return a sentence about the images, of each light, whose lamps did not burn. `dark`: [lights] bool. `what`: is done about them, or
    can be."""
    named = [image for image, is_dark in zip(images, dark, strict=True) if is_dark]
    are = "is" if len(named) == 1 else "are"
    return (f"frames: {', '.join(named)} {are} dark, though the light stands before the object, as where a lamp did not burn or the "
            f"shutter missed it: {what}")


def _means(stack: Stack, irradiance: np.ndarray, inside: np.ndarray, chosen: np.ndarray) -> np.ndarray:
    """Return the mean of all pixels of the object in chosen frames, [chosen] radiance over irradiance."""
    rows, total = np.flatnonzero(chosen), np.zeros((chosen.sum(), 3))
    for start, stop in stack.bands():
        within = np.flatnonzero(inside[start:stop])
        total += stack.band(start, stop)[:, rows][:, :, within].sum(axis=2, dtype=np.float64).T
    mean = total * stack.scale[rows, None] / max(int(inside.sum()), 1)
    return grey_readings(mean[:, None], irradiance[rows])[:, 0]
