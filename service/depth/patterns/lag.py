"""Places that shift with the width of a pattern, as where light runs below the surface before it leaves it.

Light from below a translucent surface comes from beside the place that the projector lights. It shifts a wave, and a wide one more than a
narrow one; the edges of stripes it shifts otherwise than waves. Blur, texture and noise shift places to either side alike, so the mean over
the pixels around tells such a lag. How far the places are off follows from it and from the modulation: light that comes from one side dims
a wave as it shifts it, because the phase of a filter of one side follows from its amplitude (Bode 1945).
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from scipy.ndimage import maximum_filter, uniform_filter

from kernels.structured.pattern_frames import NoiseModel
from kernels.structured.phase import weights
from service.depth.patterns.coordinates import AxisMaps, Coordinates
from service.depth.patterns.decoders import AxisDecoder
from service.depth.patterns.levels import contrasts
from service.depth.patterns.readings import grey_of
from stage.patterns.binary import BinaryCode
from stage.patterns.codes import Code, Collected
from stage.patterns.phase import FULL_STEPS, PhaseCode
from stage.stack.planes import Planes

AROUND = 15
"""Side in pixels of the square over which a lag is averaged."""
LEAST_KNOWN = 0.2
"""Least part of the square that must be decoded: 45 pixels, over which what is not a lag averages to a seventh."""
STRIPS = 6
"""Number of strips of image rows, as high as the square, that are looked at first."""
CLEAR_SIGMAS, CLEAR_PX = 4.0, 0.1
"""Lag in its standard deviations and in projector pixels from which on it is neither noise nor a lens."""
PROBABLE_SIGMAS = 3.0
"""The same in σ for single places where others are clear: from there on the surroundings of a place, as far as the square reaches, are
taken for translucent. Noise alone goes beyond it at one place in 370, which makes σ wider there and nothing wrong."""
CLEAR_SHARE, ONE_WAY = 0.02, 0.8
"""Part of the decoded pixels with a clear lag, and part of these whose lag has the same direction, from which on light runs below surfaces:
texture and edges make lags of both directions."""
OF_A_PIXEL = 0.06
"""Lag of stripes over what a camera pixel sees of the projector, from which on it is said: pixels that see several of its pixels find the
edges of right captures up to .05 of that aside, in a quarter of 48 simulated ones, and further in two. Sigma is wider from CLEAR_PX on."""
FOLDED = 0.005, 0.33
"""The same part, least and most, from which on single places are off because light bounces between folds: to either side, as folds open to
both. Nothing is said of it, and sigma is wider in the squares around these places alone. Waves that are no sines lag everywhere."""
WIDESPREAD_SIGMAS, WIDESPREAD = 2.0, 0.4
"""Lag in its standard deviations, and part of all pixels that have one beyond and are dimmed as much, from which on light runs below
surfaces whatever the directions: noise makes one at a twentieth, and texture under a lens out of focus at a tenth."""
EDGE_TIMES, DIMMED_TIMES = 2.0, 0.7
"""What the lag of stripes, and the width of light that dims a wave as much as it is dimmed, count as a standard deviation of the place:
between what is right for light that runs near and far."""
LARGEST_PART, OWN_SIGMAS = 1 / 6, 3.0
"""Lag of a pixel by itself, as a part of the shortest period, and its standard deviations beyond, above which the pixel is left out: its
periods are counted wrongly."""
NEAR_PART, FAR_PART = 0.25, 0.5
"""Distances of pixels from the edge of a stripe, as parts of the finest stripe, that tell where the edge crosses the mean of white and
black, and where half of the light has come."""
MIDDLE = 0.4
"""Middle of a stripe, as a part of it, where its edges are far."""
UNKNOWN = np.nan, 0.0, 0.0, np.nan
"""Fields of `Lags` where too little is decoded."""
LAG_BYTES_PER_PIXEL = 2000
"""Memory that the fit of waves takes for each pixel."""


class LagFinding(NamedTuple):
    """The evidence of an axis for light below surfaces, or between folds."""

    sigma: np.ndarray  # [rows, cols] float32, by how much places may be off, projector pixels
    usual_px: float
    """Median of the lag where it is clear."""
    share: float
    """Part of the decoded pixels where it is clear; 0: at too few, to both sides, or by too little of a camera pixel."""

    def sentences(self, axis: str) -> list[str]:
        """Return what a user is told."""
        return [] if not self.share else [
            f"frames[].pattern: {axis}s that different {axis} patterns show differ by {self.usual_px:.2g} px at "
            f"{100 * self.share:.0f} % of the pixels, as where light bounces between folds or runs below the surface of translucent "
            "things, or where frames hold part of the next pattern: the standard deviations hold about what that makes; cover "
            "translucent things with matt paint or powder"]


class Lags(NamedTuple):
    """The lag of each pixel, averaged over the pixels around."""

    size: np.ndarray  # [rows, cols] projector pixels, NaN where too little is decoded
    deviation: np.ndarray  # [rows, cols] of noise
    error: np.ndarray  # [rows, cols] by how much the place is off if light from below the surface makes the lag
    most: np.ndarray  # [rows, cols] lag that the dimming of fine waves against wide stripes allows; NaN where nothing tells it

    def beyond(self, sigmas: float) -> np.ndarray:
        """Return where the lag is larger than so many standard deviations, and not larger than light from nearby makes, [rows, cols] bool:
        what bounces off another surface shifts the edges of stripes, and dims wide and fine ones alike."""
        return (np.abs(self.size) > sigmas * self.deviation) & ~(np.abs(self.size) > self.most)

    def single(self) -> np.ndarray:
        """Return where places are clearly off by themselves, [rows, cols] bool."""
        return self.beyond(CLEAR_SIGMAS) & (np.abs(self.size) > CLEAR_PX)

    def single_part(self) -> float:
        """Return their part of the decoded pixels."""
        return float(self.single().sum() / max(np.isfinite(self.size).sum(), 1))

    def clear(self) -> tuple[float, float] | None:
        """Return the usual size of the lags that are clear, and their part of the decoded pixels; None where they show no light below
        surfaces."""
        known = np.isfinite(self.size)
        large = np.abs(self.size) > np.maximum(CLEAR_SIGMAS * self.deviation, CLEAR_PX)
        one_way = large.any() and abs(np.sign(self.size[large]).mean()) >= 2 * ONE_WAY - 1
        found = self.size[large & self.beyond(CLEAR_SIGMAS)]
        if found.size < CLEAR_SHARE * known.sum() or not one_way:
            found = self.size[self.beyond(WIDESPREAD_SIGMAS) & (np.abs(self.size) <= self.most)]
            if not found.size or found.size < WIDESPREAD * known.sum() or np.median(np.abs(found)) < CLEAR_PX / 2:
                return None
        return float(np.median(np.abs(found))), found.size / known.sum()


def widen_lagging(planes: Planes, coordinates: Coordinates, decoders: Sequence[AxisDecoder | None], collected: Collected,
                  noise: NoiseModel) -> tuple[list[str], np.ndarray]:
    """Add to the deviations of places what light below surfaces makes; return what is said of it, and the factor of `Coordinates.widen`."""
    said: list[str] = []

    def off(axis: AxisMaps, decoder: AxisDecoder) -> np.ndarray | None:
        found = find_lag(planes, axis, decoder, collected, noise)
        said.extend(() if found is None else found.sentences(decoder.axis))
        return None if found is None else found.sigma

    wider = coordinates.widen(decoders, off)
    return said, wider


def find_lag(planes: Planes, axis: AxisMaps, decoder: AxisDecoder, collected: Collected, noise: NoiseModel) -> LagFinding | None:
    """Return by how much the decoded places of an axis may be off because light runs below surfaces or bounces between folds; None
    where nothing shows it."""
    measure = _measure_of(decoder.used, collected, noise)
    height = len(axis.coordinate)
    if measure is None or not axis.solved.any():
        return None
    tops = np.unique(np.linspace(0, max(height - AROUND, 0), STRIPS).astype(int))
    strips = [_lags(planes, axis, slice(top, min(top + AROUND, height)), measure) for top in tops]
    seen = Lags(*(np.concatenate(values) for values in zip(*strips, strict=True)))
    if seen.clear() is None and not (measure.between_waves and seen.single_part() >= FOLDED[0] / 2):
        return None
    lags = Lags(*(np.full_like(axis.coordinate, value) for value in UNKNOWN))
    for band in planes.bands(LAG_BYTES_PER_PIXEL):
        around = slice(max(band.start - AROUND, 0), min(band.stop + AROUND, height))
        inside = slice(band.start - around.start, band.stop - around.start)
        for whole, part in zip(lags, _lags(planes, axis, around, measure), strict=True):
            whole[band] = part[inside]
    clear = lags.clear()
    if clear is not None:
        beside = maximum_filter(lags.beyond(PROBABLE_SIGMAS), 2 * AROUND + 1)
    elif measure.between_waves and FOLDED[0] <= lags.single_part() <= FOLDED[1]:
        beside = maximum_filter(lags.single(), AROUND)
    else:
        return None
    usual, share = clear or (0.0, 0.0)
    seen_by_a_pixel = float(np.median(np.hypot(*np.gradient(axis.coordinate))[axis.solved]))
    said = measure.between_waves or usual >= OF_A_PIXEL * seen_by_a_pixel
    return LagFinding(np.where(beside, lags.error, 0), usual, share if said else 0.0)


class _Measure(NamedTuple):
    """How the frames of a code tell a lag."""

    sums: Callable[[np.ndarray, np.ndarray], np.ndarray]
    """Returns the sums [sums, pixels] that are averaged over pixels, from readings [frames, pixels] and places [pixels]."""
    lag: Callable[[np.ndarray, np.ndarray], Lags]
    """Returns the lags, from these averages and the number of pixels in each."""
    between_waves: bool
    """Whether single places can tell it: edges of stripes lag as much beside periods counted wrongly, and on texture out of focus."""


def _measure_of(used: Sequence[Code], collected: Collected, noise: NoiseModel) -> _Measure | None:
    phase = next((code for code in used if isinstance(code, PhaseCode)), None)
    if phase is None or len(phase.frames) < FULL_STEPS:
        return None
    if len(set(phase.periods_px)) > 1:
        return _Measure(lambda grey, place: _wave_sums(grey, place, phase, noise), lambda means, count: _wave_lag(means, count, phase),
                        between_waves=True)
    stripes = next((code for code in used if isinstance(code, BinaryCode) and code.name != "xor"), None)
    if stripes is None or stripes.lacks(collected.white, collected.black) is not None:
        return None
    return _Measure(lambda grey, place: _edge_sums(grey, place, stripes, phase, collected),
                    lambda means, count: _edge_lag(means, count, stripes, phase), between_waves=False)


def _lags(planes: Planes, axis: AxisMaps, rows: slice, measure: _Measure) -> Lags:
    grey = grey_of(planes.band(rows))
    solved = axis.solved[rows]
    if planes.saturated is not None:
        solved = solved & ~planes.saturated[:, rows].any(axis=0)
    at = np.flatnonzero(solved)
    if not at.size:
        return Lags(*(np.full(solved.shape, value) for value in UNKNOWN))
    told = measure.sums(grey[:, at].astype(np.float64), axis.coordinate[rows].ravel()[at].astype(np.float64))
    sums = np.zeros((len(told), solved.size))
    sums[:, at] = told
    part = np.maximum(uniform_filter(solved.astype(np.float64), AROUND, mode="constant"), 1e-9)
    means = np.stack([uniform_filter(each.reshape(solved.shape), AROUND, mode="constant") for each in sums]) / part
    found = measure.lag(means, part * AROUND**2)
    known = solved & (part >= LEAST_KNOWN)
    return Lags(*(np.where(known, values, empty) for values, empty in zip(found, UNKNOWN, strict=True)))


def _wave_sums(grey: np.ndarray, place: np.ndarray, phase: PhaseCode, noise: NoiseModel) -> np.ndarray:
    """Return sums that tell by how much the place changes with the logarithm of a wave's frequency.

    The readings of a pixel are offset, amplitude and place, and changes of amplitude and of place with that logarithm; the last is wanted.
    """
    frequency = 2 * np.pi / np.array(phase.periods_px)
    finer = np.log(frequency) - np.log(frequency).mean()
    turn = np.outer(place, frequency) - 2 * np.pi * np.array(phase.shifts)
    readings = grey[list(phase.frames)].T
    cosine, slope = np.cos(turn), -np.sin(turn) * frequency
    others = np.stack([np.ones_like(turn), cosine, slope, cosine * finer], axis=2)
    wanted = slope * finer
    across = np.swapaxes(others, 1, 2)
    fitted = np.linalg.solve(across @ others + 1e-9 * np.eye(4), across @ np.stack([wanted, readings], axis=2))
    rest = wanted - (others @ fitted[:, :, :1])[:, :, 0]
    amplitude, level = fitted[:, 1, 1], np.maximum(fitted[:, 0, 1], 0)
    along = amplitude * (rest * readings).sum(axis=1)
    weight = amplitude**2 * (rest**2).sum(axis=1)
    variance = weight * (noise.read**2 + noise.gain * level)
    largest = LARGEST_PART * min(phase.periods_px) * weight + OWN_SIGMAS * np.sqrt(variance)
    return np.where(np.abs(along) <= largest, np.stack([along, weight, variance, amplitude * fitted[:, 3, 1], amplitude**2]), 0)


def _wave_lag(means: np.ndarray, count: np.ndarray, phase: PhaseCode) -> Lags:
    weight = np.maximum(means[1], 1e-30)
    size, deviation = means[0] / weight, np.sqrt(np.maximum(means[2], 0) / np.maximum(count, 1)) / weight
    dimmed = np.maximum(-means[3] / np.maximum(means[4], 1e-30), 0)  # change of the amplitude's logarithm with that of the frequency
    usual = float(np.exp(np.log(phase.periods_px).mean())) / (2 * np.pi)
    return Lags(size, deviation, np.hypot(size, np.pi / 2 * dimmed * usual), np.full_like(size, np.nan))


def _edge_sums(grey: np.ndarray, place: np.ndarray, code: BinaryCode, phase: PhaseCode, collected: Collected) -> np.ndarray:
    """Return sums that tell where the edges of stripes lie, against the places of waves, and how much the waves are dimmed.

    Of edges those of stripes as wide as a period count: finer ones shift as the wave does.
    """
    contrast = contrasts(grey, code, collected)
    edge = np.maximum(np.rint(place / code.stripe_px).astype(np.int64), 1)
    away = place - edge * code.stripe_px
    before, after = ((number if code.name == "binary" else number ^ (number >> 1)) for number in (edge - 1, edge))
    changed = before ^ after
    bit = np.minimum(np.log2(changed).astype(np.int64), len(contrast) - 1)  # the coarsest that changes
    white = np.maximum(np.abs(contrast).max(axis=0), 1e-12)
    step = np.where(after >> bit & 1, 1, -1) * np.take_along_axis(contrast, bit[None], 0)[0] / white
    _, along, across = weights(np.array(phase.shifts), phase.periods_px[0]).T @ grey[list(phase.frames)]
    wave = 2 * np.hypot(along, across)
    wide, width = _wider_bit(code, phase)
    amid = np.abs((place / width + (0.5 if code.name == "binary" else 0) + 0.5) % 1 - 0.5) <= MIDDLE / 2
    sums = [wave, white, np.where(amid, wave, 0), np.where(amid, np.abs(contrast[wide]), 0)]
    for part, run in ((NEAR_PART, away), (FAR_PART, np.clip(2 * away / (FAR_PART * code.stripe_px), -1, 1))):
        near = (bit >= wide) & (np.abs(away) <= part * code.stripe_px)
        sums += [np.where(near, each, 0) for each in (np.ones_like(away), run, run**2, step, run * step, step**2)]
    return np.stack(sums)


def _edge_lag(means: np.ndarray, count: np.ndarray, code: BinaryCode, phase: PhaseCode) -> Lags:
    """Return the lag of the place where white and black are equal, or of that where half of the light has come, whichever is larger."""
    found = []
    for ones, *others in (means[4:10], means[10:]):
        number = np.maximum(ones, 1e-12)
        run, square, step, product, power = (each / number for each in others)
        spread = np.maximum(square - run**2, 1e-12)
        slope = np.maximum((product - run * step) / spread, 1e-3)
        level = step - slope * run
        rest = np.maximum(power - step**2 - slope**2 * spread, 0)
        error = np.sqrt(rest * (1 + run**2 / spread) / np.maximum(number * count, 1))
        found.append((level, error, slope))
    (near, near_error, slope), (far, far_error, _) = found
    half = FAR_PART * code.stripe_px
    near, near_error, far, far_error = near / slope, near_error / slope, half * far, half * far_error
    larger = np.abs(near) > np.abs(far)
    size = -np.where(larger, near, far)
    dimmed = np.clip(means[0] / np.maximum(means[1], 1e-30), 0.01, 1)
    wide = np.sqrt(-2 * np.log(dimmed)) * phase.periods_px[0] / (2 * np.pi)  # standard deviation of a Gaussian that dims as much
    fine = np.where(means[3] > 0, means[2] / np.maximum(means[3], 1e-30), np.nan)  # against stripes as wide as its period
    _, width = _wider_bit(code, phase)
    most = np.maximum(-np.log(np.maximum(fine, 1e-3)), 0) / np.log(2 * width / phase.periods_px[0]) * phase.periods_px[0] / 4
    return Lags(size, np.where(larger, near_error, far_error), np.hypot(EDGE_TIMES * size, DIMMED_TIMES * wide), most)


def _wider_bit(code: BinaryCode, phase: PhaseCode) -> tuple[int, float]:
    """Return the finest bit whose stripes are as wide as a period of the wave, or the widest, and how wide they are, projector pixels."""
    finest = code.stripe_px * (1 if code.name == "binary" else 2)
    bit = min(max(int(np.ceil(np.log2(phase.periods_px[0] / finest))), 0), len(code.frames) - 1)
    return bit, finest * 2**bit
