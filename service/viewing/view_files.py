"""Write what the pages of the service show of a capture and of its maps: view.json, view.bin and pictures (docs/view.md)."""

import json
from collections.abc import Callable
from contextlib import closing, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np
from pydantic import BaseModel, ValidationError

from kernels import device as devices
from kernels.errors import DeviceError, KernelError
from service.captures.info import standing_faults
from service.relight.outputs import check_outputs
from service.reporting.progress import Progress, Timings
from service.reporting.provenance import REPORT_FILE, metadata, other_manifest
from service.requests.captures import ViewRequest
from service.viewing.block_file import BlockFile
from service.viewing.capture_frames import describe_frames, read_images, write_thumbnails
from service.viewing.card import PICTURE_FILE, SHEET_FILE, write_photograph
from service.viewing.layers import status_codes, write_layers
from service.viewing.pixel_readings import write_samples
from service.viewing.points import write_points
from service.viewing.relighting import LEAST_LIGHTS, write_relighting
from service.viewing.result_layers import ResultLayers
from stage.capture.capture import Capture
from stage.capture.light import DistantLight, PointLight
from stage.capture.lighting import has_placeholders, lights_from_centre
from stage.capture.point_lights import DistantLights, PlacedLights, place_lights
from stage.colour.colour import rgb_matrix
from stage.colour.colour_spaces import NAMES, linear_space
from stage.colour.radiance import clipping_sentences
from stage.errors import ResultError, StageError, StorageError, storage
from stage.files import replacing, write_text
from stage.folders import advice
from stage.motion.tracking import tracking_frames
from stage.results.depth_maps import DEPTH_FILE
from stage.results.light_basis import numbers
from stage.results.maps import MAPS_FILE, capture_as_solved
from stage.results.matte import matte_of
from stage.stack.brackets import merge_brackets, one_frame_a_light
from stage.stack.fingerprint import digest
from stage.stack.ingest import open_stack
from stage.stack.stack import Stack


class Readings(NamedTuple):
    """The stack of a capture and its lights."""

    capture: Capture
    stack: Stack
    """Exposures of one light are merged."""
    lights: DistantLights | None
    """The lights, near ones as the object's centre sees them; None: there are some of other kinds."""

    def model_lights(self, factors: np.ndarray | None) -> DistantLights | PlacedLights | None:
        """Return the lights where they are, with the intensities that the maps were solved with; None as for `lights`.

        The solve has one factor for each light whatever its exposures; without factors all are 1.
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
    """Open the stack of a capture that has light frames."""
    single = all(isinstance(frame.light, DistantLight | PointLight) for frame in capture.sources())
    lights = lights_from_centre(capture) if single else None
    tracking = tracking_frames(capture, to=request.align_to) if request.aligned else None
    timings.stage("ingest", len(capture.sources()))
    stack = open_stack(capture, cache=request.cache, tracking=tracking, progress=lambda done, _: timings.advance(done))
    return Readings(capture, stack if lights is None else merge_brackets(stack, capture.sources(), lights), lights)


Made = TypeVar("Made")
SCHEMA = "relit.view/1"
VIEW_FILE, BLOCKS_FILE, THUMBNAILS_FILE = "view.json", "view.bin", "thumbnails.jpg"

UNMEASURED = ("nobody has measured where the lights were, so that the capture cannot be relit as it is: a solve with lights that are found "
              "from the images shows it under these, and a calibration measures them")
"""The finding of a capture whose lights are placeholders."""
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
    levels: tuple[float, float] | None
    """Mean difference of relit pictures from those of `relit relight` under lights that the images were not made from, in 255ths of the
    display's range: mean of the lights, and largest; None: there are no coefficient images."""
    findings: tuple[str, ...]
    """Faults of the capture, in sentences."""


