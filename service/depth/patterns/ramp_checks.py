"""Ramps that do not add up to white and black: a projector or images that are not linear, and light that changes between frames.

A rising ramp and the falling one are white and black together, at every place. Where the projector's response or the images bend light, the
sum is least right half way between the borders; where the light has changed, it is wrong there as at the borders.
"""

import numpy as np

from kernels.structured.pattern_frames import NoiseModel
from kernels.structured.response import light_of
from service.depth.patterns.decoders import PatternProjector
from service.depth.patterns.pattern_checks import ENOUGH, LEAST_SIGNAL, Sample
from stage.patterns.codes import Collected
from stage.patterns.ramp import RampCode

BINS, IN_A_BIN, LEAST_BINS = 20, 30, 8
"""Parts of the way between the borders, pixels that tell the sum in one of them, and number of these that must be seen."""
MOST_BENT, MOST_CHANGED = 0.08, 0.12
"""Largest part of white minus black by which bent light makes the sum wrong half way, and changed light anywhere: lamps flicker by less,
and images that were sharpened have 0.05."""
STEPS = 1024
"""Number of places at which a declared response is looked up."""


def check_ramps(sample: Sample, collected: Collected, projector: PatternProjector, noise: NoiseModel) -> str | None:
    """Return a sentence if two ramps are not white and black together. `noise`: that of the frames, as measured: pixels that are chosen by
    less are those whose white is too bright by chance."""
    if collected.white is None or collected.black is None:
        return None
    grey = sample.grey
    black = grey[collected.black]
    whole = grey[collected.white] - black
    variance = noise.read**2 + noise.gain * np.maximum(grey[collected.white], 0)
    lit = sample.whole & (whole > LEAST_SIGNAL * np.sqrt(2 * variance))
    for code in collected.codes:
        if not isinstance(code, RampCode) or code.up is None or code.down is None or lit.sum() < ENOUGH:
            continue
        up, down = ((grey[number] - black)[lit] / whole[lit] for number in (code.up, code.down))
        light = light_of(projector.response, np.linspace(0, 1, STEPS))
        together = light + light[::-1]
        ratio = up / np.maximum(up + down, 1e-6)
        over = up + down - np.interp(ratio, light / together, together)
        place = np.clip(ratio * BINS, 0, BINS - 1).astype(int)
        seen = np.flatnonzero(np.bincount(place, minlength=BINS) >= IN_A_BIN)
        if len(seen) < LEAST_BINS:
            continue
        middle = (seen + 0.5) / BINS
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
