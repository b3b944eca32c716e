"""One time step: a capture, its lights, and the hashes by which frames of an earlier run are known."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from service.errors import RequestError
from service.light.environments import Environments
from service.light.frames import request_hash
from service.light.layers import maps_file, read_maps, still_layers
from service.light.schedule import FrameLighting
from service.requests.picture import Layer
from service.requests.relight import RelightRequest
from stage import fingerprint
from stage.capture import Capture
from stage.colour_spaces import linear_space
from stage.ingest import Ingest
from stage.light import PointLight
from stage.lighting import lights_from_centre
from stage.maps import SurfaceMaps
from stage.motion.tracking import tracking_frames
from stage.point_lights import DistantLights


class Step(NamedTuple):
    """A capture that is about to be relit."""

    capture: Capture
    lights: DistantLights
    near_lights: int
    """Point lights that are taken as distant ones."""
    ingest: Ingest
    maps: Path | None
    space: str
    """Scene-linear, of its stack."""

    def solved(self) -> SurfaceMaps | None:
        """The solved maps, where some are named."""
        return None if self.maps is None else read_maps(self.maps, self.capture)

    def layers(self, layers: Sequence[Layer], maps: SurfaceMaps | None) -> dict[str, np.ndarray]:
        """The layers that its frames share: channel → [rows, cols] float16."""
        return still_layers(layers, self.capture, maps, self.maps)


def open_step(folder: Path, request: RelightRequest, steps: int, lighting: Sequence[FrameLighting]) -> Step:
    """Open the capture of a time step.

    Args:
        folder: of the capture.
        request: the whole request.
        steps: how many captures there are; caches and maps of several lie in folders named as theirs.
        lighting: of its frames.

    Raises:
        StageError: bad input; names file and field.
        RequestError: its maps are not there, or light keys name an image that it has not.
    """
    capture = Capture.open(folder)
    images = {frame.image for frame in capture.sources()}
    for image in {image: None for frame in lighting for image in frame.captured}:
        if image not in images:
            raise RequestError(f"{request.keys}: captured: {image} is no image of {capture.folder} that a light lit")
    tracking = tracking_frames(capture, to=request.align_to) if request.aligned else None
    cache = request.cache / folder.name if request.cache is not None and steps > 1 else request.cache
    maps = None if request.maps is None else maps_file(request.maps, folder, steps)
    return Step(capture, lights_from_centre(capture), len(capture.lit_by(PointLight)),
                Ingest.of(capture, cache=cache, tracking=tracking), maps, linear_space(capture.manifest.color_space))


def frame_hashes(step: Step, request: RelightRequest, lighting: Sequence[FrameLighting],
                 environments: Environments | None) -> list[str]:
    """The request hash of each frame: of everything that its pixels depend on.

    Raises:
        StorageError: a map cannot be read.
    """
    mask = step.capture.manifest.mask
    scene = request_hash(
        stack=step.ingest.key, direction=_digits(step.lights.direction), irradiance=_digits(step.lights.irradiance),
        weights=request.weighting, color_space=request.color_space, compression=request.compression, layers=sorted(request.aov),
        maps=None if step.maps is None else fingerprint.digest(step.maps),
        mask=fingerprint.digest(step.capture.file(mask)) if Layer.MASK in request.aov and mask is not None else None)
    return [request_hash(
        scene=scene, stops=frame.stops, captured=frame.captured,
        sky=None if frame.sky is None or environments is None else
        [environments.content(frame.sky.path), frame.sky.stops, _digits(frame.sky.rotation)],
        discs=[[_digits(disc.direction), _digits(disc.irradiance), disc.angle_degrees, disc.color_space] for disc in frame.discs],
    ) for frame in lighting]


def _digits(values: np.ndarray) -> list[float]:
    """Nine digits: what another processor's last bit cannot change."""
    return [float(f"{value:.9g}") + 0.0 for value in np.ravel(values)]
