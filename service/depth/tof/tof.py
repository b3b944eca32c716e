"""Range and depth of each pixel from the time-of-flight frames of a capture.

Continuous wave: continuous_wave.py. Pulsed: histograms.py. Either way half the path of light is then
corrected with the camera's calibration, turned into the range if the light source stands beside the camera, filtered, and turned into
depth. The papers are named with the kernels of each step (kernels/tof).
"""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import warp as wp

from kernels.device import to_numpy
from kernels.status import ESTIMATED, SOLVED, Status, refuse_unsure
from kernels.tof.continuous.bilateral import smooth
from kernels.tof.continuous.flying import mark_flying
from kernels.tof.continuous.modulation import common_range_m, require_span
from kernels.tof.continuous.unwrap import END_SIGMAS
from service.depth.base.solution import DepthSolution, RangeImage
from service.depth.tof.continuous_wave import solve_correlations
from service.depth.tof.histograms import solve_histograms
from service.depth.tof.scatter import find_scatter
from service.reporting.progress import Timings
from service.requests.depth import TofFilter, TofOptions
from stage.capture.camera import Camera
from stage.capture.capture import Capture
from stage.tof.calibration import TofCalibration, read_calibration
from stage.tof.light_time import SPEED_OF_LIGHT
from stage.tof.raw_frames import is_pulsed, read_correlations, read_histograms
from stage.tof.source import SourcePath


def solve_tof(capture: Capture, options: TofOptions, *, near_m: float | None = None, far_m: float | None = None,
              calibration: TofCalibration | None = None, device: str, timings: Timings) -> DepthSolution:
    """Solve the cw or pulsed frames of a capture.

    Args:
        near_m: nearest range; None: 0, pulsed: where the histogram begins.
        far_m: farthest range; None: as far as the frequencies tell apart, or the histogram reaches.
        calibration: in place of the file that the options name.

    Returns:
        Depth, range, standard deviations of the depth, amplitude (mean over the frequencies; pulsed: photons of the return), confidence
        (probability of the wrap, or that the return is one) and status of each pixel; 0 where nothing was estimated. Facts say what was
        assumed.
    """
    timings.stage("read", 1)
    pulsed = is_pulsed(capture)
    if calibration is None:
        calibration = TofCalibration() if options.calibration is None else read_calibration(options.calibration)
    mask = capture.mask()
    limit = capture.manifest.saturation
    if pulsed:
        histograms = read_histograms(capture)
        path = SourcePath.of(capture.camera, histograms.source_m)
        near_path_m, far_path_m = _half_path_span(path, mask, near_m, far_m)
        timings.stage("returns", 1)
        found = solve_histograms(histograms, options, calibration, near_m=near_path_m, far_m=far_path_m, limit=limit,
                                 usable=mask, rays=_rays(capture.camera), device=device)
    else:
        correlations = read_correlations(capture)
        path = SourcePath.of(capture.camera, correlations.source_m)
        near_path_m, far_path_m = _half_path_span(path, mask, near_m, far_m)
        if far_m is not None and far_path_m is not None:  # seen from the source, the span may be a little longer than from the camera
            require_span(correlations.modulation_hz, near_m or 0.0, far_m, SPEED_OF_LIGHT)
            far_path_m = min(far_path_m, (near_path_m or 0.0) + common_range_m(correlations.modulation_hz, SPEED_OF_LIGHT))
        timings.stage("phases", 1)
        found = solve_correlations(correlations, options, calibration, near_m=near_path_m, far_m=far_path_m, limit=limit, usable=mask,
                                   rays=_rays(capture.camera), device=device)
    found = _scattered(_corrected(found, options, calibration, path, near_m, far_m), mask)
    solved = np.isin(found.status, SOLVED) & mask.reshape(-1)
    shared = calibration.sigma_at(float(np.median(found.range_m[solved])) if solved.any() else calibration.middle_m)
    if shared is not None:
        found = replace(found, facts=found.facts | {"calibration_sigma_m": float(f"{shared:.3g}")})
    return _depth_of(found, options, capture.camera, mask, device=device, timings=timings)


def _half_path_span(path: SourcePath | None, mask: np.ndarray, near_m: float | None, far_m: float | None
                    ) -> tuple[float | None, float | None]:
    """Return the half paths of light between which every pixel of the mask has its ranges from near to far."""
    if path is None or not mask.any():
        return near_m, far_m
    return (None if near_m is None else float(path.half_path_m(near_m)[mask].min()),
            None if far_m is None else float(path.half_path_m(far_m)[mask].max()))


