"""Publish a capture as a folder of static files, whole or not at all."""

import json
from html import escape
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import NamedTuple

import numpy as np

from kernels import device as devices
from service import __version__
from service.basis.capture import BasisCapture, display_of, open_capture, stored_sample
from service.errors import RequestError
from service.publish.annotations import Annotation, read_annotations
from service.publish.iiif import MANIFEST_FILE, write_iiif
from service.publish.planes import INFO_FILE, write_planes
from service.reporting.progress import Progress, Timings
from service.reporting.provenance import REPORT_FILE, other_inputs
from service.requests.publish import PublishedAs, PublishRequest
from service.viewing.result_layers import ResultLayers
from service.viewing.view_files import result_file
from stage.capture.manifest import FILE_NAME
from stage.errors import ManifestError, storage
from stage.files import replacing_folder, write_text
from stage.results.maps import SurfaceMaps

PUBLICATION_FILE, SCHEMA = "publication.json", "relit.publication/1"
"""The file by which a folder is known as one that this command has made."""
PAGE_FILE = "index.html"
LEAST_LIGHTS = 3


class PublishResult(NamedTuple):
    """What was published."""

    path: Path
    """The file to open or to name to a viewer."""
    files: int
    size: int
    """Bytes of all files."""
    near_lights: int
    left_out: int
    """Number of lights that are not in front of the object."""
    levels_rms: float | None
    """Root mean square difference of the planes from the captured images, in steps of an 8-bit display; None: there are no planes."""
    warnings: tuple[str, ...]


def publish(request: PublishRequest, progress: Progress | None = None) -> PublishResult:
    """Publish a capture.

    Raises:
        RequestError: the folder holds something else, or an option does not fit the capture.
        StageError: capture, maps or annotations cannot be used.
    """
    request = _with_capture(request.model_copy(update={"out": request.out.resolve()}))
    _check(request.out)
    timings = Timings(progress)
    device = devices.resolve(request.device)
    source = open_capture(request, timings)
    camera = source.capture.camera
    annotations = read_annotations(request.annotations, camera.width, camera.height)
    maps = None if request.maps is None else ResultLayers(result_file(request.maps), source.capture)
    if maps is not None and maps.of_depth:
        raise RequestError(f"--maps {request.maps}: holds a depth: give a folder with maps.exr")
    if maps is not None:
        SurfaceMaps.read(maps.path, layers=("normal", "height", "part"))  # which refuses normals of another frame
    doubt = None if maps is None else other_inputs(maps.provenance, source.stack.key, maps.path)
    front = np.flatnonzero(source.lights.direction[:, 2] > 0)
    if len(front) < LEAST_LIGHTS:
        raise ManifestError(f"{source.where}: frames: {len(front)} are lit from in front of the object (z > 0): relit publish needs "
                            f"{LEAST_LIGHTS} or more")
    sample = stored_sample(source, front)
    display = display_of(source, front, sample, "relit publish")
    loss = None
    with replacing_folder(request.out) as folder:
        if request.kind is PublishedAs.IIIF:
            write_iiif(folder, source, display, maps, request, annotations, device, timings)
        else:
            loss = write_planes(folder, source, display, sample, device, timings, quality=request.quality,
                                whole=request.kind is PublishedAs.OPENLIME)
            if request.kind is PublishedAs.WEB:
                _write_page(folder, source, request, annotations)
        write_text(folder / PUBLICATION_FILE, json.dumps({
            "schema": SCHEMA, "as": request.kind, "version": __version__, "provenance": source.provenance,
            "entries": sorted(path.name for path in folder.iterdir())}, indent=1) + "\n")
        sizes = [path.stat().st_size for path in folder.rglob("*") if path.is_file()]
    timings.close()
    first = {PublishedAs.IIIF: MANIFEST_FILE, PublishedAs.OPENLIME: INFO_FILE, PublishedAs.WEB: PAGE_FILE}[request.kind]
    return PublishResult(request.out / first, len(sizes), sum(sizes), source.near, source.stack.light_count - len(front),
                         loss, (*source.warnings, *(() if doubt is None else (doubt,))))


def _write_page(folder: Path, source: BasisCapture, request: PublishRequest, annotations: list[Annotation]) -> None:
    """Write the page that lights the planes beside it live: static files that need no server but one that serves files."""
    title = request.title or source.capture.name
    for file in files("service.publish").joinpath("static").iterdir():
        text = file.read_text(encoding="utf-8")
        if file.name == PAGE_FILE:
            text = Template(text).substitute(title=escape(title), attribution=escape(request.attribution or ""))
        write_text(folder / file.name, text)
    scene = {"schema": "relit.scene/1", "title": title, "notes": [note._asdict() for note in annotations]}
    write_text(folder / "scene.json", json.dumps(scene) + "\n")


def _with_capture(request: PublishRequest) -> PublishRequest:
    """Return the request for the capture of results, whose maps are shown too where pages have them, if it is for a folder of results."""
    folder = request.capture
    if (folder / FILE_NAME).exists() or not (folder / REPORT_FILE).is_file():
        return request
    try:
        named = str(json.loads((folder / REPORT_FILE).read_bytes())["inputs"]["capture"])
    except (ValueError, LookupError, TypeError, RecursionError) as error:
        raise RequestError(f"{folder / REPORT_FILE}: names no capture: give the folder of the capture") from error
    if not (Path(named) / FILE_NAME).is_file():
        raise RequestError(f"{folder}: holds results of the capture {named}, which is not there: give the folder of the capture")
    shown = request.kind is PublishedAs.IIIF and request.maps is None
    return request.model_copy(update={"capture": Path(named), "maps": folder if shown else request.maps})


def _check(out: Path) -> None:
    """Refuse a folder that holds something else than a publication."""
    with storage("read", out):
        if out.exists() and not out.is_dir():
            raise RequestError(f"--to {out}: is a file: give a folder")
        there = {path.name for path in out.iterdir()} - {PUBLICATION_FILE} if out.is_dir() else set()
        if foreign := there - _entries(out / PUBLICATION_FILE):
            raise RequestError(f"--to {out}: holds {min(foreign)}, which relit publish has not made: give another folder")


def _entries(file: Path) -> set[str]:
    """Return what lies in a publication, as its file says; nothing if it is none of ours."""
    try:
        found = json.loads(file.read_bytes())
        return set(found["entries"]) if found["schema"] == SCHEMA else set()
    except (FileNotFoundError, ValueError, LookupError, TypeError, RecursionError):
        return set()
