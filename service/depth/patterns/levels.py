"""Levels that no pattern has: frames that mix two patterns, and surfaces that move between frames.

A pattern and its inverse add up to even light, and so do a wave over its shifts, and white and black: to parts of white that are the same
at all pixels, whatever is seen, however blurred it is and whatever the projector's response. Where these sums differ between the bits of a
code, or between the periods of its waves, frames of one pixel do not show one scene under the patterns that are declared: the camera has
recorded parts of two patterns, or the surface has moved. Wide stripes of a Gray code that are neither dark nor bright tell the same.
Where a sum is another part of white than at other pixels, another surface was seen, or an edge or a texture has passed.
"""

from collections.abc import Sequence
from math import ceil
from typing import NamedTuple

import numpy as np

from kernels.structured.pattern_frames import NoiseModel
from kernels.structured.phase import weights
from kernels.structured.response import bent_wave, fitted_curve
from service.depth.patterns.decoders import PatternProjector
from service.depth.patterns.pattern_checks import ENOUGH, FULL_PART, LIT_SIGMAS, Sample
from service.depth.patterns.readings import DECODE_BYTES_PER_PIXEL
from stage.patterns.binary import BinaryCode
from stage.patterns.codes import Code, Collected
from stage.patterns.kary import KaryCode
from stage.patterns.phase import FULL_STEPS, PhaseCode
from stage.patterns.ramp import RampCode
from stage.stack.planes import Planes

HALVES = np.array([0.5, 0.5])
"""Weights of two frames in their mean."""
CLEAR_SIGMAS = 5.0
"""Difference of two sums, in its standard deviations, from which on it is none of noise."""
LEAST_PART, WAVE_PART = 0.04, 0.02
"""The same as a part of the largest difference of two readings of the pixel, for pairs and for waves: lamps flicker by less."""
CLEAR_BIT = 0.85
"""Least difference of a bit and its inverse, as a part of the largest of the pixel's bits, with which its sum is compared."""
BETWEEN, SEVERAL = (0.25, 0.75), 2
"""Levels between the darkest and the brightest bit of a pixel that no stripe has, and number of frames of a pixel that must have them, of
its coarse bits, white and black: at the edge of a stripe of a Gray code one bit is between the two, and no other."""
COARSE = 0.5
"""Part of the bits, the coarsest, that are looked at: blur and texture do not reach far into their stripes."""
ALIKE = 0.3
"""Scatter over the pixels of the change of a sum, as a part of it, up to which the light has changed: lamps that fade leave .1, light of
the room that comes on .2, and mixed patterns 1 and more."""
STEADY = "let the projector warm up, switch off its dynamic modes and the camera's automatic exposure, and keep other light out"
"""What to do about light that changes between frames."""
MOST_UNEVEN, STRIPES = 0.05, 20
"""Largest distance from a half, the way from black to white, of the mean of a bit without an inverse, and least number of stripes of the
next coarser bits that it is told of: right captures have 0.007 at most, sharp, blurred and unresolved ones; images that are encoded 0.03 to
0.17, and automatic exposure leaves 0.3."""
MOST_MIXED = 0.25
"""Share of these pixels with levels that no pattern has, from which on the frames are named: what moves has its edges alone."""
MOVED_SIGMAS, MOVED_PART = 6.0, 0.04
"""Least difference of a sum from its usual part of white, in deviations of noise and in white, from which on a surface has moved: lamps
flicker by less."""
MOST_MOVED, SAID = 0.2, 0.005
"""Parts of the compared pixels above which it is no motion of single things, and from which on it is said."""
UNKNOWN_RESPONSE = ("; if the projector is far from linear, measure it with relit calibrate response, for waves of three steps look so "
                    "too then")
"""What is said besides of waves of three steps where no response is declared."""


