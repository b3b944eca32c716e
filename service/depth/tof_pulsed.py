"""Photon histograms → range: pile-up, pulse, returns."""

import math
from typing import Any

import numpy as np

from kernels.status import SOLVED, Status
from kernels.tof.modulation import SPEED_OF_LIGHT
from kernels.tof.pileup import Exposed, correct_pileup, place, unhurried
from kernels.tof.pulse import STEPS_PER_SIGMA, Pulse, gaussian, measured
from kernels.tof.pulse_width import estimate_pulse
from kernels.tof.returns import Returns, find_returns
from service.depth.tof_measured import Measured
from service.errors import RequestError
from service.requests.depth import TofOptions, WhichReturn
from stage.tof.calibration import TofCalibration
from stage.tof.frames import Histograms

MOST_RETURNS = 3


def solve_histograms(frames: Histograms, options: TofOptions, calibration: TofCalibration, *, near_m: float | None,
                     far_m: float | None, limit: float | None, usable: np.ndarray, device: str) -> Measured:
    """Range of each pixel.

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
    bin_m = SPEED_OF_LIGHT * frames.bin_s / 2
    start_m = SPEED_OF_LIGHT * frames.start_s / 2
    end_m = start_m + bin_m * frames.counts.shape[1]
    nearest = start_m if near_m is None else near_m
    farthest = end_m if far_m is None else far_m
    if not max(nearest, start_m) < min(farthest, end_m):
        raise RequestError(f"ranges from {nearest:g} to {farthest:g} m lie outside the histogram, "
                           f"which covers {start_m:.4g} to {end_m:.4g} m")
    counts = place(frames.counts, device)
    if frames.first_photon_only:
        assert frames.pulses is not None  # the reader saw to it
        exposed = correct_pileup(counts, pulses=frames.pulses)
    else:
        exposed = unhurried(counts)
    pulse, source = _pulse(frames, calibration, exposed, usable)
    found = find_returns(exposed, pulse, most=MOST_RETURNS, first_bin=(nearest - start_m) / bin_m, last_bin=(farthest - start_m) / bin_m)
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
    return Measured("time of flight, pulsed", (start_m + position * bin_m).astype(np.float32), (sigma * bin_m).astype(np.float32),
                    photons, np.where(solved, confidence, 0).astype(np.float32), status, facts)


def _pulse(frames: Histograms, calibration: TofCalibration, exposed: Exposed, usable: np.ndarray) -> tuple[Pulse, dict[str, Any]]:
    """The pulse in bins, and where it is known from."""
    if calibration.pulse is not None:
        shape = measured(np.array(calibration.pulse.time_s) / frames.bin_s, calibration.pulse.power)
        return shape, {"from": "calibration", "width_s": shape.width * frames.bin_s}
    if calibration.pulse_sigma_s is not None:
        return gaussian(calibration.pulse_sigma_s / frames.bin_s), {"from": "calibration", "sigma_s": calibration.pulse_sigma_s}
    shape = estimate_pulse(exposed, np.where(usable[:, None], frames.counts, 0))
    return shape, {"from": "histograms", "sigma_s": float(f"{shape.step * STEPS_PER_SIGMA * frames.bin_s:.4g}")}


def _choose(found: Returns, which: WhichReturn) -> np.ndarray:
    """[pixel] index of the return to take; 0 where there is none."""
    position, there = found.position.numpy(), found.photons.numpy() > 0
    if which is WhichReturn.FIRST:
        return np.argmin(np.where(there, position, math.inf), axis=0)
    if which is WhichReturn.LAST:
        return np.argmax(np.where(there, position, -math.inf), axis=0)
    return np.zeros(position.shape[1], dtype=np.int64)
