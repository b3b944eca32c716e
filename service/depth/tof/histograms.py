"""Photon histograms of a capture → ranges: photons a count, pile-up, pulse, returns, and the neighbours' vote where they are weak."""

import math
from typing import Any

import numpy as np

from kernels.device import to_numpy
from kernels.status import SOLVED, Status
from kernels.tof.histogram.misfit import misfit
from kernels.tof.histogram.pileup import LiveCounts, checked, correct_pileup, place, without_pileup
from kernels.tof.histogram.pulse import Pulse, gaussian, measured
from kernels.tof.histogram.pulse_width import PulseShape, estimate_pulse, likeliest_stretch
from kernels.tof.histogram.returns import Returns, find_returns
from kernels.tof.histogram.rivals import vote_on_returns
from kernels.tof.histogram.undeclared_pileup import PulseCount, estimate_pulses
from service.depth.base.solution import RangeImage
from service.depth.tof.count_scale import CountScale, estimate_count_scale
from service.depth.tof.inside_out import BINS, turned_inside_out
from service.depth.tof.phase_checks import DOUBTED, HISTOGRAM_REPEATS, beyond_span
from service.depth.tof.shared_light import find_fog, pattern_bins, without_bins
from service.errors import RequestError
from service.requests.depth import TofOptions, WhichReturn
from stage.tof.calibration import TofCalibration
from stage.tof.light_time import range_of_delay_m
from stage.tof.raw_frames import Histograms

SAME_WIDTHS, OTHER_WIDTHS = 1.0, 2.0
"""Differences of time, in pulse widths (and bins, where these are wider), up to which two pixels agree and from which they disagree."""
LEAST_PART = 0.02
"""Part of the pixels from which alternation is no chance and no thin object."""


def interlaced(position: np.ndarray, there: np.ndarray, width: float) -> np.ndarray:
    """Return where a pixel agrees with the second pixels on both sides and the ones between agree with each other alone, [rows, cols] bool.

    These are the pixels of both kinds, along rows or columns; none at all where fewer than LEAST_PART of the pixels are.
    `position`: [rows, cols] times in bins. `width`: of the pulse, in bins."""
    unit = max(width, 1.0)
    found = np.zeros(position.shape, dtype=bool)
    for axis in (0, 1):
        times, present = np.moveaxis(position, axis, 0), np.moveaxis(there, axis, 0)
        if len(times) < 5:
            continue
        shown = np.moveaxis(found, axis, 0)
        near = [times[k : len(times) - 4 + k] for k in range(5)]
        all_there = np.logical_and.reduce([present[k : len(times) - 4 + k] for k in range(5)])
        same = ((np.abs(near[0] - near[2]) < SAME_WIDTHS * unit) & (np.abs(near[4] - near[2]) < SAME_WIDTHS * unit)
                & (np.abs(near[1] - near[3]) < SAME_WIDTHS * unit))
        other = (np.abs(near[1] - near[2]) > OTHER_WIDTHS * unit) & (np.abs(near[3] - near[2]) > OTHER_WIDTHS * unit)
        comb = all_there & same & other
        for k in range(1, 4):
            shown[k : len(times) - 4 + k] |= comb
    return found if found[there].size and found[there].mean() > LEAST_PART else np.zeros_like(found)


LEAST_CEILING, FLAT_TOPS, HEAPED = 50, 10, 5.0
"""The least count that can be a counter's ceiling; the number of pixels whose fullest bins reach it side by side, or, where it is the
largest number of some bits, of twice as many that reach it at all, and their number over that of the counts below it."""


def full_count(counts: np.ndarray) -> float | None:
    """Return the count at which a counter of histograms [pixel, bin] was full; None if it shows none.

    Photon noise gives the largest count of all to one bin, and hardly to two beside each other.
    """
    top = float(counts.max(initial=0))
    if top < LEAST_CEILING or top != round(top):
        return None
    full = counts == top
    heaped, below = int(full.any(axis=1).sum()), int(((counts >= 0.9 * top) & ~full).sum()) / (0.1 * top)
    flat = int((full[:, 1:] & full[:, :-1]).any(axis=1).sum())
    bits = math.log2(top + 1).is_integer() and heaped >= 2 * FLAT_TOPS
    return top if (flat >= FLAT_TOPS or bits) and heaped > HEAPED * below else None


