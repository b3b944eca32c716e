"""The captures that are relit: one, or a sequence with one capture for each time step, in order of name. Each is opened only while its
frame is made."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from service.errors import RequestError
from service.light.layers import maps_file
from service.light.schedule import ScheduledFrame
from service.requests.relight import RelightRequest
from stage.capture import Capture
from stage.colour_spaces import linear_space
from stage.ingest import Ingest
from stage.light import PointLight
from stage.lighting import lights_from_centre
from stage.manifest import FILE_NAME, read_manifest
from stage.motion.tracking import tracking_frames
from stage.point_lights import DistantLights
from stage.sequence import difference, is_sequence, read_sequence

SHARED = {"camera.resolution": "resolution", "color_space": "colour space"}
"""Fields of the manifest that the captures of a relit sequence share, and their words."""


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


def time_steps(path: Path) -> list[Path]:
    """Return the capture folders that frames are made from.

    Args:
        path: a capture, or a sequence: a sequence.json, its folder, or a folder without capture.json whose sub-folders have one.

    Returns:
        The captures in the order of the file, else in order of name; the path alone where it is no sequence.

    Raises:
        RequestError: two captures differ in resolution or colour space.
        ManifestError: a capture.json is wrong; names the field.
        StorageError: a folder cannot be read.
    """
    if not is_sequence(path):
        return [path]
    folders = [step.folder for step in read_sequence(path).steps]
    first = read_manifest(folders[0] / FILE_NAME)
    for folder in folders[1:]:
        if (apart := difference(read_manifest(folder / FILE_NAME), first, SHARED)) is not None:
            raise RequestError(f"{folder}: is {apart.value}, {folders[0].name} {apart.other}: the captures of a sequence share one "
                               f"{SHARED[apart.field]}")
    return folders


def capture_files(folder: Path) -> Iterator[Path]:
    """Yield every file that a capture is read from; where there is no manifest, nothing: opening the capture says so.

    Raises:
        ManifestError: the manifest is wrong; names the field.
    """
    manifest = folder if folder.name == FILE_NAME else folder / FILE_NAME
    if manifest.is_file():
        yield manifest
        capture = Capture(manifest.parent, read_manifest(manifest))
        for _, name in capture.files():
            yield capture.file(name)


def open_capture(folder: Path, request: RelightRequest, captures: int, frames: Sequence[ScheduledFrame]) -> OpenedCapture:
    """Open the capture of a time step; no image is read.

    Args:
        folder: of the capture.
        request: the whole request.
        captures: how many there are; the caches and maps of several lie in folders named as theirs.
        frames: that are made from this capture.

    Raises:
        StageError: bad input; names file and field.
        RequestError: its maps are not there, or light keys name an image that it has not.
    """
    capture = Capture.open(folder, request.pixels)
    images = {frame.image for frame in capture.sources()}
    for image in {image: None for frame in frames for image in frame.captured}:
        if image not in images:
            raise RequestError(f"{request.keys}: captured: {image} is no image of {capture.folder} that a light lit")
    tracking = tracking_frames(capture, to=request.align_to) if request.aligned else None
    cache = request.cache / folder.name if request.cache is not None and captures > 1 else request.cache
    maps = None if request.maps is None else maps_file(request.maps, folder, captures)
    return OpenedCapture(capture, lights_from_centre(capture), len(capture.lit_by(PointLight)),
                         Ingest.of(capture, cache=cache, tracking=tracking), maps, linear_space(capture.manifest.color_space))