def _corrected(found: RangeImage, options: TofOptions, calibration: TofCalibration, path: SourcePath | None, near_m: float | None,
               far_m: float | None) -> RangeImage:
    """Return ranges from measured half paths: corrected with the calibration, then seen from the camera in place of the source."""
    half_path = calibration.correct(found.range_m.astype(np.float64), options.temperature_c)
    sigma = found.sigma_m * calibration.scale
    if path is None:
        behind = np.isin(found.status, ESTIMATED) & ~(half_path > 0)
        return replace(found, range_m=half_path.astype(np.float32), sigma_m=sigma.astype(np.float32),
                       status=np.where(behind, int(Status.OUT_OF_RANGE), found.status))
    range_m, per_metre = (values.reshape(-1) for values in path.range_of(half_path.reshape(path.along_m.shape)))
    sigma = sigma * per_metre
    inside = ((range_m > 0) & (range_m >= (near_m or 0.0) - END_SIGMAS * sigma)
              & (range_m <= (math.inf if far_m is None else far_m) + END_SIGMAS * sigma))
    status = np.where(np.isin(found.status, ESTIMATED) & ~inside, int(Status.OUT_OF_RANGE), found.status)
    return replace(found, range_m=range_m.astype(np.float32), sigma_m=sigma.astype(np.float32), status=status)


def _scattered(found: RangeImage, mask: np.ndarray) -> RangeImage:
    """Return ranges whose standard deviations hold by how much they scatter from pixel to pixel."""
    sure = np.isin(found.status, SOLVED) & (found.confidence >= found.least_confidence) & mask.reshape(-1)
    scatter = find_scatter(*(values.reshape(mask.shape) for values in (found.range_m, found.sigma_m, sure)))
    if scatter is None:
        return found
    sentence = (f"frames[].tof: ranges of neighbouring pixels differ by {scatter.times:.2g} times what their noise makes, "
                f"{scatter.own_m:.2g} m that each pixel has of its own, as where their timers or phases have no common zero, or where the "
                "surface is rough from pixel to pixel: the standard deviations hold that")
    return replace(found, sigma_m=np.hypot(found.sigma_m, np.float32(scatter.own_m)), warnings=(*found.warnings, sentence),
                   facts=found.facts | {"pixel_scatter_m": float(f"{scatter.own_m:.3g}")})


def _depth_of(found: RangeImage, options: TofOptions, camera: Camera, mask: np.ndarray, *, device: str,
              timings: Timings) -> DepthSolution:
    """Filter ranges and turn them into depth; arguments and result as those of `solve_tof`."""
    rows, cols = mask.shape
    estimated = np.isin(found.status, ESTIMATED)
    range_m, sigma = np.where(estimated, found.range_m, 0).astype(np.float32), found.sigma_m
    status = np.where(mask.reshape(-1), found.status, int(Status.UNSOLVED)).astype(np.int32)
    if options.filters:
        timings.stage("filter", 1)
        sure = status.copy()
        refuse_unsure(sure, None, found.confidence, max_sigma=None, least_confidence=found.least_confidence)
        range_m, sigma, filtered = _filter(range_m, sigma, found.amplitude, sure, rows, cols, options.filters, device)
        status = np.where(filtered == Status.FLYING, filtered, status)
    estimated = np.isin(status, ESTIMATED)
    z = z_per_range(camera).reshape(-1)

    def image(values: np.ndarray) -> np.ndarray:
        return np.where(estimated, values, 0).astype(np.float32).reshape(rows, cols)

    facts: dict[str, Any] = {**found.facts, "filters": [str(name) for name in options.filters],
                             "calibration": None if options.calibration is None else str(options.calibration)}
    return DepthSolution(
        method=found.method,
        depth=image(range_m * z),
        status=status.astype(np.uint8).reshape(rows, cols),
        sigma=image(sigma * z),
        range_m=image(range_m),
        amplitude=image(found.amplitude),
        confidence=image(found.confidence),
        least_confidence=found.least_confidence,
        warnings=list(found.warnings),
        facts=facts,
    )


def _rays(camera: Camera) -> np.ndarray | None:
    """Return the unit directions of the lines of sight, [rows, cols, 3] float64; None if they are parallel."""
    if camera.projection == "orthographic":
        return None
    x, y = camera.plane_coordinates()
    return np.stack([x, y, -np.ones_like(x)], axis=-1) * z_per_range(camera)[..., None]


def z_per_range(camera: Camera) -> np.ndarray:
    """Return the depth of a point at range one along each pixel's line of sight, [rows, cols] float64."""
    if camera.projection == "orthographic":
        return np.ones((camera.height, camera.width))
    x, y = camera.plane_coordinates()
    return 1 / np.sqrt(x * x + y * y + 1)


def _filter(range_m: np.ndarray, sigma: np.ndarray, guide: np.ndarray, status: np.ndarray, rows: int, cols: int,
            filters: tuple[TofFilter, ...], device: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return range, its deviation and status after the filters that were asked for, flying pixels first."""
    ranges, deviations, codes = (wp.array(np.ascontiguousarray(values), device=device) for values in (range_m, sigma, status))
    if TofFilter.FLYING in filters:
        codes = mark_flying(ranges, deviations, codes, rows, cols)
    if TofFilter.BILATERAL in filters:
        picture = wp.array(np.ascontiguousarray(guide, dtype=np.float32), device=device)
        ranges, deviations = smooth(ranges, deviations, picture, codes, rows, cols)
    return to_numpy(ranges), to_numpy(deviations), to_numpy(codes)