def view(request: ViewRequest, progress: Progress | None = None) -> ViewResult:
    """Write what a browser needs to show a capture and its maps.
    Raises RequestError if a file of the view would replace one of the capture. Raises ResultError if the maps are missing, incomplete or of
    another camera than the capture. Raises StageError if the capture cannot be opened; a frame that cannot be used is among the findings
    instead. Raises StorageError if a file cannot be written; view.json is there only if everything is."""
    timings = Timings(progress)
    device = devices.resolve(request.device)
    timings.stage("open", 1)
    capture = Capture.open(request.capture, request.pixels)
    _check_outputs(request, capture)
    result = None if request.maps is None else ResultLayers(result_file(request.maps), capture)
    report = SolveReport([], {}, None) if result is None else read_report(result.path)
    if result is not None and not result.of_depth:
        capture = capture_as_solved(report.lit(capture), result.path)
    mask = _mask(capture)
    images = read_images(capture, mask, timings)
    findings = list(dict.fromkeys([*images.faults, *standing_faults(capture)]))
    if result is not None and (doubt := other_manifest(result.camera, result.provenance, capture, result.path)) is not None:
        findings.append(doubt)
    space = linear_space(capture.manifest.color_space)
    target = request.out / VIEW_FILE
    sections: dict[str, Any] = {"layers": [], "relight": None, "samples": None, "points": None}
    with storage("write", target), replacing(request.out / BLOCKS_FILE) as temporary, closing(BlockFile(temporary)) as file:
        if result is not None and result.has_depth:
            timings.stage("points", 1)
            sections["points"] = write_points(result, file)
        if result is not None:
            sections["layers"] = write_layers(result, file, timings)
        if unmeasured := has_placeholders(capture):
            findings.append(UNMEASURED)
        readings = (_attempt(findings, lambda: open_readings(capture, request, timings))
                    if capture.sources() and images.usable and not unmeasured else None)
        if readings is not None:
            sections["relight"] = _attempt(findings, lambda: _relight(readings, request, file, device, timings))
            if result is not None and not result.of_depth:
                sections["samples"] = _attempt(findings, lambda: write_samples(
                    readings.stack, mask.shape, result, readings.model_lights(report.factors), file, doubts=findings, device=device,
                    timings=timings))
        timings.stage("write", 1)
        target.unlink(missing_ok=True)  # it would describe other blocks
    findings += clipping_sentences(capture.clipped)
    if sections["relight"] is None:
        _attempt(findings, lambda: write_photograph(request.out, capture, images, mask, space))
    thumbnails = write_thumbnails(request.out / THUMBNAILS_FILE, images, space)
    findings = [*findings[:MOST_FINDINGS], *([f"and {len(findings) - MOST_FINDINGS} more"] if len(findings) > MOST_FINDINGS else [])]
    contents = {} if result is None else {"maps": digest(result.path)}
    write_text(target, json.dumps({
        "schema": SCHEMA, "name": capture.name, "rows": capture.camera.height, "cols": capture.camera.width, "color_space": space,
        "to_rec709": None if space in NAMES else numbers(rgb_matrix(space, "lin_rec709_scene").ravel()),
        "camera": capture.camera.model_dump(mode="json", exclude_none=True),
        "exposure": numbers(1 / images.white) if images.white > 0 else 1.0,
        "codes": status_codes(),
        "frames": describe_frames(capture, images, thumbnails, report.suspects),
        "findings": findings,
        "warnings": report.warnings,
        "assumed": capture.manifest.assumed,
        **sections,
        "provenance": metadata(request, capture=capture.name, inputs="" if readings is None else readings.stack.key,
                               contents=contents),
    }, allow_nan=False) + "\n")
    timings.close()
    relight = sections["relight"]
    levels = None if relight is None else (relight["held_out"]["mean_levels"], relight["held_out"]["largest_levels"])
    return ViewResult(target, tuple(layer["name"] for layer in sections["layers"]), len(images.images),
                      0 if relight is None else relight["terms"], levels, tuple(findings))


def _attempt(findings: list[str], work: Callable[[], Made]) -> Made | None:
    """Return what some work makes, or None where the capture does not allow it, which the findings then say."""
    try:
        return work()
    except (StageError, KernelError) as error:
        if isinstance(error, StorageError | DeviceError):
            raise
        findings += [str(error)] if str(error) not in findings else []
        return None


def _relight(readings: Readings, request: ViewRequest, file: BlockFile, device: str, timings: Timings) -> dict[str, Any] | None:
    """Write what an object is lit with; None: it has too few lights."""
    if readings.lights is None or len(readings.lights.direction) < LEAST_LIGHTS:
        return None
    timings.stage("matte", 1)
    return write_relighting(readings.stack, readings.lights, matte_of(readings.capture, readings.stack), file, most_terms=request.terms,
                            device=device, timings=timings, folder=request.out, space=linear_space(readings.capture.manifest.color_space))


def _check_outputs(request: ViewRequest, capture: Capture) -> None:
    """Refuse to write over an input, or into a folder that cannot be written to."""
    outputs = [(f"--out {request.out}", request.out / name) for name in (VIEW_FILE, BLOCKS_FILE, THUMBNAILS_FILE, PICTURE_FILE, SHEET_FILE)]
    check_outputs(outputs, [capture.file(name) for _, name in capture.files()])


