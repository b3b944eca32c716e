"""Range and depth of each pixel from the time-of-flight frames of a capture.

Continuous wave: correlation images → noise, phases, wiggling, wraps. Pulsed: photon histograms → pile-up, pulse, returns. Either way
the range is then corrected with the camera's calibration, filtered, and turned into depth. The sources stand with the kernels of each
step (kernels/tof).
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from kernels.status import SOLVED, Status
from kernels.tof.bilateral import smooth
from kernels.tof.continuous import Correlation, Noise, decode, weights
from kernels.tof.decide import AGREEMENT_RAD, UNCALIBRATED_RAD, decide
from kernels.tof.flying import mark_flying
from kernels.tof.modulation import common_range_m, require_span
from kernels.tof.noise import estimate_noise
from kernels.tof.pileup import LiveCounts, correct_pileup, place, without_pileup
from kernels.tof.pulse import STEPS_PER_SIGMA, Pulse, gaussian, measured
from kernels.tof.pulse_width import estimate_pulse
from kernels.tof.returns import Returns, find_returns
from kernels.tof.unwrap import unwrap
from kernels.tof.vote import vote
from kernels.tof.wiggling import ENTRIES, sample_harmonics, straighten
from service.depth.solution import DepthSolution
from service.errors import RequestError
from service.reporting.progress import Timings
from service.requests.depth import TofFilter, TofOptions, WhichReturn
from stage.camera import Camera
from stage.capture import Capture
from stage.tof.calibration import TofCalibration, read_calibration
from stage.tof.frames import CorrelationImages, Histograms, is_pulsed, read_correlations, read_histograms
from stage.tof.light_time import SPEED_OF_LIGHT, range_of_delay_m

MOST_RETURNS = 3
"""Returns that are looked for in a histogram."""


@dataclass(frozen=True)
class RangeImage:
    """Ranges along the rays, before correction and filters; only pixels with a status of kernels.status.SOLVED have values that count."""

    method: str
    range_m: np.ndarray  # [pixel] float32
    sigma_m: np.ndarray  # [pixel] float32
    amplitude: np.ndarray  # [pixel] float32
    confidence: np.ndarray  # [pixel] float32
    status: np.ndarray  # [pixel] int32
    facts: dict[str, Any]


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
        found = solve_histograms(histograms, options, calibration, near_m=near_m, far_m=far_m, limit=limit, usable=mask.reshape(-1),
                                 device=device)
    else:
        correlations = read_correlations(capture)
        timings.stage("phases", 1)
        found = solve_correlations(correlations, options, calibration, near_m=near_m, far_m=far_m, limit=limit, usable=mask,
                                   device=device)
    return _depth_of(found, options, calibration, capture.camera, mask, device=device, timings=timings)


def solve_correlations(frames: CorrelationImages, options: TofOptions, calibration: TofCalibration, *, near_m: float | None,
                       far_m: float | None, limit: float | None, usable: np.ndarray, device: str) -> RangeImage:
    """Return the range of each pixel from correlation images.

    Args:
        frames: the images of a capture.
        options: vote.
        calibration: noise and wiggling, where they are known.
        near_m, far_m: the span of ranges; None: 0, and as far as the frequencies tell apart.
        limit: saturation, in recorded values.
        usable: [rows, cols] bool mask.
        device: where to run.

    Raises:
        ArrayError: the phases or frequencies cannot give the range that is asked for.
    """
    rows, cols = usable.shape
    weights(frames.modulation_hz, frames.reference_phase_rad, frames.scale)  # faults of the frames come before those of the options
    nearest = near_m or 0.0
    farthest = far_m or nearest + common_range_m(frames.modulation_hz, SPEED_OF_LIGHT)
    require_span(frames.modulation_hz, nearest, farthest, SPEED_OF_LIGHT)
    noise, source = _noise(frames, calibration, limit, usable)
    found = decode(frames.images, frames.modulation_hz, frames.reference_phase_rad, noise=noise, saturation=limit, scale=frames.scale,
                   device=device)
    found = _straighten(found, calibration)
    hypotheses = unwrap(found, nearest_m=nearest, farthest_m=farthest, light_speed=SPEED_OF_LIGHT)
    if options.vote:
        hypotheses = vote(hypotheses, rows, cols)
    straight = [hz for hz in found.modulation_hz.tolist() if calibration.of_frequency(hz) is not None]
    agreement = AGREEMENT_RAD if len(straight) == len(found.modulation_hz) else UNCALIBRATED_RAD
    ranges = decide(found, hypotheses, light_speed=SPEED_OF_LIGHT, agreement_rad=agreement)
    facts = {
        "modulation_hz": found.modulation_hz.tolist(),
        "images": len(frames.images),
        "span_m": [nearest, round(farthest, 4)],
        "common_range_m": round(common_range_m(frames.modulation_hz, SPEED_OF_LIGHT), 4),
        "vote": options.vote,
        "noise": {"electrons_per_unit": 1 / noise.shot if noise.shot > 0 else None, "read_units": noise.read, "from": source},
        "wiggling": straight,
        "agreement_rad": agreement,
    }
    pixels = rows * cols
    return RangeImage("time of flight, continuous wave", ranges.range.numpy()[:pixels], ranges.sigma.numpy()[:pixels],
                    found.amplitude.numpy()[:, :pixels].mean(axis=0), ranges.confidence.numpy()[:pixels], ranges.status.numpy()[:pixels],
                    facts)


def _noise(frames: CorrelationImages, calibration: TofCalibration, limit: float | None, usable: np.ndarray) -> tuple[Noise, str]:
    """Return the noise of a reading, and where it is known from."""
    if calibration.electrons_per_unit is not None and calibration.read_noise_electrons is not None:
        unit = calibration.electrons_per_unit
        return Noise(1 / unit, calibration.read_noise_electrons / unit), "calibration"
    keep = usable.reshape(-1)
    if limit is not None:
        keep = keep & (frames.images < limit).all(axis=0)
    return estimate_noise(frames.images, frames.modulation_hz, frames.reference_phase_rad, cols=usable.shape[1], scale=frames.scale,
                          usable=keep), "images"


def _straighten(found: Correlation, calibration: TofCalibration) -> Correlation:
    known = [calibration.of_frequency(hz) for hz in found.modulation_hz.tolist()]
    if not any(known):
        return found
    table = np.stack([np.zeros(ENTRIES) if h is None else sample_harmonics(np.array(h.cos), np.array(h.sin)) for h in known])
    return straighten(found, table)


def solve_histograms(frames: Histograms, options: TofOptions, calibration: TofCalibration, *, near_m: float | None,
                     far_m: float | None, limit: float | None, usable: np.ndarray, device: str) -> RangeImage:
    """Return the range of each pixel from photon histograms.

    Args:
        frames: the histograms of a capture.
        options: which return.
        calibration: the pulse, where it is known.
        near_m, far_m: the span of ranges; None: that of the histogram.
        limit: counts at or above it are a full counter.
        usable: [pixel] bool mask: the others do not decide on the width of the pulse.
        device: where to run.

    Raises:
        ArrayError: the histograms hold nothing.
        RequestError: the span lies outside the histogram.
    """
    bin_m = range_of_delay_m(frames.bin_s)
    start_m = range_of_delay_m(frames.start_s)
    end_m = start_m + bin_m * frames.counts.shape[1]
    nearest = start_m if near_m is None else near_m
    farthest = end_m if far_m is None else far_m
    if not max(nearest, start_m) < min(farthest, end_m):
        raise RequestError(f"ranges from {nearest:g} to {farthest:g} m lie outside the histogram, "
                           f"which covers {start_m:.4g} to {end_m:.4g} m")
    counts = place(frames.counts, device)
    if frames.first_photon_only:
        assert frames.pulses is not None  # the reader saw to it
        histograms = correct_pileup(counts, pulses=frames.pulses)
    else:
        histograms = without_pileup(counts)
    pulse, source = _pulse(frames, calibration, histograms, usable)
    found = find_returns(histograms, pulse, most=MOST_RETURNS, first_bin=(nearest - start_m) / bin_m, last_bin=(farthest - start_m) / bin_m)
    chosen = _choose(found, options.which)
    position, sigma, photons, confidence = (np.take_along_axis(array.numpy(), chosen[None], axis=0)[0]
                                            for array in (found.position, found.sigma, found.photons, found.confidence))
    status = found.status.numpy()
    if limit is not None:
        status[(frames.counts >= limit).any(axis=1)] = int(Status.SATURATED)
    solved = np.isin(status, SOLVED)
    several = (found.photons.numpy() > 0).sum(axis=0)
    facts: dict[str, Any] = {
        "bins": frames.counts.shape[1],
        "bin_s": frames.bin_s,
        "span_m": [round(nearest, 4), round(farthest, 4)],
        "pulse": source,
        "pile_up": {"corrected": frames.first_photon_only, "pulses": frames.pulses},
        "return": str(options.which),
        "returns_found": {str(n): int((several[usable] == n).sum()) for n in range(1, MOST_RETURNS + 1)},
        "background_photons_a_bin": float(np.median(found.background.numpy()[usable])),
    }
    return RangeImage("time of flight, pulsed", (start_m + position * bin_m).astype(np.float32), (sigma * bin_m).astype(np.float32),
                    photons, np.where(solved, confidence, 0).astype(np.float32), status, facts)


def _pulse(frames: Histograms, calibration: TofCalibration, histograms: LiveCounts, usable: np.ndarray) -> tuple[Pulse, dict[str, Any]]:
    """Return the pulse in bins, and where it is known from."""
    if calibration.pulse is not None:
        shape = measured(np.array(calibration.pulse.time_s) / frames.bin_s, calibration.pulse.power)
        return shape, {"from": "calibration", "width_s": shape.width * frames.bin_s}
    if calibration.pulse_sigma_s is not None:
        return gaussian(calibration.pulse_sigma_s / frames.bin_s), {"from": "calibration", "sigma_s": calibration.pulse_sigma_s}
    shape = estimate_pulse(histograms, np.where(usable[:, None], frames.counts, 0))
    return shape, {"from": "histograms", "sigma_s": float(f"{shape.step * STEPS_PER_SIGMA * frames.bin_s:.4g}")}


def _choose(found: Returns, which: WhichReturn) -> np.ndarray:
    """Return the index of the return to take, [pixel]; 0 where there is none."""
    position, there = found.position.numpy(), found.photons.numpy() > 0
    if which is WhichReturn.FIRST:
        return np.argmin(np.where(there, position, math.inf), axis=0)
    if which is WhichReturn.LAST:
        return np.argmax(np.where(there, position, -math.inf), axis=0)
    return np.zeros(position.shape[1], dtype=np.int64)


def _depth_of(found: RangeImage, options: TofOptions, calibration: TofCalibration, camera: Camera, mask: np.ndarray, *, device: str,
              timings: Timings) -> DepthSolution:
    """Correct and filter ranges and turn them into depth; arguments and result as those of `solve_tof`."""
    rows, cols = mask.shape
    solved = np.isin(found.status, SOLVED)
    range_m = np.where(solved, calibration.correct(found.range_m.astype(np.float64), options.temperature_c), 0).astype(np.float32)
    sigma = (found.sigma_m * calibration.scale).astype(np.float32)
    status = np.where(mask.reshape(-1), found.status, int(Status.UNSOLVED)).astype(np.int32)
    if options.filters:
        timings.stage("filter", 1)
        range_m, sigma, status = _filter(range_m, sigma, found.amplitude, status, rows, cols, options.filters, device)
    solved = np.isin(status, SOLVED)
    z = z_per_range(camera).reshape(-1)

    def image(values: np.ndarray) -> np.ndarray:
        return np.where(solved, values, 0).astype(np.float32).reshape(rows, cols)

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
        facts=facts,
    )


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
    return ranges.numpy(), deviations.numpy(), codes.numpy()
