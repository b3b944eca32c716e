"""Calibration of a projector's response (its light at each level, its gamma) from images of uniformly grey projections.

A camera pixel reads ambient + s · g(level) with an ambient light and a scale s of its own and one response g for all pixels. Relative
to the darkest and the brightest image every pixel gives g directly; the response is the mean over the pixels that see the projector
well, by how much of its light each reads. A monotonic least-squares fit and interpolation to even levels follow. How far the light between
the levels is known is half of what a level is off from what the others make of it.

Source: Ayer et al., "An empirical distribution function for sampling with incomplete information", Annals of Mathematical Statistics
    26(4), 1955 (pool adjacent violators); Fritsch and Carlson, "Monotone piecewise cubic interpolation", SIAM Journal on Numerical Analysis
    17(2), 1980.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.interpolate import PchipInterpolator
from scipy.optimize import isotonic_regression

from service.calibrate.results import digits, open_capture, write_results
from service.calibrate.solvers.response_faults import response_faults
from service.errors import RequestError
from service.reporting.progress import Progress
from service.requests.calibrate import ResponseRequest
from stage.capture.manifest import FILE_NAME
from stage.colour.colour import GREY_WEIGHTS, linearise
from stage.colour.radiance import check_radiance
from stage.errors import CalibrationError, ManifestError
from stage.formats import images
from stage.formats.exif import SAME
from stage.stack.correction import saturation_limit

EVEN_LEVELS = 256
"""The count of levels of the response, which is that of an eight-bit projector."""
LEAST_PART = 0.2
"""The least difference between brightest and darkest image, relative to the largest, of a pixel that sees the projector well."""
LEAST_STEP = 1e-6
"""The least rise of the response from level to level, so that it can be inverted."""
LEAST_PIXELS = 10
"""The fewest pixels from which a response is told."""
STEEPEST = 4.0
"""The largest exponent along which light is interpolated, and one over the least: a plain power law keeps its own."""
MOST_PIXELS = 200_000
"""The most pixels that are used."""


class ResponseResult(NamedTuple):
    """The files that were written, and the fit."""

    manifest_path: Path
    report_path: Path
    gamma: float
    """Exponent of the power of the level that is nearest to the response."""
    spread: float
    """Median deviation of a pixel from the response, as a part of full scale."""
    warnings: tuple[str, ...]


def response(request: ResponseRequest, progress: Progress | None = None) -> ResponseResult:
    """Fit the response of a capture's projector, and write it to the manifest."""
    capture, manifest_path, timings = open_capture(request, progress)
    manifest = capture.manifest
    if manifest.projector is None:
        raise ManifestError(f"{capture.folder / FILE_NAME}: projector: is missing: the response is written into it")
    levels = request.levels or tuple(np.linspace(0, 1, len(request.images)).tolist())
    if len(levels) != len(request.images):
        raise RequestError(f"--levels: has {len(levels)} values, there are {len(request.images)} images: give one for each")
    _check_exposures(request.images)
    timings.stage("images", len(request.images))
    inside = capture.mask().reshape(-1)
    readings = np.empty((len(request.images), int(inside.sum())), np.float32)
    usable = np.ones(readings.shape[1], bool)
    for number, path in enumerate(request.images):
        images.check_resolution(path, capture.camera.resolution)
        recorded = images.read_pixels(path).astype(np.float32, copy=False)
        check_radiance(path, recorded)
        flat = recorded.reshape(-1, 3)[inside]
        usable &= (flat < saturation_limit(manifest, path)).all(axis=-1)
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
        "spread": float(f"{found.spread:.3g}"), "between_levels": None if found.between is None else float(f"{found.between:.2g}"),
        "warnings": list(found.faults)})
    return ResponseResult(manifest_path, report, found.gamma, found.spread, found.faults)


def _check_exposures(paths: Sequence[Path]) -> None:
    """Refuse images that were exposed otherwise than each other, as EXIF says, by an automatic exposure."""
    taken = {path: images.read_header(path).exposure for path in paths}
    for setting, words in (("time_s", "exposure time in seconds"), ("f_number", "f-number"), ("sensitivity", "ISO sensitivity")):
        values = {path: value for path, exposure in taken.items() if (value := getattr(exposure, setting)) is not None}
        if values and max(values.values()) > (1 + SAME) * min(values.values()):
            low, high = min(values, key=values.__getitem__), max(values, key=values.__getitem__)
            raise CalibrationError(f"{low}: EXIF has {values[low]:.4g} as the {words}, and {values[high]:.4g} in {high.name}: take all "
                                   "images at one exposure")


