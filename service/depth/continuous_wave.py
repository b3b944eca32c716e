"""Ranges from the correlation images of a continuous-wave camera: noise, phases, wiggling, wraps.

The sources stand with the kernels of each step (kernels/tof).
"""

import numpy as np

from kernels.status import ESTIMATED, Status
from kernels.tof.continuous import Correlation, Noise, decode, weights
from kernels.tof.decide import AGREEMENT_RAD, DECIDED, UNCALIBRATED_RAD, Ranges, decide
from kernels.tof.disagreement import widen
from kernels.tof.modulation import common_range_m, require_span
from kernels.tof.noise import estimate_noise
from kernels.tof.pool import pool
from kernels.tof.steps import cover_steps
from kernels.tof.unwrap import unwrap
from kernels.tof.vote import vote
from kernels.tof.wiggling import ENTRIES, sample_harmonics, straighten
from service.depth.range_image import RangeImage
from service.requests.depth import TofOptions
from stage.tof.calibration import TofCalibration
from stage.tof.frames import CorrelationImages
from stage.tof.light_time import SPEED_OF_LIGHT

POOLED = 0.5
"""Factor on the probability of the wrap of a pixel that was decoded with its dark neighbours: whether it is on their surface, its own light
does not tell."""
MOST_OF_SCENE = 0.5
"""Part of the pixels from which a disagreement of the frequencies is told of."""


def solve_correlations(frames: CorrelationImages, options: TofOptions, calibration: TofCalibration, *, near_m: float | None,
                       far_m: float | None, limit: float | None, usable: np.ndarray, device: str) -> RangeImage:
    """Return the range of each pixel from correlation images, of every pixel from which one can be decoded, however unsurely.

    Args:
        frames: the images of a capture.
        options: vote: whether neighbours are asked, for the light of dark pixels and for wraps.
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
    reach = np.zeros(rows * cols, dtype=np.int32)
    if options.vote:
        found, pooled = pool(found, rows, cols, light_speed=SPEED_OF_LIGHT)
        reach = pooled.numpy()[:rows * cols]
    straight = [hz for hz in found.modulation_hz.tolist() if calibration.of_frequency(hz) is not None]
    agreement = AGREEMENT_RAD if len(straight) == len(found.modulation_hz) else UNCALIBRATED_RAD

    def ranges_of(phases: Correlation) -> Ranges:
        hypotheses = unwrap(phases, nearest_m=nearest, farthest_m=farthest, light_speed=SPEED_OF_LIGHT)
        if options.vote:
            hypotheses = vote(hypotheses, rows, cols)
        return decide(phases, hypotheses, light_speed=SPEED_OF_LIGHT, agreement_rad=agreement)

    pixels = rows * cols
    ranges = ranges_of(found)
    status = ranges.status.numpy()[:pixels]
    widened = widen(found, ranges, rows, cols, light_speed=SPEED_OF_LIGHT)
    further = widened.further.numpy()[:pixels]
    if further.any():
        ranges = ranges_of(widened.found)
        again = ranges.status.numpy()[:pixels]
        status = np.where((status == Status.MULTIPATH) & (again == Status.OK), status, again)
    spacing_m = common_range_m(frames.modulation_hz.max(), SPEED_OF_LIGHT)
    sigma = cover_steps(ranges, found.amplitude, rows, cols, spacing_m=spacing_m).numpy()[:pixels]
    confidence = ranges.confidence.numpy()[:pixels] * np.where(reach > 0, POOLED, 1).astype(np.float32)
    facts = {
        "modulation_hz": found.modulation_hz.tolist(),
        "images": len(frames.images),
        "span_m": [nearest, round(farthest, 4)],
        "common_range_m": round(common_range_m(frames.modulation_hz, SPEED_OF_LIGHT), 4),
        "vote": options.vote,
        "noise": {"electrons_per_unit": 1 / noise.shot if noise.shot > 0 else None, "read_units": noise.read, "from": source},
        "wiggling": straight,
        "agreement_rad": agreement,
        "with_neighbours": int((usable.reshape(-1) & (reach > 0) & np.isin(status, ESTIMATED)).sum()),
    }
    return RangeImage("time of flight, continuous wave", ranges.range.numpy()[:pixels], sigma,
                    found.amplitude.numpy()[:, :pixels].mean(axis=0), confidence, status, facts, DECIDED,
                    _disagreement(further[usable.reshape(-1)], len(straight) == len(found.modulation_hz)))


def _disagreement(further: np.ndarray, calibrated: bool) -> tuple[str, ...]:
    """Return a sentence if the frequencies disagree by more than noise over most of the scene.

    Args:
        further: [pixel] τ² of `widen`, radians².
        calibrated: whether the wiggling of every frequency is.
    """
    part = float((further > 0).mean()) if further.size else 0.0
    if part < MOST_OF_SCENE:
        return ()
    size = 1000 * float(np.sqrt(np.median(further[further > 0])))
    advice = ("check that the calibration is of this camera" if calibrated
              else "measure the wiggling with relit calibrate tof and give --tof-calibration")
    return (f"frames[].tof: the phases of the frequencies disagree by {size:.0f} mrad more than noise at {100 * part:.0f} % of the pixels, "
            f"by wiggling or by light that comes over several ways: {advice}; the standard deviations cover it",)


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
