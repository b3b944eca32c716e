"""Calibration of the sensor: dark.exr, flat.exr and the saturation of a capture, from images with the lens covered, of a white card,
and of anything bright."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from service import __version__
from service.calibrate.results import digits, manifest_to_write, write_results
from service.calibrate.solvers.flat_field import make_flat, mean_image, recorded_values
from service.calibrate.solvers.saturation import TopHistogram, capture_saturation
from service.errors import RequestError
from service.reporting.progress import Progress, Timings
from service.requests.calibrate import DarkRequest, FlatFieldRequest, SaturationRequest
from stage.capture.capture import Capture
from stage.colour.radiance import RAW_STRAY, check_radiance
from stage.errors import CalibrationError
from stage.formats import exr, images
from stage.formats.camera_raw import path_is_raw

DARK_FILE, FLAT_FILE = "dark.exr", "flat.exr"


class ImageCalibration(NamedTuple):
    """The files that a calibration image wrote."""

    manifest_path: Path
    report_path: Path
    image_path: Path
    noise: float
    """Standard deviation of one input image, linear; 0 when there is only one."""


class Saturation(NamedTuple):
    """The level at which readings pile up."""

    level: float
    counts: tuple[int, int, int]
    """Readings at or above it in red, green and blue."""
    manifest_path: Path | None
    report_path: Path | None


def dark(request: DarkRequest, progress: Progress | None = None) -> ImageCalibration:
    """Write the mean of dark images as dark.exr, and name it in the manifest.

    Raises:
        StageError, RequestError: the input is wrong; nothing is written.
    """
    timings = Timings(progress)
    timings.stage("open", 1)
    capture = Capture.open(request.capture)
    manifest_path = manifest_to_write(capture, request.out)
    _refuse_overwrite(request.images, manifest_path.parent / DARK_FILE)
    timings.stage("images", len(request.images))
    mean = mean_image(request.images, capture, progress=timings.advance)
    timings.close()
    return _write(DARK_FILE, "dark", request, capture, manifest_path, mean.pixels.astype(np.float32), {
        "images": mean.images, "noise": float(f"{mean.noise:.4g}"), "mean": digits(mean.pixels.mean(axis=(0, 1)))})


def flat_field(request: FlatFieldRequest, progress: Progress | None = None) -> ImageCalibration:
    """Write the mean of white-card images, less their dark, as flat.exr, and name it in the manifest.

    Raises:
        StageError, RequestError: the input is wrong; nothing is written.
    """
    timings = Timings(progress)
    timings.stage("open", 1)
    capture = Capture.open(request.capture)
    manifest_path = manifest_to_write(capture, request.out)
    _refuse_overwrite([*request.images, *request.dark_images], manifest_path.parent / FLAT_FILE)
    timings.stage("images", len(request.images) + len(request.dark_images))
    white = mean_image(request.images, capture, refuse_saturated=True, progress=timings.advance)
    white_dark = None
    if request.dark_images:
        white_dark = mean_image(request.dark_images, capture, progress=lambda done: timings.advance(white.images + done))
    flat = make_flat(white, white_dark, capture)
    timings.close()
    seen = flat[capture.mask()]
    return _write(FLAT_FILE, "flat", request, capture, manifest_path, flat, {
        "images": white.images, "noise": float(f"{white.noise:.4g}"),
        "least": digits(seen.min(axis=0)), "most": digits(seen.max(axis=0))})


def saturation(request: SaturationRequest, progress: Progress | None = None) -> Saturation:
    """Find the level at which the readings of a capture's frames pile up, and write it to the manifest if the request says so.

    Raises:
        StageError: the input is wrong, or nothing piles up; nothing is written.
    """
    timings = Timings(progress)
    timings.stage("open", 1)
    capture = Capture.open(request.capture)
    manifest_path = manifest_to_write(capture, request.out)
    paths = [capture.file(frame.image) for frame in capture.manifest.frames if Path(frame.image).suffix.lower() != ".npy"]
    timings.stage("peaks", len(paths))
    peaks = np.zeros(3)
    for number, path in enumerate(paths, start=1):
        peaks = np.maximum(peaks, _recorded(path).max(axis=(0, 1)))
        timings.advance(number)
    tops = [TopHistogram(float(peak)) for peak in peaks]
    timings.stage("histogram", len(paths))
    for number, path in enumerate(paths, start=1):
        recorded = _recorded(path)
        for channel, top in enumerate(tops):
            top.add(recorded[..., channel])
        timings.advance(number)
    timings.close()
    channels = [top.saturation() for top in tops]
    try:
        level = capture_saturation(channels)
    except CalibrationError as error:
        raise CalibrationError(f"{capture.folder}: {error}") from error
    counts = channels[0].readings, channels[1].readings, channels[2].readings
    if not request.write and request.out is None:
        return Saturation(level, counts, None, None)
    report = write_results("saturation", request, capture.manifest.model_copy(update={"saturation": level}), manifest_path,
                           {"level": level, "counts": counts})
    return Saturation(level, counts, manifest_path, report)


def _recorded(path: Path) -> np.ndarray:
    pixels = images.read_pixels(path)
    check_radiance(path, pixels, stray=RAW_STRAY if path_is_raw(path) else 0.0)
    return pixels


def _refuse_overwrite(inputs: Sequence[Path], target: Path) -> None:
    for path in inputs:
        if path.exists() and target.exists() and path.samefile(target):
            raise RequestError(f"{path}: is the file that is written: give it another name")


def _write(name: str, field: str, request: DarkRequest | FlatFieldRequest, capture: Capture, manifest_path: Path, linear: np.ndarray,
           section: dict[str, Any]) -> ImageCalibration:
    """Write the image, then the report, and last the manifest that names the image."""
    image_path = manifest_path.parent / name
    recorded = recorded_values(linear, capture)
    channels = {channel: recorded[..., index] for index, channel in enumerate("RGB")}
    kind = "flat-field" if field == "flat" else field
    exr.write(image_path, channels, color_space=capture.manifest.color_space, metadata={
        "relit:version": __version__, "relit:capture": capture.name, "relit:calibration": kind,
        "relit:inputs": " ".join(path.name for path in request.images)})
    report = write_results(kind, request, capture.manifest.model_copy(update={field: name}), manifest_path, section)
    return ImageCalibration(manifest_path, report, image_path, section["noise"])
