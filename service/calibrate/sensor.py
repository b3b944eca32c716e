"""Calibration of the sensor: dark.exr, flat.exr, the saturation and the colours of a capture, from images with the lens covered, of a white
card, of anything bright, and of a grey or white card.

The correction (stage/stack/correction.py) subtracts the dark frame of the manifest from the flat field. The dark frame of the exposure of
the white card is therefore replaced by the dark frame of the manifest.
"""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from service import __version__
from service.calibrate.results import color_matrix, digits, open_capture, write_results
from service.calibrate.solvers.card_faults import BRIGHT, brightness, card_faults, check_alike, check_dark, mixed_colours
from service.calibrate.solvers.saturation_level import ReadingHistogram, capture_saturation, clipped_level
from service.errors import RequestError
from service.reporting.progress import Progress
from service.requests.calibrate import DarkRequest, FlatFieldRequest, SaturationRequest, WhiteBalanceRequest
from stage.capture.capture import Capture
from stage.colour.colour import convert, linearise, rgb_matrix
from stage.colour.colour_spaces import linear_space
from stage.colour.radiance import RAW_STRAY, check_radiance
from stage.errors import CalibrationError, ImageError
from stage.formats import exr, images
from stage.formats.camera_raw import path_is_raw, rec709_from_camera
from stage.pixels import Crop
from stage.stack.correction import saturation_limit

DARK_FILE, FLAT_FILE = "dark.exr", "flat.exr"


class ImageCalibration(NamedTuple):
    """The files that a calibration image wrote."""

    manifest_path: Path
    report_path: Path
    image_path: Path
    noise: float
    """Standard deviation of one input image, linear; 0 when there is only one."""
    warnings: tuple[str, ...]


class Saturation(NamedTuple):
    """The level at which readings pile up."""

    level: float
    counts: tuple[int, int, int]
    """Readings at or above it in red, green and blue."""
    manifest_path: Path | None
    report_path: Path | None


def dark(request: DarkRequest, progress: Progress | None = None) -> ImageCalibration:
    """Write the mean of dark images as dark.exr, and name it in the manifest."""
    capture, manifest_path, timings = open_capture(request, progress)
    _refuse_overwrite(request.images, manifest_path.parent / DARK_FILE)
    timings.stage("images", len(request.images))
    mean = mean_image(request.images, capture, progress=timings.advance)
    check_dark(mean.pixels, mean.noise, capture)
    check_alike(request.images, mean.levels, brightness(capture))
    timings.close()
    return _write(DARK_FILE, "dark", request, capture, manifest_path, mean.pixels.astype(np.float32), {
        "images": mean.images, "noise": float(f"{mean.noise:.4g}"), "mean": digits(mean.pixels.mean(axis=(0, 1)))})


def flat_field(request: FlatFieldRequest, progress: Progress | None = None) -> ImageCalibration:
    """Write the mean of white-card images, less their dark, as flat.exr, and name it in the manifest."""
    capture, manifest_path, timings = open_capture(request, progress)
    _refuse_overwrite([*request.images, *request.dark_images], manifest_path.parent / FLAT_FILE)
    timings.stage("images", len(request.images) + len(request.dark_images))
    white = mean_image(request.images, capture, refuse_saturated=True, progress=timings.advance)
    white_dark = None
    if request.dark_images:
        white_dark = mean_image(request.dark_images, capture, progress=lambda done: timings.advance(white.images + done))
        check_alike(request.dark_images, white_dark.levels, float(np.percentile(white.pixels, BRIGHT)))
    flat = make_flat(white, white_dark, capture)
    timings.close()
    mask = capture.mask()
    dark = capture.manifest.dark
    light = flat if dark is None else flat - linearise(capture.recorded(dark), capture.manifest.color_space)
    seen = flat[mask]
    return _write(FLAT_FILE, "flat", request, capture, manifest_path, flat, {
        "images": white.images, "noise": float(f"{white.noise:.4g}"),
        "least": digits(seen.min(axis=0)), "most": digits(seen.max(axis=0)), "warnings": list(card_faults(light, mask))})


