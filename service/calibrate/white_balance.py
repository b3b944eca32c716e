"""White balance from a grey or white card: the matrix from the recorded colours to those of the capture's colour space."""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from service.calibrate.results import color_matrix, digits, open_capture, write_results
from service.calibrate.sensor import mean_image
from service.errors import RequestError
from service.reporting.progress import Progress
from service.requests.calibrate import WhiteBalanceRequest
from stage.colour.colour import linearise, rgb_matrix
from stage.colour.colour_spaces import linear_space
from stage.errors import CalibrationError
from stage.formats import images
from stage.formats.camera_raw import path_is_raw, rec709_from_camera
from stage.pixels import Crop
from stage.stack.correction import FULL_SCALE


class WhiteBalance(NamedTuple):
    """The colours that a card measured, and the files that were written."""

    manifest_path: Path
    report_path: Path
    gains: tuple[float, float, float]
    """Factors of red, green and blue after which the card is grey; that of green is 1."""
    matrix: tuple[tuple[float, float, float], ...]
    """The new `color_matrix` of the manifest, by rows."""


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
        if images.read_header(path).integer:
            over = int((region.of(images.read_pixels(path)) >= FULL_SCALE).any(axis=-1).sum())
            if over:
                raise CalibrationError(f"{path}: {over} pixels of the card are saturated: shorten the exposure, or choose a --region "
                                       "without them")
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
    report = write_results("white-balance", request, capture.manifest.with_colors(rows), manifest_path, {
        "images": len(request.images), "region": list(region), "gains": digits(gains), "matrix": rows,
        "unevenness": digits(card.std(axis=(0, 1)) / mean)})
    return WhiteBalance(manifest_path, report, (float(gains[0]), 1.0, float(gains[2])), rows)
