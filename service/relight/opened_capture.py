"""A capture that is relit, the only one or that of a time step; of a sequence, each is opened only while its frame is made."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from service.errors import RequestError
from service.relight.layers import maps_file
from service.relight.schedule import ScheduledFrame
from service.requests.relight import RelightRequest
from stage.capture.capture import Capture
from stage.capture.light import PointLight
from stage.capture.lighting import lights_from_centre
from stage.capture.point_lights import DistantLights
from stage.colour.colour_spaces import linear_space
from stage.motion.tracking import tracking_frames
from stage.results.maps import capture_as_solved
from stage.stack.ingest import Ingest


class OpenedCapture(NamedTuple):
    """A capture whose frames are about to be made."""

    capture: Capture
    lights: DistantLights
    near_lights: int
    """Number of point lights that are taken as distant ones."""
    ingest: Ingest
    maps: Path | None
    """The file of its solved maps."""
    space: str
    """The scene-linear space of its stack."""


def open_capture(folder: Path, request: RelightRequest, captures: int, frames: Sequence[ScheduledFrame]) -> OpenedCapture:
    """Open the capture of a time step, from which frames will be made; no image is read.

    The caches and maps of several `captures` lie in folders named as theirs.
    """
    capture = Capture.open(folder, request.pixels)
    images = {frame.image for frame in capture.sources()}
    for image in {image: None for frame in frames for image in frame.captured}:
        if image not in images:
            raise RequestError(f"{request.keys}: captured: {image} is no image of {capture.folder} that a light lit")
    tracking = tracking_frames(capture, to=request.align_to) if request.aligned else None
    cache = request.cache / folder.name if request.cache is not None and captures > 1 else request.cache
    maps = None if request.maps is None else maps_file(request.maps, folder, captures)
    if maps is not None:
        capture = capture_as_solved(capture, maps)
    return OpenedCapture(capture, lights_from_centre(capture), len(capture.lit_by(PointLight)),
                         Ingest.of(capture, cache=cache, tracking=tracking), maps, linear_space(capture.manifest.color_space))