def saturation(request: SaturationRequest, progress: Progress | None = None) -> Saturation:
    """Find the level at which the readings of a capture's frames pile up, and write it to the manifest if the request says so."""
    capture, manifest_path, timings = open_capture(request, progress)
    paths = [capture.file(frame.image) for frame in capture.manifest.frames if Path(frame.image).suffix.lower() != ".npy"]
    timings.stage("peaks", len(paths))
    peaks = np.zeros(3)
    for number, path in enumerate(paths, start=1):
        peaks = np.maximum(peaks, _recorded(path).max(axis=(0, 1)))
        timings.advance(number)
    histograms = [ReadingHistogram(float(peak)) for peak in peaks]
    timings.stage("histogram", len(paths))
    for number, path in enumerate(paths, start=1):
        recorded = _recorded(path)
        for channel, histogram in enumerate(histograms):
            histogram.add(recorded[..., channel])
        timings.advance(number)
    timings.close()
    channels = [histogram.saturation() for histogram in histograms]
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
    return ImageCalibration(manifest_path, report, image_path, section["noise"], tuple(section.get("warnings", ())))


class MeanImage(NamedTuple):
    """The mean of several images of one object, and their noise."""

    pixels: np.ndarray  # [rows, cols, 3] float64, linear
    noise: float
    """The root mean square of the difference of an image from the mean, over all pixels; 0 for one image."""
    images: int
    """The count of images."""
    levels: np.ndarray  # [images] mean reading of each, linear


def mean_image(paths: Sequence[Path], capture: Capture, *, refuse_saturated: bool = False,
               progress: Callable[[int], None] | None = None) -> MeanImage:
    """Return the mean of images, which have the resolution and the encoding of the capture, in linear values.
    `refuse_saturated`: True makes a saturated reading inside the mask an error. `progress`: called after every image with the count of
    images that have been read."""
    if not paths:
        raise CalibrationError("no image is given")
    manifest = capture.manifest
    mask = capture.mask() if refuse_saturated else None
    total = np.zeros((capture.camera.height, capture.camera.width, 3))
    squares, levels = 0.0, []
    for index, path in enumerate(paths):
        images.check_resolution(path, capture.camera.resolution)
        recorded = images.read_pixels(path).astype(np.float32, copy=False)
        check_radiance(path, recorded, stray=RAW_STRAY if path_is_raw(path) else 0.0)
        if mask is not None:
            count, limit = _saturated(recorded[mask], saturation_limit(manifest, path))
            if count:
                raise ImageError(f"{path}: {count} pixels are at or above the saturation of {limit:g}: shorten the exposure")
        linear = linearise(recorded, manifest.color_space).astype(np.float64)
        total += linear
        squares += float((linear**2).mean())
        levels.append(float(linear.mean()))
        if progress is not None:
            progress(index + 1)
    mean = total / len(paths)
    variance = max(squares / len(paths) - float((mean**2).mean()), 0.0)
    return MeanImage(mean, variance**0.5, len(paths), np.array(levels))


def _saturated(readings: np.ndarray, limit: float) -> tuple[int, float]:
    """Return how many of the readings of a card, [readings, 3] as recorded, are saturated, and from which value on: the limit, or else one
    that they show."""
    level = limit if (readings >= limit).any() else clipped_level(readings)
    return int((readings >= level).any(axis=-1).sum()), level


def make_flat(white: MeanImage, white_dark: MeanImage | None, capture: Capture) -> np.ndarray:
    """Return the flat field for the correction: white card minus its own dark frame, plus the dark frame of the capture.
    `white_dark`: the mean of dark images at the same exposure; None takes the dark frame of the capture for them. Returns [rows, cols, 3]
    float32, linear."""
    dark = np.zeros_like(white.pixels)
    if capture.manifest.dark is not None:
        dark = linearise(capture.recorded(capture.manifest.dark), capture.manifest.color_space).astype(np.float64)
    light = white.pixels - (dark if white_dark is None else white_dark.pixels)
    unlit = int((light[capture.mask()] <= 0).any(axis=-1).sum())
    if unlit:
        raise CalibrationError(f"the white card is not brighter than the dark frame at {unlit} pixels of the mask")
    return np.maximum(light + dark, 0).astype(np.float32)