def result_file(maps: Path) -> Path:
    """Return the maps.exr or depth.exr of a folder, or the file that was given."""
    if not maps.is_dir():
        if maps.is_file():
            return maps
        raise ResultError(f"{maps}: is not there: run `relit solve` or `relit depth` first")
    for name in (MAPS_FILE, DEPTH_FILE):
        if (maps / name).is_file():
            return maps / name
    advised = advice(maps, "run `relit solve` or `relit depth` first", of_result=True)
    raise ResultError(f"{maps}: holds neither {MAPS_FILE} nor {DEPTH_FILE}: {advised}")


def _mask(capture: Capture) -> np.ndarray:
    """Return the mask of a capture; all pixels where it cannot be used, which the findings say."""
    with suppress(StageError):
        return capture.mask()
    return np.ones((capture.camera.height, capture.camera.width), dtype=bool)


class _Suspect(BaseModel):
    image: str
    misfit: float


class _Factors(BaseModel):
    believed: bool
    factors: list[float] = []


class _Estimated(BaseModel):
    factors: list[float] | None = None


class _Lights(BaseModel):
    directions: list[tuple[float, float, float]]
    irradiance: list[float]


class _Found(BaseModel):
    unknown_lights: _Lights | None = None
    light_intensities: _Estimated = _Estimated()
    light_factors: _Factors | None = None


class _Report(BaseModel):
    warnings: list[str] = []
    suspect_lights: list[_Suspect] = []
    found: _Found = _Found()


class SolveReport(NamedTuple):
    """Content of the report of a solve or a depth."""

    warnings: list[str]
    """Sentences."""
    suspects: dict[str, str]
    """A sentence for each image whose light disagrees with the others."""
    factors: np.ndarray | None
    """[lights] factors on the intensities of the manifest that the maps were solved with; None: all are 1."""
    lights: DistantLights | None = None
    """The lights that a solve found from the images; None: they are those of the manifest."""

    def lit(self, capture: Capture) -> Capture:
        """Return the capture with the lights that the solve found in place of placeholders.
        Raises ResultError if the solve found those of another number of frames."""
        if self.lights is None or not has_placeholders(capture):
            return capture
        if len(self.lights.direction) != len(capture.sources()):
            raise ResultError(f"{capture.folder}: has {len(capture.sources())} lit frames, and the maps come from a solve that has found "
                              f"the lights of {len(self.lights.direction)}: solve again")
        found = {frame.image: {"direction": (x, y, z), "irradiance": (r, g, b)} for frame, (x, y, z), (r, g, b) in zip(
            capture.sources(), self.lights.direction.tolist(), self.lights.irradiance.tolist(), strict=True)}
        frames = [frame.model_copy(update={"light": frame.light.model_copy(update=found[frame.image])})
                  if frame.light is not None and frame.image in found else frame for frame in capture.manifest.frames]
        return replace(capture, manifest=capture.manifest.model_copy(update={"frames": tuple(frames)}),
                       whole=None if capture.whole is None else self.lit(capture.whole))


def read_report(maps: Path) -> SolveReport:
    """Read the report.json beside a maps.exr or depth.exr; where there is none, nothing is known."""
    path = maps.parent / REPORT_FILE
    if not path.is_file():
        return SolveReport([], {}, None)
    with storage("read", path):
        text = path.read_bytes()
    try:
        found = _Report.model_validate(json.loads(text))
    except (ValueError, ValidationError) as error:
        raise ResultError(f"{path}: is not a report of relit: solve again, or take it away") from error
    suspects = {suspect.image: f"disagrees with the other lights by {100 * suspect.misfit:.0f} %: check its direction and irradiance"
                for suspect in found.suspect_lights}
    lights = found.found.unknown_lights
    return SolveReport(found.warnings, suspects, _factors(found.found), None if lights is None else DistantLights(
        np.array(lights.directions), np.repeat(np.array(lights.irradiance)[:, None], 3, axis=1)))


def _factors(found: _Found) -> np.ndarray | None:
    """Return the factors that a solve estimated before it began, times those that it refined, or None where it did neither."""
    refined = found.light_factors
    factors = [np.array(values) for values in (found.light_intensities.factors,
                                               refined.factors if refined is not None and refined.believed else None)
               if values is not None]
    return np.prod(factors, axis=0) if factors else None