NARROW, NARROW_DOUBT = 0.6, 1.4
"""Width of a pulse, in bins, below which it shows only where a return lies at the border of a bin, and by what factor it is then off."""
MOST_RETURNS = 3
"""Returns that are looked for in a histogram."""
LEAST_CONFIDENCE = 0.95
"""Least probability of a return that counts as solved by default: one pixel in a thousand without a return is then taken to have one."""
MISSING, MISSING_ODDS = 0.5, 5.0
"""Probability of no return from which a pixel has no estimate, if it is also so many times as probable as the best return."""
IN_TURN = 0.5
"""Probability that a pixel is of the right rows where every second row or column shows another time."""
MISFIT_PIXELS = 0.2
"""Part of the pixels with a misfit from which it is told in a sentence."""


def solve_histograms(frames: Histograms, options: TofOptions, calibration: TofCalibration, *, near_m: float | None,
                     far_m: float | None, limit: float | None, usable: np.ndarray, rays: np.ndarray | None, device: str) -> RangeImage:
    """Return the range of each pixel from photon histograms.
    `near_m, far_m`: the span of half paths; None: that of the histogram. `limit`: counts at or above it are a full counter. `usable`:
    [rows, cols] bool mask: the others decide on nothing. `rays`: [rows, cols, 3] unit directions of the lines of sight; None where they
    are parallel."""
    bin_m = range_of_delay_m(frames.bin_s)
    start_m = range_of_delay_m(frames.start_s)
    end_m = start_m + bin_m * frames.counts.shape[1]
    nearest = start_m if near_m is None else near_m
    farthest = end_m if far_m is None else far_m
    if not max(nearest, start_m) < min(farthest, end_m):
        raise RequestError(f"ranges from {nearest:g} to {farthest:g} m lie outside the histogram, "
                           f"which covers {start_m:.4g} to {end_m:.4g} m")
    checked(frames.counts)  # faults of the counts come before those of what is estimated from them
    rows, cols = usable.shape
    usable = usable.reshape(-1)
    pattern = pattern_bins(frames.counts[usable])
    photons_of, scale_facts, warnings = _photons(frames, usable, pattern)
    fog = find_fog(photons_of[usable], start_m, bin_m)
    if fog is not None:
        pattern = fog.head
    if limit is None and (full := full_count(frames.counts[usable])) is not None:
        limit = full
        warnings.append(f"saturation: is not given, and the counts of {(frames.counts[usable] >= full).any(axis=1).sum()} pixels stop at "
                        f"{full:g}, as those of a full counter: these are taken for saturated")
    first_bin, last_bin = max((nearest - start_m) / bin_m, 0.0), min((farthest - start_m) / bin_m, float(frames.counts.shape[1]))
    if fog is not None:
        head = np.flatnonzero(fog.head)
        ends = [start_m + bin_m * value for value in (head[0], head[-1] + 1)]
        warnings.append("frames[].tof: all pixels show light that begins near the camera and falls slowly with distance, as fog returns "
                        f"it: returns are not looked for from {ends[0]:.3g} to {ends[1]:.3g} m, where it is strongest; what is no stronger "
                        "than the fog has a low confidence, and the standard deviations hold the shift that its slope makes")
    elif pattern[int(first_bin) :].any():
        warnings.append(f"frames[].tof: nearly all pixels show the same pulse at {start_m + bin_m * (np.argmax(pattern) + 0.5):.3g} to "
                        f"{start_m + bin_m * (len(pattern) - np.argmax(pattern[::-1]) - 0.5):.3g} m, which is taken for the camera's own "
                        "light, or for bins that its timer fills: returns are looked for outside of them; give --near-m beyond it, or "
                        "before it to keep it")
    histograms, shape, pile_up = live_photons(frames, photons_of, calibration, pattern, usable, device, warnings)
    pulse, source, zero_bins = _zero_of(shape, frames, calibration, warnings)
    found = find_returns(histograms, pulse, most=MOST_RETURNS, first_bin=first_bin, last_bin=last_bin)
    chosen = _choose(found, options.which, None if fog is None else np.stack([
        fog.stands_out(photons_of, to_numpy(found.background), place, pulse.width) for place in to_numpy(found.position)]))

    def of(values: np.ndarray) -> np.ndarray:
        return np.asarray(np.take_along_axis(values, chosen[None], axis=0)[0])

    dispersion = of(misfit(histograms, pulse, found))
    position, sigma, photons, confidence = (of(to_numpy(array)) for array in (found.position, found.sigma, found.photons, found.confidence))
    sigma = sigma * np.sqrt(dispersion)
    status = to_numpy(found.status)
    weak = 0
    if options.vote:
        voted = vote_on_returns(histograms, pulse, found, rows, cols, usable=usable, first_bin=first_bin, last_bin=last_bin)
        taken = voted.weak & ((photons == 0) | (options.which is WhichReturn.STRONGEST))
        position, sigma, photons = (np.where(taken, new, old) for new, old in zip(voted[:3], (position, sigma, photons), strict=True))
        confidence = np.where(taken | (chosen == 0), voted.confidence, confidence)
        missing = voted.none > np.maximum(MISSING, MISSING_ODDS * voted.confidence)
        status = np.where(missing, int(Status.LOW_MODULATION), np.where(taken & (photons > 0), int(Status.OK), status))
        weak = int((taken & ~missing).sum())
    if pile_up is not None and pile_up.relative > 0:
        more = max(math.ceil(pile_up.pulses * math.exp(pile_up.relative)), pile_up.pulses + 1)
        sigma = np.hypot(sigma, _moved(correct_pileup(place(photons_of, device), pulses=more), pulse, position, pulse.width))
    stretch = likeliest_stretch(histograms, photons_of * usable[:, None], pulse) if source["from"] == "calibration" else 1.0
    if stretch != 1:
        longer = pulse.stretched(stretch)
        sigma = np.hypot(sigma, _moved(histograms, longer, position, max(longer.width, NARROW)))
        warnings.append(f"frames[].tof: the brightest returns are those of a pulse {stretch:.2g} times as long as that of "
                        "--tof-calibration: measure it again, or leave it out, to have it estimated; the standard deviations hold by how "
                        "much ranges would then differ")
    if source["from"] == "histograms" and pulse.width < NARROW:
        sigma = np.hypot(sigma, _moved(histograms, pulse.stretched(NARROW_DOUBT), position, NARROW))
    if fog is not None:
        sigma = np.hypot(sigma, fog.shift(position, photons, pulse.width))
        outside = fog.stands_out(photons_of, to_numpy(found.background), position, pulse.width)
        confidence = np.where(outside, confidence, np.minimum(confidence, IN_TURN))
    if limit is not None:
        status = np.where((frames.counts >= limit).any(axis=1), int(Status.SATURATED), status)
    solved = np.isin(status, SOLVED)
    comb = interlaced(position.reshape(rows, cols), (solved & usable & (confidence >= LEAST_CONFIDENCE)).reshape(rows, cols), pulse.width)
    if comb.any():
        confidence = np.where(comb.reshape(-1), np.minimum(confidence, IN_TURN), confidence)
        warnings.append(f"frames[].tof: every second row or column disagrees with those between at {100 * comb.mean():.0f} % of the "
                        "pixels, which have a low confidence: check whether they were recorded with another start or period (tof.start_s)")
    bent = (solved & (dispersion > 1))[usable].mean() if usable.any() else 0.0
    if bent > MISFIT_PIXELS:
        warnings.append(f"frames[].tof: the pulse does not describe the returns of {100 * bent:.0f} % of the pixels, which differ from "
                        "it by more than photon noise: measure the pulse and give it in --tof-calibration; the standard deviations hold "
                        "the scatter that this makes, not a shift that all of them share, as by fog")
    range_m = (start_m + position * bin_m).reshape(rows, cols)
    sure = (solved & usable & (confidence >= LEAST_CONFIDENCE)).reshape(rows, cols)
    wrong = turned_inside_out(range_m, start_m + end_m - range_m, photons.reshape(rows, cols), sure, rays, repeat_m=start_m + end_m,
                              reversal=BINS)
    wrong = wrong or beyond_span(range_m, sure, nearest_m=start_m, repeat_m=end_m - start_m, why=HISTOGRAM_REPEATS)
    if wrong is not None:
        confidence = confidence * DOUBTED
        warnings.append(wrong)
    several = (to_numpy(found.photons) > 0).sum(axis=0)
    facts: dict[str, Any] = {
        "bins": frames.counts.shape[1],
        "bin_s": frames.bin_s,
        "span_m": [round(nearest, 4), round(farthest, 4)],
        "pulse": source,
        "count_scale": scale_facts,
        "pile_up": {"corrected": frames.first_photon_only or pile_up is not None,
                    "pulses": frames.pulses if pile_up is None else pile_up.pulses,
                    "from": "manifest" if frames.first_photon_only else "none found" if pile_up is None else "histograms"},
        "return": str(options.which),
        "returns_found": {str(n): int((several[usable] == n).sum()) for n in range(1, MOST_RETURNS + 1)},
        "chosen_by_neighbours": weak,
        "background_photons_a_bin": float(np.median(to_numpy(found.background)[usable])),
    }
    return RangeImage("time of flight, pulsed", range_m.reshape(-1).astype(np.float32),
                      (np.hypot(sigma, zero_bins) * bin_m).astype(np.float32), photons.astype(np.float32),
                      np.where(solved, confidence, 0).astype(np.float32), status, facts, LEAST_CONFIDENCE, tuple(warnings))