class Response(NamedTuple):
    """The response of a projector, and how well it fits the pixels."""

    values: np.ndarray  # [256] float64, light from 0 to 1 at even levels, rising
    gamma: float
    """The exponent of the nearest power law."""
    spread: float
    """The median absolute deviation of the pixels from the response, relative to full scale."""
    between: float | None
    """The light, as a part of full scale, to which the response is known between its levels; None: three levels do not tell."""
    faults: tuple[str, ...]
    """What the images say against it."""


def fit_response(
    levels: Sequence[float],  # the level of each image, from 0 to 1, all different, with 0 and 1 among them
    images: np.ndarray,  # [levels, pixels] float32, linear readings
    *,
    usable: np.ndarray | None = None,  # [pixels] bool, True for pixels that saturate in no image; None for all
) -> Response:
    """Fit the response of a projector to images of uniform levels.
    Raises CalibrationError if the levels are invalid, or the images do not become brighter with the level."""
    order = np.argsort(levels)
    x = np.asarray(levels, dtype=np.float64)[order]
    if len(x) < 3 or len(np.unique(x)) < len(x) or x[0] != 0 or x[-1] != 1:
        listed = ", ".join(f"{level:g}" for level in levels)
        raise CalibrationError(f"the levels are {listed}: give three or more different ones, with 0 and 1")
    dark, bright = images[order[0]].astype(np.float64), images[order[-1]].astype(np.float64)
    swing = bright - dark
    good = (swing > LEAST_PART * float(np.percentile(np.abs(swing), 99.5))) & (swing > 0)
    lit = int(np.count_nonzero(good))
    if lit < LEAST_PIXELS:
        raise CalibrationError(f"only {lit} pixels get brighter from level 0 to level 1: check the images and their order")
    if usable is not None:
        good &= usable
    count = int(np.count_nonzero(good))
    if count < LEAST_PIXELS:
        raise CalibrationError(f"of {lit} pixels that the projector lights {count} saturate in no image: shorten the exposure")
    kept = np.flatnonzero(good)[:: max(1, count // MOST_PIXELS)]
    ratio = (images[order][:, kept] - dark[kept]) / swing[kept]
    # of sums: a median of ratios under noise is drawn to one half
    curve = (images[order][:, kept].astype(np.float64) - dark[kept]).sum(axis=1) / swing[kept].sum()
    if (np.diff(curve) < -0.02).any():
        worst = int(np.argmin(np.diff(curve)))
        raise CalibrationError(f"the light falls from level {x[worst]:g} to {x[worst + 1]:g}: check the order of the images")
    rising = isotonic_regression(curve).x
    gamma = _exponent(x, rising)
    even = np.linspace(0, 1, EVEN_LEVELS)
    values = _between(x, rising, even) + LEAST_STEP * np.arange(EVEN_LEVELS)
    values -= values[0]
    off = [float(_between(np.delete(x, one), np.delete(rising, one), x[one:one + 1])[0] - rising[one]) for one in range(1, len(x) - 1)]
    between = max(map(abs, off)) / 2 if len(off) > 1 else None
    spread = float(np.median(np.abs(ratio - curve[:, None])))
    seen = images[order] if usable is None else images[order][:, usable]
    faults = response_faults(x, seen.astype(np.float64), curve, full_scale=float(np.sqrt(np.mean(swing[kept] ** 2))), spread=spread,
                             gamma=gamma, between=between or 0.0)
    return Response(values / values[-1], gamma, spread, between, faults)


def _exponent(x: np.ndarray, light: np.ndarray) -> float:
    """Return the exponent of the power of the levels x [n] that is nearest to their light."""
    inner = (x > 0) & (x < 1) & (light > 0)
    return float(np.median(np.log(light[inner]) / np.log(x[inner]))) if inner.any() else 1.0


def _between(x: np.ndarray, light: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Return the light at other levels by a monotone curve through that of the levels x [n], over their nearest power: responses bend as
    powers do."""
    bent = float(np.clip(_exponent(x, light), 1 / STEEPEST, STEEPEST))
    return np.asarray(PchipInterpolator(x**bent, light)(at**bent))
