"""Ranges from the correlation images of a continuous-wave camera: noise, phases, wiggling, wraps.

The sources stand with the kernels of each step (kernels/tof).
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import warp as wp

from kernels.device import to_numpy
from kernels.errors import ArrayError
from kernels.status import ESTIMATED, SOLVED, Status
from kernels.tof.continuous.continuous import ENTRIES, LEAST_PHASES, Correlation, Noise, decode, sample_harmonics, straighten, weights
from kernels.tof.continuous.decide import AGREEMENT_RAD, DECIDED, UNCALIBRATED_RAD, Ranges, decide
from kernels.tof.continuous.disagreement import widen
from kernels.tof.continuous.modulation import common_range_m, require_span
from kernels.tof.continuous.pool import pool
from kernels.tof.continuous.steps import cover_steps
from kernels.tof.continuous.unwrap import unwrap, vote
from service.depth.base.solution import RangeImage
from service.depth.tof.inside_out import PHASES, turned_inside_out
from service.depth.tof.phase_checks import DOUBTED, Phases, beyond_span, full_at, misread_frequencies, unfitting_images, unfitting_pixels
from service.depth.tof.three_images import lost_images, other_images
from service.requests.depth import TofOptions
from stage.tof.calibration import TofCalibration
from stage.tof.light_time import SPEED_OF_LIGHT
from stage.tof.raw_frames import CorrelationImages

BINS = 24
"""Number of bins over the level, each with the same number of pixels."""
LEAST_IN_BIN = 32
"""Least number of readings in a bin. With fewer than three bins no line is fitted, and all noise counts as read noise."""
LEAST_READ_ELECTRONS = 5.0
"""Read noise in electrons that is assumed where every part of the image is too bright to show it: black pixels must not pass for noise-free
ones."""
OFF_LINE, FEW_OFF = 4.0, 0.25
"""How many times the noise of the line a bin must have to count as little as at first, and the part of the bins below which they must be:
such bins hold pixels of which an image is lost."""
HIDDEN = 4.0
"""The read noise cannot be measured when the variance of shot noise in the darkest bin is more than this many times that of
LEAST_READ_ELECTRONS."""
MANY_UNFIT = 0.01
"""Share of pixels that are no wave from which on it is said: 150 right scenes with harmonics of up to 12 % and hot pixels have .003 at
most."""
CHI_SQUARED_MEDIAN = 0.4549
"""Median of chi-squared with one degree of freedom."""


def estimate_noise(images: np.ndarray, modulation_hz: Sequence[float] | np.ndarray, reference_phase_rad: Sequence[float] | np.ndarray,
                   *, cols: int, scale: Sequence[float] | np.ndarray | None = None, usable: np.ndarray | None = None) -> Noise:
    """Fit variance = read² + shot · level.

    Where frequencies have four images or more, what their least-squares fit leaves is noise whatever the scene is. Three images fit
    exactly; then two stand-ins are taken, which other things can make larger but nothing smaller, and of both the smaller one:
    differences of the offsets of two frequencies, and second differences along the rows.

    Args:
        images: [M, pixel] float32.
        modulation_hz, reference_phase_rad: [M].
        scale: [M] factor of each image (unequal exposures); None: 1.
        usable: [pixel] bool; None: all.

    Returns:
        The noise, in the unit of the images; none where no pixel is usable.

    Raises:
        ArrayError: three images of one frequency on an image without three pixels in a row: the message says what to give instead.

    Source:
        Photon transfer: Janesick, "Photon Transfer", SPIE 2007.
    """
    keep = np.isfinite(images).all(axis=0)
    if usable is not None:
        keep &= usable
    rows, frequencies, index = weights(modulation_hz, reference_phase_rad, scale)
    delta = np.asarray(reference_phase_rad, dtype=np.float64)
    if not keep.any():
        return Noise(0.0, 0.0)
    factor = np.ones_like(delta) if scale is None else np.asarray(scale, dtype=np.float64)
    fitted, steady, spatial = _Pairs([], []), _Pairs([], []), _Pairs([], [])
    before: np.ndarray | None = None
    for f in range(len(frequencies)):
        mine = images[index == f].astype(np.float64)
        if len(mine) > LEAST_PHASES:
            matrix = np.stack([np.ones(len(mine)), np.cos(delta[index == f]), np.sin(delta[index == f])], axis=1)
            matrix /= factor[index == f, None]  # in units of what the exposure records
            left = np.linalg.svd(matrix)[0][:, LEAST_PHASES:]  # unit vectors that no (P, a, b) reaches: each sees pure noise
            fitted.add(((left**2).T @ mine)[:, keep], (left.T @ mine)[:, keep] ** 2)
            continue
        parts = rows[index == f, 0]
        offset = parts @ mine
        if before is not None:
            steady.add((0.5 * (offset + before))[keep], ((offset - before) ** 2 / (2 * (parts**2).sum()))[keep])
        before = offset
        grid, whole = mine.reshape(len(mine), -1, cols), keep.reshape(-1, cols)
        inside = (whole[:, :-2] & whole[:, 1:-1] & whole[:, 2:])[None].repeat(len(mine), axis=0)
        bend = grid[..., :-2] - 2 * grid[..., 1:-1] + grid[..., 2:]
        spatial.add(((grid[..., :-2] + 4 * grid[..., 1:-1] + grid[..., 2:]) / 6)[inside], (bend**2 / 6)[inside])
    given = [_fit(pairs) for pairs in ((fitted,) if fitted.levels else (steady, spatial)) if sum(map(len, pairs.levels)) > 0]
    if not given:
        raise ArrayError("the image has no three usable pixels in a row to estimate the noise from: "
                         "give a calibration with the electrons of a unit and the read noise")
    level = float(np.median(images[:, keep]))
    return min(given, key=lambda noise: noise.read**2 + noise.shot * max(level, 0.0))


class _Pairs(NamedTuple):
    levels: list[np.ndarray]
    squares: list[np.ndarray]

    def add(self, level: np.ndarray, squared: np.ndarray) -> None:
        self.levels.append(level.reshape(-1))
        self.squares.append(squared.reshape(-1))


def _fit(pairs: _Pairs) -> Noise:
    """Return the noise model whose line passes through the medians of squared noise over bins of level; neither coefficient is below
    zero."""
    level, squared = np.concatenate(pairs.levels), np.concatenate(pairs.squares)
    bins = min(BINS, len(level) // LEAST_IN_BIN)
    if bins < 3:
        return Noise(0.0, float(squared.mean()) ** 0.5)
    edges = np.array_split(np.argsort(level), bins)
    x = np.array([level[part].mean() for part in edges])
    y = np.array([np.median(squared[part]) for part in edges]) / CHI_SQUARED_MEDIAN
    weight = 1 / np.maximum(y, 1e-12 * max(float(np.abs(x).max()), 1e-30) ** 2)  # the error of a variance is in proportion to it
    for _ in range(3):
        sx, sy, s1 = (weight**2 * x).sum(), (weight**2 * y).sum(), (weight**2).sum()
        sxx, sxy = (weight**2 * x * x).sum(), (weight**2 * x * y).sum()
        bottom = s1 * sxx - sx * sx
        shot = (s1 * sxy - sx * sy) / bottom if bottom > 0 else 0.0
        base = (sy - shot * sx) / s1
        if shot < 0:
            shot, base = 0.0, sy / s1
        elif base < 0:
            shot, base = (sxy / sxx if sxx > 0 else 0.0), 0.0
        model = base + shot * np.maximum(x, 0)
        off = y > OFF_LINE * model
        weight = 1 / np.where(off & (off.mean() < FEW_OFF), y, np.maximum(model, model.max() * 1e-6 + 1e-30))
    shot, base = max(float(shot), 0.0), max(float(base), 0.0)
    unseen = (LEAST_READ_ELECTRONS * shot) ** 2
    if shot * float(x.min()) > HIDDEN * unseen:
        base = max(base, unseen)
    return Noise(shot, base**0.5)


POOLED = 0.5
"""Factor on the probability of the wrap of a pixel that was decoded with its dark neighbours: whether it is on their surface, its own light
does not tell."""
NO_SIGNAL = (Status.UNSOLVED, Status.LOW_MODULATION, Status.SATURATED)
"""Statuses of pixels whose phases say nothing."""
MOST_OF_SCENE = 0.5
"""Part of the pixels from which a disagreement of the frequencies is told of."""
SCATTERED_RAD = 0.1
"""Median disagreement of the frequencies beyond noise above which no range is believed: the third harmonic
of square waves, 11 %, bends phases by two thirds of it."""


def solve_correlations(frames: CorrelationImages, options: TofOptions, calibration: TofCalibration, *, near_m: float | None,
                       far_m: float | None, limit: float | None, usable: np.ndarray, rays: np.ndarray | None,
                       device: str) -> RangeImage:
    """Return the range of each pixel from correlation images, of every pixel from which one can be decoded, however unsurely.
    `near_m, far_m`: the span of ranges; None: 0, and as far as the frequencies tell apart. `limit`: saturation, in recorded values.
    `rays`: [rows, cols, 3] unit directions of the lines of sight; None where they are parallel."""
    rows, cols = usable.shape
    weights(frames.modulation_hz, frames.reference_phase_rad, frames.scale)  # faults of the frames come before those of the options
    nearest = near_m or 0.0
    farthest = far_m or nearest + common_range_m(frames.modulation_hz, SPEED_OF_LIGHT)
    require_span(frames.modulation_hz, nearest, farthest, SPEED_OF_LIGHT)
    warnings: list[str] = []
    if limit is None and (limit := full_at(frames.images[:, usable.reshape(-1)])) is not None:
        warnings.append(f"saturation: is not given, and the readings of {(frames.images >= limit).any(axis=0).sum()} pixels stop at "
                        f"{limit:g}, as those of a full camera: these are taken for saturated")
    whole = usable if limit is None else usable & (frames.images < limit).all(axis=0).reshape(usable.shape)
    noise, source = _noise(frames, calibration, whole)
    found = decode(frames.images, frames.modulation_hz, frames.reference_phase_rad, noise=noise, saturation=limit, scale=frames.scale,
                   device=device)
    unfit = unfitting_pixels(found, noise, rows * cols)
    found = _straighten(found, calibration)
    reach = np.zeros(rows * cols, dtype=np.int32)
    if options.vote:
        found, pooled = pool(found, rows, cols, light_speed=SPEED_OF_LIGHT)
        reach = to_numpy(pooled)[:rows * cols]
    straight = [hz for hz in found.modulation_hz.tolist() if calibration.of_frequency(hz) is not None]
    agreement = AGREEMENT_RAD if len(straight) == len(found.modulation_hz) else UNCALIBRATED_RAD

    def ranges_of(phases: Correlation, most_m: float = farthest) -> Ranges:
        hypotheses = unwrap(phases, nearest_m=nearest, farthest_m=most_m, light_speed=SPEED_OF_LIGHT)
        if options.vote:
            hypotheses = vote(hypotheses, rows, cols)
        return decide(phases, hypotheses, light_speed=SPEED_OF_LIGHT, agreement_rad=agreement)

    pixels = rows * cols
    ranges = ranges_of(found)
    status = first_status = to_numpy(ranges.status)[:pixels]
    widened = widen(found, ranges, rows, cols, light_speed=SPEED_OF_LIGHT)
    further = to_numpy(widened.further)[:pixels]
    if further.any():
        ranges = ranges_of(widened.found)
        again = to_numpy(ranges.status)[:pixels]
        status = np.where((status == Status.MULTIPATH) & (again == Status.OK), status, again)
    spacing_m = common_range_m(frames.modulation_hz.max(), SPEED_OF_LIGHT)
    sigma = to_numpy(cover_steps(ranges, found.amplitude, rows, cols, spacing_m=spacing_m))[:pixels]
    confidence = to_numpy(ranges.confidence)[:pixels] * np.where(reach > 0, POOLED, 1).astype(np.float32)
    lit = usable.reshape(-1) & ~np.isin(first_status, NO_SIGNAL)
    declared = float(((first_status == Status.OK) & (further == 0))[lit].mean()) if lit.any() else 1.0

    def agreeing(other: Phases) -> float:
        phases = _with_phases(found, other)
        first = ranges_of(phases, min(farthest, nearest + common_range_m(other.hz, SPEED_OF_LIGHT)))
        more = to_numpy(widen(phases, first, rows, cols, light_speed=SPEED_OF_LIGHT).further)[:pixels]
        return float(((to_numpy(first.status)[:pixels] == Status.OK) & (more == 0))[lit].mean())

    phase, spread = (to_numpy(array)[:, :pixels].reshape(-1, rows, cols) for array in (found.phase, found.sigma))
    size_rad = np.inf
    wrong = (unfitting_images(frames.images, frames.modulation_hz, frames.reference_phase_rad, frames.scale, whole)
             or lost_images(frames, whole.reshape(-1)))
    if wrong is None and lit.any():
        read = Phases(phase, spread, found.modulation_hz)
        wrong = misread_frequencies(read, declared, agreeing, other_images(frames, read))
    sure = (np.isin(status, SOLVED) & lit).reshape(rows, cols)
    repeat_m = common_range_m(frames.modulation_hz, SPEED_OF_LIGHT)
    range_m = to_numpy(ranges.range)[:pixels].reshape(rows, cols)
    if wrong is None:
        amplitude = to_numpy(found.amplitude)[-1, :pixels].reshape(rows, cols)
        reversed_m = nearest + (-range_m - nearest) % repeat_m
        wrong = (turned_inside_out(range_m, reversed_m, amplitude, sure, rays, repeat_m=repeat_m, reversal=PHASES)
                 or beyond_span(range_m, sure, nearest_m=nearest, repeat_m=repeat_m))
    if wrong is None:
        size_rad, wrong = _disagreement(further[usable.reshape(-1)], len(straight) == len(found.modulation_hz), (found.freedom == 0).any())
    if wrong is not None and size_rad > SCATTERED_RAD:
        confidence = confidence * DOUBTED
    else:
        confidence = np.where(unfit, confidence * DOUBTED, confidence)
        part = float((unfit & lit).sum() / max(lit.sum(), 1))
        if part >= MANY_UNFIT:
            warnings.append(f"frames[].tof: at {100 * part:.2g} % of the pixels the images of a frequency are no wave over their phases, "
                            "as where rows of an image were lost, or something moved between two: these are unsure")
    facts = {
        "modulation_hz": found.modulation_hz.tolist(),
        "images": len(frames.images),
        "span_m": [nearest, round(farthest, 4)],
        "common_range_m": round(repeat_m, 4),
        "vote": options.vote,
        "noise": {"electrons_per_unit": 1 / noise.shot if noise.shot > 0 else None, "read_units": noise.read, "from": source},
        "wiggling": straight,
        "agreement_rad": agreement,
        "with_neighbours": int((usable.reshape(-1) & (reach > 0) & np.isin(status, ESTIMATED)).sum()),
    }
    return RangeImage("time of flight, continuous wave", to_numpy(ranges.range)[:pixels], sigma,
                    to_numpy(found.amplitude)[:, :pixels].mean(axis=0), confidence, status, facts, DECIDED,
                    (*warnings, *([] if wrong is None else [wrong])))


def _with_phases(found: Correlation, other: Phases) -> Correlation:
    """Return the phases of a whole image as `unwrap` takes them: under other frequencies, or running the other way."""
    arrays = []
    for before, after in ((found.phase, other.phase), (found.sigma, other.sigma)):
        values = to_numpy(before).copy()
        values[:, :after[0].size] = after.reshape(len(after), -1)
        arrays.append(wp.array(values, dtype=wp.float32, device=str(before.device)))
    return found._replace(phase=arrays[0], sigma=arrays[1], modulation_hz=other.hz)


def _disagreement(further: np.ndarray, calibrated: bool, threes: bool) -> tuple[float, str | None]:
    """Return by how much the frequencies disagree beyond noise, radians (`further`, τ² of `widen`), and a sentence if they do over most of
    the scene. `threes`: whether a frequency has three images, which any wave fits."""
    part = float((further > 0).mean()) if further.size else 0.0
    if part < MOST_OF_SCENE:
        return 0.0, None
    size_rad = float(np.sqrt(np.median(further[further > 0])))
    advice = ("check that the calibration is of this camera" if calibrated
              else "measure the wiggling with relit calibrate tof and give --tof-calibration")
    so = ("no range is believed, because wiggling seldom bends phases by that much" if size_rad > SCATTERED_RAD
          else "the standard deviations hold what the frequencies disagree by, not an error that they share")
    image = ", or by an image that is not that of its phase" if threes else ""
    return size_rad, (f"frames[].tof: the phases of the frequencies disagree by {1000 * size_rad:.0f} mrad more than noise at "
                      f"{100 * part:.0f} % of the pixels, by wiggling or by light that comes over several ways, as in fog{image}: "
                      f"{advice}, and modulation_hz; {so}")


def _noise(frames: CorrelationImages, calibration: TofCalibration, whole: np.ndarray) -> tuple[Noise, str]:
    """Return the noise of a reading, and where it is known from. `whole`: [rows, cols] bool, pixels without clipped readings."""
    if calibration.electrons_per_unit is not None and calibration.read_noise_electrons is not None:
        unit = calibration.electrons_per_unit
        return Noise(1 / unit, calibration.read_noise_electrons / unit), "calibration"
    return estimate_noise(frames.images, frames.modulation_hz, frames.reference_phase_rad, cols=whole.shape[1], scale=frames.scale,
                          usable=whole.reshape(-1)), "images"


def _straighten(found: Correlation, calibration: TofCalibration) -> Correlation:
    known = [calibration.of_frequency(hz) for hz in found.modulation_hz.tolist()]
    if not any(known):
        return found
    table = np.stack([np.zeros(ENTRIES) if h is None else sample_harmonics(np.array(h.cos), np.array(h.sin)) for h in known])
    return straighten(found, table)
