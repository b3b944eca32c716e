"""Time-of-flight frames of a capture → range and depth of each pixel: decode, correct, filter, and turn range into depth."""

from typing import Any

import numpy as np
import warp as wp

from kernels.status import SOLVED, Status
from kernels.tof.bilateral import smooth
from kernels.tof.flying import mark_flying
from service.depth.solution import DepthSolution
from service.depth.tof_continuous import solve_correlations
from service.depth.tof_measured import Measured
from service.depth.tof_pulsed import solve_histograms
from service.reporting.progress import Timings
from service.requests.depth import TofFilter, TofOptions
from stage.camera import Camera
from stage.capture import Capture
from stage.tof.calibration import TofCalibration, read_calibration
from stage.tof.frames import is_pulsed, read_correlations, read_histograms


def solve_tof(capture: Capture, options: TofOptions, *, near_m: float | None = None, far_m: float | None = None,
              calibration: TofCalibration | None = None, device: str, timings: Timings) -> DepthSolution:
    """Solve the time-of-flight frames of a capture.

    Args:
        capture: with cw or pulsed frames.
        options: filters, and the file of a calibration.
        near_m: nearest range; None: 0, pulsed: where the histogram begins.
        far_m: farthest range; None: as far as the frequencies tell apart, or the histogram reaches.
        calibration: in place of that file.
        device: where to run.
        timings: told of the stages.

    Returns:
        Depth, range, standard deviations of the depth, amplitude (mean over the frequencies; pulsed: photons of the return), confidence
        (probability of the wrap, or that the return is one) and status of each pixel; 0 where not solved. Facts say what was assumed.

    Raises:
        ManifestError, ImageError, CalibrationError: the frames or the calibration cannot be used.
        ArrayError: phases, frequencies or bins that give no range; nothing is launched.
    """
    timings.stage("read", 1)
    pulsed = is_pulsed(capture)
    if calibration is None:
        calibration = TofCalibration() if options.calibration is None else read_calibration(options.calibration)
    mask = capture.mask()
    limit = capture.manifest.saturation
    if pulsed:
        histograms = read_histograms(capture)
        timings.stage("returns", 1)
        measured = solve_histograms(histograms, options, calibration, near_m=near_m, far_m=far_m, limit=limit, usable=mask.reshape(-1),
                                    device=device)
    else:
        correlations = read_correlations(capture)
        timings.stage("phases", 1)
        measured = solve_correlations(correlations, options, calibration, near_m=near_m, far_m=far_m, limit=limit, usable=mask,
                                      device=device)
    return finish(measured, options, calibration, capture.camera, mask, device=device, timings=timings)


def finish(measured: Measured, options: TofOptions, calibration: TofCalibration, camera: Camera, mask: np.ndarray, *, device: str,
           timings: Timings) -> DepthSolution:
    """Correct, filter, and go from range to depth; arguments and result as those of `solve_tof`."""
    rows, cols = mask.shape
    solved = np.isin(measured.status, SOLVED)
    range_m = np.where(solved, calibration.correct(measured.range_m.astype(np.float64), options.temperature_c), 0).astype(np.float32)
    sigma = (measured.sigma_m * calibration.scale).astype(np.float32)
    status = np.where(mask.reshape(-1), measured.status, int(Status.UNSOLVED)).astype(np.int32)
    if options.filters:
        timings.stage("filter", len(options.filters))
        range_m, sigma, status = _filter(range_m, sigma, measured.amplitude, status, rows, cols, options.filters, device)
    solved = np.isin(status, SOLVED)
    z = z_per_range(camera).reshape(-1)

    def image(values: np.ndarray) -> np.ndarray:
        return np.where(solved, values, 0).astype(np.float32).reshape(rows, cols)

    facts: dict[str, Any] = {**measured.facts, "filters": [str(name) for name in options.filters],
                             "calibration": None if options.calibration is None else str(options.calibration)}
    return DepthSolution(
        method=measured.method,
        depth=image(range_m * z),
        status=status.astype(np.uint8).reshape(rows, cols),
        sigma=image(sigma * z),
        range_m=image(range_m),
        amplitude=image(measured.amplitude),
        confidence=image(measured.confidence),
        facts=facts,
    )


def z_per_range(camera: Camera) -> np.ndarray:
    """[rows, cols] float64: depth of a point at range one along each pixel's line of sight."""
    if camera.projection == "orthographic":
        return np.ones((camera.height, camera.width))
    x, y = camera.plane_coordinates()
    return 1 / np.sqrt(x * x + y * y + 1)


def _filter(range_m: np.ndarray, sigma: np.ndarray, guide: np.ndarray, status: np.ndarray, rows: int, cols: int,
            filters: tuple[TofFilter, ...], device: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Range, its deviation and status after the filters that were asked for, flying pixels first."""
    ranges, deviations, codes = (wp.array(np.ascontiguousarray(values), device=device) for values in (range_m, sigma, status))
    if TofFilter.FLYING in filters:
        codes = mark_flying(ranges, deviations, codes, rows, cols)
    if TofFilter.BILATERAL in filters:
        picture = wp.array(np.ascontiguousarray(guide, dtype=np.float32), device=device)
        ranges, deviations = smooth(ranges, deviations, picture, codes, rows, cols)
    return ranges.numpy(), deviations.numpy(), codes.numpy()
