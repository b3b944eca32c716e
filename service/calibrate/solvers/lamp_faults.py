"""Faults of the images of one primary of a lamp that its readings alone do not show: copies, images of something else, another encoding."""

from collections.abc import Sequence

import numpy as np

from service.light_estimation.ball import BallView
from service.light_estimation.grey_ball import better_encoding, fit_brightness
from stage.capture.light import DistantLight
from stage.errors import CalibrationError

DIM = 0.1
"""Readings that are darker than this part of the brightest are not compared: a dead band is dark at several drives, and what the light of
the room changes by colours the dimmest."""
SURE = 20.0
"""Readings are compared whose brightest channel is so many of its standard errors, so that noise turns a colour by 3° at most."""
TURNED_DEGREES, TIMES = 10.0, 5.0
"""Angle between the colour of an image and that of most from which it is said, and how many times those of the others it is where the image
is of something else: LEDs turn by a degree or two as they are dimmed, and halogen lamps by 20°, but all along the way."""
LEAST_OTHERS = 2
"""Drives that must have one colour, for another one to differ from them."""


def check_images(names: Sequence[str], drives: Sequence[float], pixels: Sequence[bytes], values: np.ndarray,
                 sigmas: np.ndarray) -> str | None:
    """Return what there is to say where the colour of a primary changes with its level, or None.
    Raises CalibrationError if images are copies of each other, or one has another colour than all others.

    Args:
        names: of the images.
        drives: of each image.
        pixels: what each image records of the target.
        values: [images, 3] linear readings.
        sigmas: [images, 3] their standard errors.
    """
    bright = values.max(axis=1) > np.maximum(DIM * values.max(), SURE * sigmas[np.arange(len(values)), values.argmax(axis=1)])
    places: list[int] = np.flatnonzero(bright).tolist()
    first: dict[bytes, int] = {}
    for index in places:
        other = first.setdefault(pixels[index], index)
        if drives[other] != drives[index]:
            raise CalibrationError(f"{names[other]} and {names[index]} are the same image, at the levels {drives[other]:.3g} and "
                                   f"{drives[index]:.3g}, and noise is never the same twice: one is a copy of the other")
    colours = values[bright] / np.linalg.norm(values[bright], axis=1, keepdims=True)
    if not places:
        return None
    middle = np.median(colours, axis=0)
    turned = np.degrees(np.arccos(np.clip(colours @ middle / np.linalg.norm(middle), -1, 1)))
    odd = int(turned.argmax())
    if turned[odd] < TURNED_DEGREES:
        return None
    if len({drives[index] for index in places}) > LEAST_OTHERS and turned[odd] > TIMES * np.delete(turned, odd).max():
        index = places[odd]
        raise CalibrationError(f"{names[index]}, at the level {drives[index]:.3g}, has another colour than at all other levels, by "
                               f"{turned[odd]:.0f} degrees: check that the table names the right images")
    return f"its colour changes with the level, by {turned[odd]:.0f} degrees"


def other_encoding(radiance: np.ndarray, ambient: np.ndarray | float, saturated: np.ndarray | None, direction: np.ndarray, view: BallView,
                   *, exposure: float, declared: str) -> str | None:
    """Return what there is to say where the shading of a grey ball is Lambert's in another encoding than the declared one, or None.
    `radiance`, `ambient`: with the lamp, and without any, as declared."""
    x, y, z = map(float, direction)
    light = DistantLight(type="distant", direction=(x, y, z), irradiance=(1.0, 1.0, 1.0))
    channel = int((radiance - ambient).mean(axis=(0, 1)).argmax())  # in the others of a coloured lamp there is noise
    seen, dark = (np.repeat(np.broadcast_to(image, radiance.shape)[..., channel, None], 3, axis=-1) for image in (radiance, ambient))
    residual = fit_brightness(seen - dark, saturated, light, view).residual
    other = better_encoding(seen, saturated, light, view, exposure=exposure, declared=declared, residual=residual, ambient=dark)
    return None if other is None else encoding_flag(declared, *other, residual)


def encoding_flag(declared: str, space: str, left: float, residual: float) -> str:
    """Return the sentence on an encoding that makes the shading of a ball fit better: `left` of it is left, `residual` as declared."""
    return (f"color_space: {declared} is declared, but as {space} the shading of the ball fits to {100 * left:.1f} %, as declared to "
            f"{100 * residual:.1f} %")