def recorded_values(linear: np.ndarray, capture: Capture) -> np.ndarray:
    """Encode scene-linear values, [rows, cols, 3] float32, as the images of a capture are encoded."""
    space = capture.manifest.color_space
    return convert(np.ascontiguousarray(linear, dtype=np.float32), linear_space(space), space)


class WhiteBalance(NamedTuple):
    """The colours that a card measured, and the files that were written."""

    manifest_path: Path
    report_path: Path
    gains: tuple[float, float, float]
    """Factors of red, green and blue after which the card is grey; that of green is 1."""
    matrix: tuple[tuple[float, float, float], ...]
    """The new `color_matrix` of the manifest, by rows."""
    warnings: tuple[str, ...]


def white_balance(request: WhiteBalanceRequest, progress: Progress | None = None) -> WhiteBalance:
    """Measure the colour of the light on a card, and write `color_matrix` into the manifest.

    The matrix multiplies each channel by the gain that makes the card grey. Colours of camera raw files are then converted from the
    primaries of the sensor to those of the capture's colour space, which keeps grey grey. Raises StageError if an image is wrong, saturated
    in the region, or dark in a channel; nothing is written. Raises RequestError if the region leads out of the images, or images of other
    kinds are mixed."""
    capture, manifest_path, timings = open_capture(request, progress)
    region = Crop(*request.region) if request.region is not None else Crop(0, 0, *capture.camera.resolution)
    if not region.is_within(capture.camera.resolution):
        raise RequestError(f"--region {region}: leads out of the images of {capture.folder}, which are "
                           f"{capture.camera.width}x{capture.camera.height}: give first column, first row, width and height")
    raw = [path_is_raw(path) for path in (*request.images, Path(capture.manifest.frames[0].image))]
    if any(raw) != all(raw):
        raise RequestError(f"{request.images[0]}: the card and the frames are to be of one kind, camera raw or not: their colours differ")
    if request.sensor_colors and not any(raw):
        raise RequestError(f"--sensor-colors: is about camera raw files, and {request.images[0]} is none")
    timings.stage("images", len(request.images))
    for path in request.images:
        over, limit = _saturated(region.of(images.read_pixels(path)).reshape(-1, 3), saturation_limit(capture.manifest, path))
        if over:
            raise CalibrationError(f"{path}: {over} pixels of the card are saturated, from {limit:g} on: shorten the exposure, or choose "
                                   "a --region without them")
    card = region.of(mean_image(request.images, capture, progress=timings.advance).pixels)
    if capture.manifest.dark is not None:
        card = card - region.of(linearise(capture.recorded(capture.manifest.dark), capture.manifest.color_space))
    timings.close()
    mean = card.mean(axis=(0, 1))
    if not (mean > 0).all():
        dark = ", ".join(name for name, value in zip(("red", "green", "blue"), mean, strict=True) if value <= 0)
        raise CalibrationError(f"{request.images[0]}: the card is dark in {dark}: give a longer exposure")
    gains = mean[1] / mean
    matrix = np.diag(gains)
    if any(raw) and not request.sensor_colors:
        space = linear_space(capture.manifest.color_space)
        matrix = rgb_matrix("lin_rec709_scene", space).astype(np.float64) @ rec709_from_camera(request.images[0]) @ matrix
    rows = color_matrix(matrix)
    mixed = mixed_colours(card)
    warnings = () if mixed is None else (f"--region: colours in it differ by {100 * mixed:.0f} %: choose a part that the card alone fills, "
                                         "in one light",)
    report = write_results("white-balance", request, capture.manifest.with_colors(rows), manifest_path, {
        "images": len(request.images), "region": list(region), "gains": digits(gains), "matrix": rows,
        "unevenness": digits(card.std(axis=(0, 1)) / mean), "warnings": list(warnings)})
    return WhiteBalance(manifest_path, report, (float(gains[0]), 1.0, float(gains[2])), rows, warnings)
