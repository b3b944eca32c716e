"""The images of a capture under its lights, opened once for everything that is made of them."""

from typing import NamedTuple

import numpy as np

from service.reporting.progress import Timings
from service.requests.view import ViewRequest
from stage.brackets import merge_brackets, one_frame_a_light
from stage.capture import Capture
from stage.ingest import open_stack
from stage.light import DistantLight, PointLight
from stage.lighting import lights_from_centre
from stage.motion.tracking import tracking_frames
from stage.point_lights import DistantLights, PlacedLights, place_lights
from stage.stack import Stack


class Readings(NamedTuple):
    """The stack of a capture and its lights."""

    capture: Capture
    stack: Stack
    """Exposures of one light are merged."""
    lights: DistantLights | None
    """The lights, near ones as the object's centre sees them; None: there are some of other kinds."""

    def model_lights(self, factors: np.ndarray | None) -> DistantLights | PlacedLights | None:
        """Return the lights where they are, with the intensities that the maps were solved with; None as for `lights`.

        Args:
            factors: [lights] of the solve, one for each light whatever its exposures; None: all are 1.
        """
        if self.lights is None:
            return None
        if self.capture.lit_by(PointLight):
            return place_lights(self.capture)
        kept = one_frame_a_light(self.stack, self.lights)[1]
        if factors is None or len(factors) != len(kept.direction):
            return self.lights
        same = (self.lights.direction @ kept.direction.T).argmax(axis=1)
        return self.lights._replace(irradiance=self.lights.irradiance * factors[same, None])


def open_readings(capture: Capture, request: ViewRequest, timings: Timings) -> Readings:
    """Open the stack of a capture that has light frames.

    Raises:
        StageError: an image cannot be used, near lights have no scale, or the cache cannot be written; names file and field.
    """
    single = all(isinstance(frame.light, DistantLight | PointLight) for frame in capture.sources())
    lights = lights_from_centre(capture) if single else None
    tracking = tracking_frames(capture, to=request.align_to) if request.aligned else None
    timings.stage("ingest", len(capture.sources()))
    stack = open_stack(capture, cache=request.cache, tracking=tracking, progress=lambda done, _: timings.advance(done))
    return Readings(capture, stack if lights is None else merge_brackets(stack, capture.sources(), lights), lights)
