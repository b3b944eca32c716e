"""Write what the pages of the service show of a capture and of its maps: view.json, view.bin and thumbnails.jpg (docs/view.md)."""

import json
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from kernels import device as devices
from kernels.errors import KernelError
from service.captures.inspect import standing_faults
from service.reporting.progress import Progress, Timings
from service.reporting.provenance import metadata
from service.requests.view import ViewRequest
from service.viewing.block_file import BlockFile
from service.viewing.capture_frames import describe_frames, read_images
from service.viewing.layers import status_codes, write_layers
from service.viewing.relighting import LEAST_LIGHTS, write_relighting
from service.viewing.result_layers import ResultLayers
from service.viewing.thumbnails import write_thumbnails
from stage.brackets import merge_brackets
from stage.capture import Capture
from stage.colour_spaces import linear_space
from stage.depth_maps import DEPTH_FILE
from stage.errors import ResultError, StageError, storage
from stage.files import replacing, write_text
from stage.ingest import open_stack
from stage.light import DistantLight, PointLight
from stage.light_basis import numbers
from stage.lighting import lights_from_centre
from stage.maps import MAPS_FILE
from stage.matte import matte_of
from stage.motion.tracking import tracking_frames

SCHEMA = "relit.view/1"
VIEW_FILE, BLOCKS_FILE, THUMBNAILS_FILE = "view.json", "view.bin", "thumbnails.jpg"
MOST_FINDINGS = 100
"""Most sentences of what is wrong with a capture, so that view.json stays small."""


class ViewResult(NamedTuple):
    """The files of a view, and what its user should know."""

    path: Path
    """view.json."""
    layers: tuple[str, ...]
    frames: int
    terms: int
    """Coefficient images to relight with; 0: there are too few lights, or they cannot be used."""
    relative_rms: float | None
    findings: tuple[str, ...]
    """What is wrong with the capture, in sentences."""


def view(request: ViewRequest, progress: Progress | None = None) -> ViewResult:
    """Write what a browser needs to show a capture and its maps.

    Args:
        request: the capture, the maps if there are any, and the folder of the results.
        progress: told of every stage.

    Raises:
        ResultError: the maps are missing, incomplete or of another camera than the capture.
        StageError: the capture cannot be opened; a frame that cannot be used is among the findings instead.
        StorageError: a file cannot be written; view.json is there only if everything is.
    """
    timings = Timings(progress)
    device = devices.resolve(request.device)
    timings.stage("open", 1)
    capture = Capture.open(request.capture)
    result = None if request.maps is None else ResultLayers(result_file(request.maps), capture)
    findings = standing_faults(capture)
    mask = _mask(capture)
    images = read_images(capture, mask, timings)
    findings = [*images.faults, *(fault for fault in findings if fault not in images.faults)]
    space = linear_space(capture.manifest.color_space)
    target = request.out / VIEW_FILE
    with storage("write", target), replacing(request.out / BLOCKS_FILE) as temporary, BlockFile(temporary) as file:
        layers = [] if result is None else write_layers(result, file, timings)
        relight = None
        if sum(isinstance(frame.light, DistantLight | PointLight) for frame in capture.sources()) >= LEAST_LIGHTS:
            try:
                relight = _relight(capture, request, file, device, timings)
            except (StageError, KernelError) as error:
                findings += [str(error)] if str(error) not in findings else []
        timings.stage("write", 1)
        target.unlink(missing_ok=True)  # it would describe other blocks
    thumbnails = write_thumbnails(request.out / THUMBNAILS_FILE, images, space)
    findings = [*findings[:MOST_FINDINGS], *([f"and {len(findings) - MOST_FINDINGS} more"] if len(findings) > MOST_FINDINGS else [])]
    write_text(target, json.dumps({
        "schema": SCHEMA, "name": capture.name, "rows": capture.camera.height, "cols": capture.camera.width, "color_space": space,
        "camera": capture.camera.model_dump(mode="json", exclude_none=True),
        "exposure": numbers(1 / images.white) if images.white > 0 else 1.0,
        "layers": layers,
        "codes": status_codes(),
        "frames": describe_frames(capture, images, thumbnails, {}),
        "findings": findings,
        "relight": relight,
        "samples": None,
        "points": None,
        "provenance": metadata(request, capture=capture.name, inputs="" if result is None else result.provenance.get("relit:inputs", "")),
    }, allow_nan=False) + "\n")
    timings.close()
    return ViewResult(target, tuple(layer["name"] for layer in layers), len(images.images), 0 if relight is None else relight["terms"],
                      None if relight is None else relight["relative_rms"], tuple(findings))


def result_file(maps: Path) -> Path:
    """Return the maps.exr or depth.exr of a folder, or the file that was given.

    Raises:
        ResultError: neither is there.
    """
    if not maps.is_dir():
        if maps.is_file():
            return maps
        raise ResultError(f"{maps}: is not there: run `relit solve` or `relit depth` first")
    for name in (MAPS_FILE, DEPTH_FILE):
        if (maps / name).is_file():
            return maps / name
    raise ResultError(f"{maps}: holds neither {MAPS_FILE} nor {DEPTH_FILE}: run `relit solve` or `relit depth` first")


def _mask(capture: Capture) -> np.ndarray:
    """Return the mask of a capture; all pixels where it cannot be used, which the findings say."""
    with suppress(StageError):
        return capture.mask()
    return np.ones((capture.camera.height, capture.camera.width), dtype=bool)


def _relight(capture: Capture, request: ViewRequest, file: BlockFile, device: str, timings: Timings) -> dict[str, Any] | None:
    lights = lights_from_centre(capture)
    tracking = tracking_frames(capture, to=request.align_to) if request.aligned else None
    timings.stage("ingest", len(capture.sources()))
    stack = merge_brackets(open_stack(capture, cache=request.cache, tracking=tracking, progress=lambda done, _: timings.advance(done)),
                           capture.sources(), lights)
    timings.stage("matte", 1)
    return write_relighting(stack, lights, matte_of(capture, stack), file, most_terms=request.terms, device=device, timings=timings)
