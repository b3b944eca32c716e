"""The response of a projector, measured from pictures of even grey before its patterns are shown."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from service.calibrate.response import EVEN_LEVELS, MOST_PIXELS, Response, fit_response
from service.depth.patterns.projection import stored
from service.errors import RequestError
from stage.colour.colour import GREY_WEIGHTS, linearise
from stage.colour.colour_spaces import ColorSpaceName
from stage.errors import CalibrationError
from stage.formats import images
from stage.importers.layout import color_space_of


def measure(pictures: Mapping[float, Path], space: ColorSpaceName | None, full_scale: float) -> Response:
    """Return the response of a projector; see `service.calibrate.response`.

    Args:
        pictures: those under each level, 0 to 1 of full, that the projector has shown everywhere.
        space: the colour space of the pictures; None: that which their files suggest.
        full_scale: the recorded value from which readings are clipped.

    Raises:
        RequestError: the pictures do not show a response; names their folder.
    """
    usable, readings = [], []
    for path in pictures.values():
        recorded = images.read_pixels(path)
        step = max(1, int(np.ceil(np.sqrt(recorded[..., 0].size / MOST_PIXELS))))
        sparse = recorded[::step, ::step].astype(np.float32).reshape(-1, 3)
        usable.append((sparse < full_scale).all(axis=-1))
        readings.append(linearise(sparse, space or color_space_of(path)) @ np.array(GREY_WEIGHTS, np.float32))
    try:
        return fit_response(tuple(pictures), np.array(readings), usable=np.all(usable, axis=0))
    except CalibrationError as error:
        raise RequestError(f"{next(iter(pictures.values())).parent}: {error}") from error


def shown_through(response: Response, levels: np.ndarray) -> np.ndarray:
    """Return what a projector is given so that it shows levels, 0 to 1, in linear light, as uint8."""
    return stored(np.interp(levels, response.values, np.linspace(0, 1, EVEN_LEVELS)), 8, 1.0)
