"""Levels for a projector with which its patterns are linear light: by its gamma, or by a response that is measured before them."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from service.acquisition.checks.judge import FULL_SCALE
from service.acquisition.plans.shots import Shot
from service.calibrate.response import EVEN_LEVELS, MOST_PIXELS, Response, fit_response
from service.depth.patterns.projection import stored
from service.errors import RequestError
from service.requests.acquire import AcquireRequest
from stage.colour.colour import GREY_WEIGHTS, linearise
from stage.errors import CalibrationError
from stage.formats import images
from stage.importers.layout import color_space_of
from stage.patterns.base import UniformPattern
from stage.patterns.codes import draw


class PatternImages:
    """The images of the projector of one capture."""

    def __init__(self, request: AcquireRequest, shots: Sequence[Shot]) -> None:
        """Take note of the options. Raises RequestError if both the options and the plan say how the projector responds."""
        self._request, self._measures = request, any(shot.grey is not None for shot in shots)
        self.response: Response | None = None
        """The response of the projector, once the first pattern has been shown through it."""
        if request.gamma != 1 and self._measures:
            raise RequestError(f"--gamma: is {request.gamma:g}, and the plan measures the projector's response: leave one of them out")

    def image(self, shot: Shot, greys: Callable[[], Mapping[float, Path]]) -> np.ndarray:
        """Return what the projector is given for a shot, [rows, cols] or [rows, cols, 3] uint8; black where it shows nothing.
        `greys`: returns the pictures of even grey, by its level. Raises RequestError if those pictures do not show a response; names their
        folder."""
        assert self._request.projector is not None
        if shot.grey is not None:
            return stored(np.full(self._request.projector[::-1], shot.grey), 8, 1.0)
        if shot.pattern is not None and self._measures and self.response is None:
            self.response = self._measured(greys())
        levels = draw(shot.pattern or UniformPattern(code="black"), self._request.projector)
        if self.response is None:
            return stored(levels, 8, self._request.gamma)
        return stored(np.interp(levels, self.response.values, np.linspace(0, 1, EVEN_LEVELS)), 8, 1.0)

    def entry(self) -> dict[str, Any] | None:
        """Return the response as the report holds it; None where none was measured."""
        found = self.response
        return None if found is None else {"gamma": float(f"{found.gamma:.4g}"), "spread": float(f"{found.spread:.3g}"),
                                           "values": [float(f"{value:.7g}") for value in found.values]}

    def _measured(self, pictures: Mapping[float, Path]) -> Response:
        if not pictures:
            raise RequestError("projector-response: none of its pictures came: look at the camera, and run the same command again")
        usable, readings = [], []
        for path in pictures.values():
            recorded = images.read_pixels(path)
            step = max(1, int(np.ceil(np.sqrt(recorded[..., 0].size / MOST_PIXELS))))
            sparse = recorded[::step, ::step].astype(np.float32).reshape(-1, 3)
            usable.append((sparse < (self._request.saturation or FULL_SCALE)).all(axis=-1))
            readings.append(linearise(sparse, self._request.color_space or color_space_of(path)) @ np.array(GREY_WEIGHTS, np.float32))
        try:
            return fit_response(tuple(pictures), np.array(readings), usable=np.all(usable, axis=0))
        except CalibrationError as error:
            raise RequestError(f"{next(iter(pictures.values())).parent}: {error}") from error