class EvenLevels(NamedTuple):
    """Sums of frames that are the same at a pixel, as weights [sums, frames]; None without two of a kind."""

    pairs: np.ndarray | None
    """Bits with their inverses."""
    waves: np.ndarray | None
    """Waves over their shifts."""
    bits: np.ndarray | None
    """Differences of the bits and their inverses."""
    bend: float = 0.0
    """Largest difference of the sums of waves of the declared response, as a part of white: three shifts do not even out its third
    harmonic."""

    @classmethod
    def of(cls, collected: Collected, frames: int, response: Sequence[float] | None) -> "EvenLevels":
        """Return the sums that a capture has; where no code has waves none, because stripes are read rightly from mixed frames."""
        light: np.ndarray = bent_wave(response)
        means: list[float] = []
        pairs: list[tuple[int, int]] = []
        waves: list[np.ndarray] = []
        phases = [code for code in collected.codes if isinstance(code, PhaseCode)]
        for code in collected.codes:
            if isinstance(code, BinaryCode) and code.inverses is not None and phases:
                pairs += zip(code.frames, code.inverses, strict=True)
        for phase in phases:
            waves += even_means(phase, frames)
            for wave in phase.waves if response is not None else ():
                if len(wave.frames) >= FULL_STEPS:
                    means.extend(fitted_curve(light, weights(np.array(wave.shifts), wave.period_px), np.array(wave.shifts))[1])
        several = len(pairs) > 1
        return cls(np.stack([row_of(frames, two, HALVES) for two in pairs]) if several else None,
                   np.stack(waves) if len(waves) > 1 else None,
                   np.stack([row_of(frames, two, np.array([0.5, -0.5])) for two in pairs]) if several else None,
                   float(np.ptp(means)) if means else 0.0)

    def mixed(self, grey: np.ndarray, noise: NoiseModel) -> np.ndarray:
        """Return where readings [frames, pixels] have levels that no pattern has, [pixels] bool.

        Of the bits that are equally clear, those that are lit in the pattern are compared with those that are lit in the inverse: a camera
        that is not linear bends their sums alike, and a frame that holds part of the next one bends them apart.
        """
        found = np.zeros(grey.shape[1], bool)
        whole = np.ptp(grey, axis=0)

        def clear(away: np.ndarray, rows: np.ndarray, level: np.ndarray, part: float) -> np.ndarray:
            variance = 2 * float((rows**2).sum(axis=1).max()) * noise.variance(level)
            return np.asarray(away > np.maximum(CLEAR_SIGMAS * np.sqrt(variance), part * whole))

        if self.waves is not None:
            sums = self.waves.astype(np.float32) @ grey
            found |= clear(np.ptp(sums, axis=0), self.waves, sums.mean(axis=0), WAVE_PART + self.bend)
        if self.pairs is not None and self.bits is not None:
            sums, bits = self.pairs.astype(np.float32) @ grey, self.bits.astype(np.float32) @ grey
            seen = np.abs(bits) >= CLEAR_BIT * np.abs(bits).max(axis=0)
            sides = [np.where(seen & lit, sums, 0).sum(axis=0) / np.maximum((seen & lit).sum(axis=0), 1) for lit in (bits > 0, bits < 0)]
            both = np.logical_and(*((seen & lit).any(axis=0) for lit in (bits > 0, bits < 0)))
            found |= both & clear(np.abs(sides[0] - sides[1]), self.pairs, sums.mean(axis=0), LEAST_PART)
        return found


def between(grey: np.ndarray, collected: Collected, noise: NoiseModel) -> np.ndarray:
    """Return where coarse bits of a Gray code without inverses, white and black lie between dark and bright stripes, [pixels] bool."""
    found = np.zeros(grey.shape[1], bool)
    for code in collected.codes:
        if isinstance(code, BinaryCode) and code.name == "gray" and code.inverses is None:
            bits = grey[list(code.frames)]
            dark, bright = bits.min(axis=0), bits.max(axis=0)
            lit = bright - dark > LIT_SIGMAS * np.sqrt(noise.variance(bright))
            even = [grey[number] for number in (collected.white, collected.black) if number is not None]
            parts = (np.stack([*bits[-ceil(COARSE * len(bits)):], *even]) - dark) / np.maximum(bright - dark, 1e-12)
            found |= lit & (((parts > BETWEEN[0]) & (parts < BETWEEN[1])).sum(axis=0) >= SEVERAL)
    return found


def contrasts(grey: np.ndarray, code: BinaryCode | KaryCode, collected: Collected) -> np.ndarray:
    """Return by how much each bit is brighter than its inverse or, twice, each bit or digit than the mean of white and black, [bits, …], of
    readings [frames, …] of a code that does not lack these frames."""
    frames = grey[list(code.frames)]
    if isinstance(code, BinaryCode) and code.inverses is not None:
        return np.asarray(frames - grey[list(code.inverses)])
    return np.asarray(2 * frames - grey[collected.white] - grey[collected.black])


def row_of(frames: int, places: Sequence[int], values: np.ndarray) -> np.ndarray:
    """Return [frames] weights that are 0 elsewhere."""
    row = np.zeros(frames)
    row[list(places)] = values
    return row


