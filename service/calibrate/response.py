"""Calibration of a projector's response (its gamma) from images of evenly grey projections."""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from service.calibrate.results import digits, manifest_to_write, write_results
from service.calibrate.solvers.response import fit_response
from service.errors import RequestError
from service.reporting.progress import Progress, Timings
from service.requests.calibrate import ResponseRequest
from stage.capture.capture import Capture
from stage.capture.manifest import FILE_NAME
from stage.colour.colour import GREY_WEIGHTS, linearise
from stage.colour.radiance import check_radiance
from stage.errors import CalibrationError, ManifestError
from stage.formats import images


class ResponseResult(NamedTuple):
    """The files that were written, and the fit."""

    manifest_path: Path
    report_path: Path
    gamma: float
    """Exponent of the power of the level that is nearest to the response."""
    spread: float
    """Median deviation of a pixel from the response, as a part of full scale."""


def response(request: ResponseRequest, progress: Progress | None = None) -> ResponseResult:
    """Fit the response of a capture's projector, and write it to the manifest.

    Raises:
        StageError, RequestError: the input is wrong; nothing is written.
    """
    timings = Timings(progress)
    timings.stage("open", 1)
    capture = Capture.open(request.capture)
    manifest = capture.manifest
    if manifest.projector is None:
        raise ManifestError(f"{capture.folder / FILE_NAME}: projector: is missing: the response is written into it")
    manifest_path = manifest_to_write(capture, request.out)
    levels = request.levels or tuple(np.linspace(0, 1, len(request.images)).tolist())
    if len(levels) != len(request.images):
        raise RequestError(f"--levels: has {len(levels)} values, there are {len(request.images)} images: give one for each")
    timings.stage("images", len(request.images))
    inside = capture.mask().reshape(-1)
    readings = np.empty((len(request.images), int(inside.sum())), np.float32)
    usable = np.ones(readings.shape[1], bool)
    for number, path in enumerate(request.images):
        images.check_resolution(path, capture.camera.resolution)
        recorded = images.read_pixels(path).astype(np.float32, copy=False)
        check_radiance(path, recorded)
        flat = recorded.reshape(-1, 3)[inside]
        if manifest.saturation is not None:
            usable &= (flat < manifest.saturation).all(axis=-1)
        linear = linearise(recorded, manifest.color_space).reshape(-1, 3)[inside]
        readings[number] = linear @ np.array(GREY_WEIGHTS, np.float32)
        timings.advance(number + 1)
    try:
        found = fit_response(levels, readings, usable=usable)
    except CalibrationError as error:
        raise CalibrationError(f"{capture.folder}: {error}") from error
    timings.close()
    values = tuple(float(f"{value:.7g}") for value in found.values)
    updated = manifest.model_copy(update={"projector": manifest.projector.model_copy(update={"response": values})})
    report = write_results("response", request, updated, manifest_path, {
        "images": len(request.images), "levels": digits(levels), "gamma": float(f"{found.gamma:.4g}"),
        "spread": float(f"{found.spread:.3g}")})
    return ResponseResult(manifest_path, report, found.gamma, found.spread)