def _photons(frames: Histograms, usable: np.ndarray, pattern: np.ndarray) -> tuple[np.ndarray, dict[str, Any], list[str]]:
    """Return the counts in photons, [pixel, bin], facts about their scale, and a sentence where it is not one."""
    if frames.count_scale is not None:
        return (frames.counts / np.float32(frames.count_scale)).astype(np.float32), {"units": frames.count_scale, "from": "manifest"}, []
    scale = estimate_count_scale(frames.counts[usable][:, ~pattern])
    facts = {"units": float(f"{scale.units:.4g}"), "from": "background" if scale.measured else "values"}
    return (frames.counts / np.float32(scale.units)).astype(np.float32), facts, scale_warnings(scale)


def scale_warnings(scale: CountScale) -> list[str]:
    """Return what is said of counts that are not counts of photons."""
    warnings = []
    if scale.units != 1:
        warnings.append(f"tof: counts vary as if {scale.units:.3g} units were one photon, and were divided by that: give counts "
                        "of photons, or tof.count_scale, the recorded units of one photon")
    if scale.shared:
        warnings.append("tof: neighbouring bins vary together, as in histograms that were smoothed: give them as recorded; the standard "
                        "deviations are those of a pulse as wide as the smoothed one")
    return warnings


def live_photons(frames: Histograms, photons: np.ndarray, calibration: TofCalibration, pattern: np.ndarray, usable: np.ndarray,
                 device: str, warnings: list[str]) -> tuple[LiveCounts, PulseShape, PulseCount | None]:
    """Return the histograms without pile-up, declared or found, their pulse, and the number of pulses if it was found; adds a sentence to
    `warnings`.
    `photons`: [pixel, bin]. `pattern`: [bin] bool, those that show no return. `usable`: [pixel] bool, those that decide."""
    counts = place(photons, device)
    shown = np.where(usable[:, None] & ~pattern, photons, 0)

    def shape_of(histograms: LiveCounts, some: np.ndarray) -> PulseShape:
        if calibration.pulse is not None:
            pulse = measured(np.array(calibration.pulse.time_s) / frames.bin_s, calibration.pulse.power)
            return PulseShape(pulse, 0.0, 0.0, 0.0)
        if calibration.pulse_sigma_s is not None:
            sigma = calibration.pulse_sigma_s / frames.bin_s
            return PulseShape(gaussian(sigma), sigma, 0.0, 0.0)
        return estimate_pulse(histograms, some)

    if frames.first_photon_only:
        assert frames.pulses is not None  # the reader saw to it
        histograms = correct_pileup(counts, pulses=frames.pulses)
    else:
        histograms = without_pileup(counts)
    if pattern.any():  # no return: the number of pulses is not looked for
        histograms = without_bins(histograms, pattern)
    shape = shape_of(histograms, shown)
    if frames.first_photon_only or pattern.any():
        return histograms, shape, None
    known = frames.pulses if frames.pulses is not None and frames.pulses >= photons.sum(axis=1).max() else None
    found = estimate_pulses(photons[usable], shape.pulse, device, lambda some, seen: shape_of(some, seen).pulse, declared=known)
    if found is None:
        return histograms, shape, None
    warnings.append("tof.pulses, tof.first_photon_only: the histograms show pile-up that is not declared, as if the first photon alone of "
                    f"each of {found.pulses} pulses had been counted ({100 * found.used:.0f} % of the pulses in the fullest histogram), "
                    "and were corrected for it: declare both")
    histograms = correct_pileup(counts, pulses=found.pulses)
    return histograms, shape_of(histograms, shown), found