def even_means(code: Code, frames: int) -> list[np.ndarray]:
    """Return the weights [frames] of the frames in each mean of a code that is half the light of white and black: of bits and their
    inverses, of ramps both ways, and of waves over their shifts."""
    if isinstance(code, BinaryCode) and code.inverses is not None:
        return [row_of(frames, pair, HALVES) for pair in zip(code.frames, code.inverses, strict=True)]
    if isinstance(code, RampCode) and code.up is not None and code.down is not None:
        return [row_of(frames, (code.up, code.down), HALVES)]
    return [row_of(frames, wave.frames, weights(np.array(wave.shifts), wave.period_px)[:, 0])
            for wave in (code.waves if isinstance(code, PhaseCode) else ()) if len(wave.frames) >= FULL_STEPS]


def check_levels(sample: Sample, collected: Collected, projector: PatternProjector, noise: NoiseModel) -> str | None:
    """Return a sentence if much of a sample has levels that no pattern has."""
    grey = sample.grey
    lit = sample.lit(grey, noise)
    if lit.sum() < ENOUGH:
        return None
    levels = EvenLevels.of(collected, len(grey), projector.response)
    share = float((levels.mixed(grey[:, lit], noise) | between(grey[:, lit], collected, noise)).mean())
    if share < MOST_MIXED:
        return None
    unknown = projector.response is None and levels.waves is not None and ((levels.waves != 0).sum(axis=1) == FULL_STEPS).any()
    return (f"frames: {100 * share:.0f} % of the lit pixels have levels that no pattern has (stripes are neither dark nor bright, or bits "
            "and their inverses, or waves over their shifts, do not add up to the same light): the camera has recorded parts of two "
            "patterns, or what it sees has moved: wait longer for each pattern, or synchronise projector and camera"
            f"{UNKNOWN_RESPONSE if unknown else ''}")


def uneven_halves(sample: Sample, collected: Collected, noise: NoiseModel) -> str | None:
    """Return a sentence if the finest bits without inverses are not, in the mean, half-way between black and white, as linear images of one
    exposure are however sharp; None if they are."""
    grey = sample.grey
    lit = sample.lit(grey, noise)
    if collected.white is None or collected.black is None or lit.sum() < ENOUGH:
        return None
    black, span = grey[collected.black, lit], (grey[collected.white] - grey[collected.black])[lit]
    seen = span > LIT_SIGMAS * np.sqrt(noise.variance(grey[collected.white, lit]))
    for code in collected.codes:
        alone = all(other is code or other.axis != code.axis for other in collected.codes)  # else waves tell places in its stripes
        if not isinstance(code, BinaryCode) or code.inverses is not None or not alone or not seen.any():
            continue
        parts = (grey[list(code.frames)][:, lit] - black)[:, seen] / span[seen]
        coarser = np.unique(parts[1:] > 0.5, axis=1).shape[1]
        mean = float(parts[0].mean())
        if coarser >= STRIPES and abs(mean - 0.5) > MOST_UNEVEN:
            return (f"frames[]: the finest bit of the {code.axis} {code.name} code is, in the mean, {100 * mean:.0f} % of the way from "
                    "black to white, where linear images have 50 %: images are encoded (color_space), or white and black were exposed "
                    "otherwise than the bits; edges of stripes lie aside by it: give linear images of one exposure, or show inverses")
    return None


def light_sentence(sample: Sample, collected: Collected, projector: PatternProjector, noise: NoiseModel) -> str | None:
    """Return a sentence if waves over their shifts differ alike at nearly all pixels, as under light that has changed between them; None if
    they do not. Mixed patterns and motion differ to both sides."""
    grey = sample.grey
    lit = sample.lit(grey, noise)
    waves = EvenLevels.of(collected, len(grey), projector.response).waves
    if waves is None or lit.sum() < ENOUGH:
        return None
    sums = waves.astype(np.float32) @ grey[:, lit]
    part = sums / sums.mean(axis=0)
    usual = np.median(part, axis=1)
    change = float(np.ptp(usual))
    if change < LEAST_PART or np.median(np.abs(part - usual[:, None]), axis=1).max() > ALIKE * change:
        return None
    return (f"frames[]: waves over their shifts differ by {100 * change:.0f} % nearly everywhere alike: the lamp or the room's light has "
            f"changed between the frames: {STEADY}; of that the standard deviations hold what several periods disagree by")


