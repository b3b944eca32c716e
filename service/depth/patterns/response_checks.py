"""Whether light is linear in the levels that a projector shows: the exponent γ of light = level^γ that waves show, and ramps.

Between black and white the mean of a wave is a half, unless it is bent, and has a second harmonic then, or the light has changed between
frames. Four frames or more tell that harmonic. To the fitted amplitude of three it adds in turn with three times the phase; the amplitude
over the mean does not depend on albedo, and under an unbent wave not on the phase. What else changes it, ambient light and blur, changes
slowly over the wave or not with it at all.

A rising ramp and the falling one are white and black together, at every place. Where the projector's response or the images bend light, the
sum is least right half way between the borders; where the light has changed, it is wrong there as at the borders.
"""

from collections.abc import Sequence

import numpy as np

from kernels.structured.pattern_frames import NoiseModel
from kernels.structured.phase import weights
from kernels.structured.response import bent_wave, light_of
from service.depth.patterns.decoders import PatternProjector
from service.depth.patterns.levels import STEADY
from service.depth.patterns.pattern_checks import ENOUGH, LEAST_SIGNAL, Sample
from stage.patterns.binary import BinaryCode
from stage.patterns.codes import Collected
from stage.patterns.phase import FULL_STEPS, PhaseCode, Wave
from stage.patterns.ramp import RampCode

MEAN_TOLERANCE = 0.04
"""Distance of the mean of a wave from half of white above which the projector is not linear; photographs have 0.01."""
EXPONENTS = 0.2, 5.0
"""Least and greatest exponent of light = level^γ that is found: a response of 2.2 that is declared inversely is off by 2.2²."""
IN_A_BIN = 30
"""Pixels that tell the sum of ramps in a part of the way between the borders."""
TURN_BINS, LEAST_TURN_BINS = 36, 24
"""Parts of a turn, and number of these that must be seen."""
CLEAR_SIGMAS = 20.0
"""Least amplitude of pixels that tell the modulation, in its standard deviations."""
RAMP_BINS, LEAST_RAMP_BINS = 20, 8
"""Parts of the way between the borders, and number of these that must be seen."""
MOST_BENT, MOST_CHANGED = 0.08, 0.12
"""Largest part of white minus black by which bent light makes the sum wrong half way, and changed light anywhere: lamps flicker by less,
and images that were sharpened have 0.05."""
BENT, LEAST_HARMONIC, BENT_PART = 0.05, 0.03, 0.25
"""Second harmonic, over the first, from which on waves are bent (right ones have .034 at most), the one that their mean must lead to expect
for its absence to tell, and the part of it from which on they are bent then: bent waves have .45 to 1.5 of it, less where blur hides it,
and those under light that has changed .03 at most."""
STEPS = 1024
"""Number of places at which a declared response is looked up."""


def find_exponent(sample: Sample, collected: Collected, projector: PatternProjector, noise: NoiseModel, *,
                  steady: bool) -> PatternProjector:
    """Return the projector with the exponent γ of light = level^γ that the waves of a capture show, and with the light that changed; itself
    where they are as they should be. `steady`: False where the light is known to have changed: a declared response is not doubted then."""
    for code in collected.codes:
        if isinstance(code, PhaseCode):
            found = _exponent_of_mean(sample, code, collected, projector, noise, steady or projector.response is None)
            if found is None and projector.response is None:  # blur makes a second harmonic smaller, and none of what is none
                found = projector._replace(exponent=_exponent_of_harmonic(sample, code, noise))
            if found not in (None, projector):
                return found
    return projector