def _moved(histograms: LiveCounts, pulse: Pulse, position: np.ndarray, most: float) -> np.ndarray:
    """Return by how many bins each position moves where histograms or pulse are others, as likely ones; 0 where by `most` or more, to
    another return."""
    moved = np.abs(to_numpy(find_returns(histograms, pulse).position)[0] - position)
    return np.where(moved < most, moved, 0)


def _zero_of(shape: PulseShape, frames: Histograms, calibration: TofCalibration, warnings: list[str]
             ) -> tuple[Pulse, dict[str, Any], float]:
    """Return the pulse, where it is known from, and the standard deviation of its zero in bins; adds a sentence to `warnings`."""
    if calibration.pulse is not None:
        return shape.pulse, {"from": "calibration", "width_s": shape.pulse.width * frames.bin_s}, 0.0
    if calibration.pulse_sigma_s is not None:
        return shape.pulse, {"from": "calibration", "sigma_s": calibration.pulse_sigma_s}, 0.0
    facts: dict[str, Any] = {"from": "histograms", "sigma_s": float(f"{shape.sigma * frames.bin_s:.4g}")}
    if shape.flat:
        facts |= {"flat_s": float(f"{shape.flat * frames.bin_s:.4g}")}
    if shape.part == 0:
        return shape.pulse, facts, 0.0
    facts |= {"tail_s": float(f"{shape.tail * frames.bin_s:.4g}"), "tail_part": float(f"{shape.part:.3g}")}
    if calibration.offset_m != 0:
        return shape.pulse, facts, 0.0
    late_m = range_of_delay_m(shape.pulse.mean * frames.bin_s)
    warnings.append(f"frames[].tof: the pulse has a tail ({100 * shape.part:.0f} % of its photons come {shape.tail * frames.bin_s:.2g} s "
                    "later on average), and ranges are those of its highest power: whether the camera's zero is there or up to "
                    f"{late_m:.2g} m beside it is not known: give pulse or offset_m in --tof-calibration; the standard deviations cover "
                    "this zero alone")
    return shape.pulse, facts, shape.pulse.mean / math.sqrt(3)


def _choose(found: Returns, which: WhichReturn, surface: np.ndarray | None = None) -> np.ndarray:
    """Return the index of the return to take, [pixel]; 0 where there is none. `surface`: which of them may be one, [return, pixel]."""
    position, there = to_numpy(found.position), to_numpy(found.photons) > 0
    if surface is not None:
        there &= surface
    if which is WhichReturn.FIRST:
        return np.argmin(np.where(there, position, math.inf), axis=0)
    if which is WhichReturn.LAST:
        return np.argmax(np.where(there, position, -math.inf), axis=0)
    return np.asarray(np.argmax(there, axis=0)) if surface is not None else np.zeros(position.shape[1], dtype=np.int64)