class EvenSums(NamedTuple):
    """Sums of the frames that are even light."""

    rows: np.ndarray  # [sums, frames]
    usual: np.ndarray  # [sums] parts of white, less black
    white: int
    black: int
    full: float
    """Reading of a channel from which on it may be clipped, whatever the manifest says."""
    everywhere: bool = False
    """True if bits and their inverses differ at more pixels than what moves before a wall would make them."""

    @classmethod
    def of(cls, sample: Sample, collected: Collected, noise: NoiseModel) -> "EvenSums | None":
        """Return the sums of a capture that has bits with inverses, white and black, with waves or without; None of another, or if waves
        differ at more pixels than motion would make: those of a camera that is not linear do, and stripes of it do not."""
        if collected.white is None or collected.black is None:
            return None
        frames = len(sample.values)
        rows = [row for code in collected.codes if isinstance(code, BinaryCode) for row in even_means(code, frames)]
        bits = len(rows)
        rows += [row for code in collected.codes if isinstance(code, PhaseCode) for row in even_means(code, frames)]
        if not bits:
            return None
        found = cls(np.stack(rows), np.zeros(len(rows)), collected.white, collected.black,
                    FULL_PART * float(sample.values.max(initial=0.0)))
        lit = sample.whole & found.lit(sample.grey, noise)
        if lit.sum() < ENOUGH:
            return None
        part, _ = found.parts(sample.grey[:, lit], noise)
        found = found._replace(usual=np.median(part, axis=1))
        if found.moved(sample, noise)[lit].mean() <= MOST_MOVED:
            return found
        return found._replace(everywhere=True) if len(rows) == bits else None

    def lit(self, grey: np.ndarray, noise: NoiseModel) -> np.ndarray:
        """Return which pixels are compared, of readings [frames, pixels]."""
        spread = np.sqrt(noise.variance(grey[self.white]))
        return np.asarray(grey[self.white] - grey[self.black] > LIT_SIGMAS * spread)

    def parts(self, grey: np.ndarray, noise: NoiseModel) -> tuple[np.ndarray, np.ndarray]:
        """Return the sums less black as parts of white less black, [sums, pixels], and their deviations, [pixels]."""
        white = np.maximum(grey[self.white] - grey[self.black], 1e-9)
        sums = self.rows.astype(np.float32) @ grey
        deviation = np.sqrt(2 * noise.variance(grey[self.white])) / white
        return (sums - grey[self.black]) / white, deviation

    def moved(self, sample: Sample, noise: NoiseModel) -> np.ndarray:
        """Return where surfaces have moved, [pixels] bool; nowhere where a reading is or may be clipped, whose sums say nothing."""
        grey = sample.grey
        part, deviation = self.parts(grey, noise)
        away = np.abs(part - self.usual[:, None]).max(axis=0)
        found = np.asarray(self.lit(grey, noise) & (away > np.maximum(MOVED_SIGMAS * deviation, MOVED_PART)))
        found &= sample.values.max(axis=(0, 1)) < self.full
        return found if sample.saturated is None else found & ~sample.saturated.any(axis=0)


def moved_pixels(planes: Planes, mask: np.ndarray, sample: Sample, collected: Collected, noise: NoiseModel, *,
                 shifted: bool) -> tuple[np.ndarray, list[str]]:
    """Return where surfaces have moved between frames, [rows, cols] bool, and what is said of it; nowhere if it is too little to tell, or
    if it is everywhere, where most stripes are read rightly all the same. `shifted`: whether it is said already that images have."""
    sums = EvenSums.of(sample, collected, noise)
    moved = np.zeros(mask.shape, bool)
    if sums is None or not sums.moved(sample, noise).any():
        return moved, []
    for band in planes.bands(DECODE_BYTES_PER_PIXEL):
        saturated = None if planes.saturated is None else planes.saturated[:, band].reshape(len(planes.saturated), -1)
        part = sample._replace(values=planes.band(band), saturated=saturated)
        moved[band] = mask[band] & sums.moved(part, noise).reshape(-1, mask.shape[1])
    share = moved.sum() / mask.sum()
    if share <= SAID:
        return np.zeros_like(moved), []
    clipped = "" if planes.saturated is not None else ", or readings are clipped, which a declared saturation would tell"
    seen = f"frames[]: the even light of the frames differs at {100 * share:.2g} % of the pixels, as where "
    if sums.everywhere:
        return np.zeros_like(moved), [] if shifted else [
            f"{seen}the whole scene has moved during the sequence, or the camera has recorded parts of two patterns{clipped}: the "
            "standard deviations do not hold what that makes; keep it still, or wait longer for each pattern"]
    return moved, [f"{seen}something has moved during the sequence{clipped}: they are unsure"]