def _exponent_of_mean(sample: Sample, code: PhaseCode, collected: Collected, projector: PatternProjector, noise: NoiseModel,
                      bent: bool) -> PatternProjector | None:
    """Return the projector with the exponent from the mean of the waves between black and white, or with the light that changed where they
    are not bent so; None without frames that tell them. `bent`: whether it may be bent."""
    grey = sample.grey
    if collected.white is not None and collected.black is not None:
        dark, span = grey[collected.black], grey[collected.white] - grey[collected.black]
    else:
        pair = next((other for other in collected.codes if isinstance(other, BinaryCode) and other.inverses is not None), None)
        if pair is None or pair.inverses is None:
            return None
        span = np.max([np.abs(grey[a] - grey[b]) for a, b in zip(pair.frames, pair.inverses, strict=True)], axis=0)
        dark = 0.5 * (grey[pair.frames[-1]] + grey[pair.inverses[-1]] - span)
    good = sample.whole & (span > LEAST_SIGNAL * np.sqrt(2 * noise.read**2 + noise.gain * np.maximum(2 * dark + span, 0)))
    if good.sum() < ENOUGH:
        return None
    even = [wave for wave in code.waves
            if len(wave.frames) >= FULL_STEPS and abs(np.exp(2j * np.pi * np.array(wave.shifts)).sum()) < 1e-6]
    if not even:
        return None
    grey, dark, span = grey[:, good], dark[good], span[good]
    mean = float(np.median([np.median((np.mean(grey[list(wave.frames)], axis=0) - dark) / span) for wave in even]))
    off = abs(mean - float(bent_wave(projector.response).mean()))
    if off <= MEAN_TOLERANCE:
        return projector
    fine = np.linspace(*EXPONENTS, 481)
    table = [float(bent_wave(projector.shown_light(g)).mean()) for g in fine]
    exponent = float(np.interp(-mean, -np.array(table), fine))
    declared, found = (np.fft.rfft(bent_wave(projector.shown_light(g)), norm="forward").real[:3] for g in (1.0, exponent))
    seen, swing = np.median([_second_harmonic(wave, grey, span) for wave in even], axis=0)
    sharp = min(swing / (2 * found[1]), 1.0) ** 3  # blur dims the second harmonic as the fourth power of the first
    own = declared[2] / declared[1] * sharp
    expected = found[2] / found[1] * sharp - own
    if not bent or (abs(expected) > LEAST_HARMONIC and (seen - own) / expected < BENT_PART):
        return projector._replace(changed=off)
    return projector._replace(exponent=exponent)


def _exponent_of_harmonic(sample: Sample, code: PhaseCode, noise: NoiseModel) -> float:
    """Return the exponent whose waves have the second harmonic that is seen, (γ - 1)/(γ + 2) of the first; 1.0 where none is."""
    found = []
    for wave in (wave for wave in code.waves if len(wave.frames) >= FULL_STEPS):
        table = weights(np.array(wave.shifts), wave.period_px)
        mean, along, across = table.T @ sample.grey[list(wave.frames)]
        deviation = np.sqrt(noise.variance(mean) * (table[:, 1:]**2).sum(axis=0).max())
        good = sample.whole & (np.hypot(along, across) > CLEAR_SIGMAS * deviation) & (mean > 0)
        place = np.floor(np.arctan2(across, along)[good] / (2 * np.pi) * TURN_BINS)
        if good.sum() >= ENOUGH and len(np.unique(place)) >= LEAST_TURN_BINS:
            found.append(_second_harmonic(wave, sample.grey[:, good], mean[good])[0])
    part = float(np.median(found)) if found else 0.0
    return float(np.clip((1 + 2 * part) / (1 - part), *EXPONENTS)) if abs(part) > BENT else 1.0


def _second_harmonic(wave: Wave, grey: np.ndarray, light: np.ndarray) -> tuple[float, float]:
    """Return the second harmonic of a wave over the first, and the first over the light of the pixels.
    `grey`: [frames, pixels]. `light`: [pixels], white less black, or the mean of the wave: what is in proportion to the albedo."""
    readings, shifts = grey[list(wave.frames)], np.array(wave.shifts)
    _, along, across = weights(shifts, wave.period_px).T @ readings
    swing = np.hypot(along, across)
    seen = (swing > 0) & (light > 0)
    if not seen.any():
        return 0.0, 0.0
    readings, phasor, swing, light = readings[:, seen], (along + 1j * across)[seen], swing[seen], light[seen]
    whole = float(np.median(swing / light))
    three = len(shifts) == FULL_STEPS  # the second harmonic changes the swing then, in turn with three times the phase
    part = swing / light / whole if three else 2 / len(shifts) * (np.exp(4j * np.pi * shifts) @ readings) / swing
    terms = np.stack([(phasor / swing) ** power for power in range(-3, 4)], axis=1)
    fitted = np.linalg.lstsq(terms, part.astype(complex), rcond=None)[0]
    return 2 * fitted[6].real if three else fitted[5].real, whole


def response_sentence(found: PatternProjector, codes: Sequence[str]) -> str:
    """Return what is said of waves that a projector bends, or whose light has changed."""
    if found.changed:
        return (f"frames[]: waves lie {100 * found.changed:.0f} % of white off the middle between black and white and are not bent: the "
                f"lamp or the room's light has changed between the frames: {STEADY}; the standard deviations of {' and '.join(codes)} "
                "hold it")
    done = ("the error that this makes is" if found.left_rad is None else
            f"they were bent back by it, and the {found.left_rad:.2g} rad that this leaves are")
    like = (f"is not given, but the projected waves look like light = level^{found.exponent:.2g}, not linear" if found.response is None else
            f"the projected waves look like its light to the power of {found.exponent:.2g}, as where it is another, images are not in "
            "color_space, or blur straightens waves")
    return (f"projector.response: {like}: {done} in the standard deviation of {' and '.join(codes)}; measure the response with relit "
            "calibrate response")


def check_ramps(sample: Sample, collected: Collected, projector: PatternProjector, noise: NoiseModel) -> str | None:
    """Return a sentence if two ramps are not white and black together. `noise`: that of the frames, as measured: pixels that are chosen by
    less are those whose white is too bright by chance."""
    if collected.white is None or collected.black is None:
        return None
    grey = sample.grey
    black = grey[collected.black]
    whole = grey[collected.white] - black
    variance = noise.variance(grey[collected.white])
    lit = sample.whole & (whole > LEAST_SIGNAL * np.sqrt(2 * variance))
    for code in collected.codes:
        if not isinstance(code, RampCode) or code.up is None or code.down is None or lit.sum() < ENOUGH:
            continue
        up, down = ((grey[number] - black)[lit] / whole[lit] for number in (code.up, code.down))
        light = light_of(projector.response, np.linspace(0, 1, STEPS))
        together = light + light[::-1]
        ratio = up / np.maximum(up + down, 1e-6)
        over = up + down - np.interp(ratio, light / together, together)
        place = np.clip(ratio * RAMP_BINS, 0, RAMP_BINS - 1).astype(int)
        seen = np.flatnonzero(np.bincount(place, minlength=RAMP_BINS) >= IN_A_BIN)
        if len(seen) < LEAST_RAMP_BINS:
            continue
        middle = (seen + 0.5) / RAMP_BINS
        terms = np.stack([np.ones(len(seen)), middle - 0.5, 4 * middle * (1 - middle)], axis=1)
        fitted = np.linalg.lstsq(terms, np.array([np.median(over[place == part]) for part in seen]), rcond=None)[0]
        changed = float(np.abs(terms[:, :2] @ fitted[:2]).max())
        if abs(fitted[2]) > max(MOST_BENT, changed):
            half_way = max(1 + fitted[0] + fitted[2], 0.1)
            exponent = 1 - np.log2(half_way)
            return (f"frames: half way between the borders the two {code.axis} ramps are {100 * half_way:.0f} % of white and black "
                    f"together, as where light = level^{exponent:.2g}: a ramp is only as right as its light is linear; measure "
                    "projector.response (relit calibrate response), or check color_space, if the images are what is not linear")
        if changed > MOST_CHANGED:
            return (f"frames: the two {code.axis} ramps differ from white and black together by up to {100 * changed:.0f} % of white: the "
                    "light has changed between the frames, dark readings were cut off, or frames do not show what is declared")
    return None
