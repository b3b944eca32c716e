"""Checks of what the digits of a k-ary code are declared to be: their levels, their order, and that of their colours."""

from itertools import combinations

import numpy as np

from kernels.structured.pattern_frames import NoiseModel
from service.depth.patterns.decoders import PatternProjector
from service.depth.patterns.pattern_checks import ENOUGH, Sample
from service.depth.patterns.stripe_steps import CLEAR_BIT, CLEAR_SIGMAS, JUMP, READ_SHARE, Pairs, mends
from stage.patterns.codes import Collected
from stage.patterns.kary import KaryCode, number_of

LEFT_JUMPS = 0.1
"""Jumps, as a part of all steps, below which stripes of k-ary digits follow each other."""
EXPONENTS = (0.45, 0.6, 0.8, 1.0, 1.25, 1.5, 1.8, 2.2, 2.6, 3.6, 4.84)
"""Exponents of light = level^γ that are compared; 2.2² where the response of 2.2 is declared inversely."""
BENT_LEFT, LEAST_BENT = 0.65, 0.02
"""Part of the mean distance of readings from the levels of digits, of white, that levels of another exponent leave, and least distance,
from which on that exponent is named: noise, blur and bounced light leave more with any other."""


def check_digits(sample: Sample, code: KaryCode, collected: Collected, projector: PatternProjector, noise: NoiseModel) -> str | None:
    """Return how digits are declared wrongly; None if stripes follow each other as declared, or few pixels read the coarser digits."""
    if code.lacks(collected.white, collected.black) is not None:
        return None
    light, levels = sample.digit_light(code), projector.levels_of(code)
    white, black = light[collected.white], light[collected.black]
    contrast = np.maximum(white - black, 1e-9)
    part = (light[list(code.frames)] - black) / contrast
    deviation = (np.sqrt(2 * noise.variance(white)) / contrast).max(axis=0)
    gap = min(float(np.abs(one - other).max()) for one, other in combinations(levels, 2))

    def read(levels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the nearest digits [digits, pixels], and whether they are near."""
        away = np.abs(part - levels[:, None, :, None]).max(axis=2)
        return away.argmin(axis=0), away.min(axis=0) < CLEAR_BIT / 2 * gap

    digits, clear = read(levels)
    others = []
    if code.colors is not None:
        turned, also = read(levels[:, ::-1])
        clear = clear | also
        others.append(("red and blue are exchanged: check the order of the channels in the images", turned, code.reflected))
    lit = sample.lit(sample.grey, noise) & (deviation * CLEAR_SIGMAS < gap / 2)
    if code.colors is None and lit.sum() >= ENOUGH:
        bent = _exponent_of(part[len(part) // 2 :, 0, lit], levels[:, 0])
        if bent is not None:
            like = "light = level" if projector.response is None else "the light of projector.response"
            return (f"the digits of the {code.axis} kary code look like {like}^{bent:g}: give the light that is shown as levels, or "
                    "measure projector.response with relit calibrate response; check color_space of the images too")
    read_well = np.flatnonzero(clear[: 1 + len(digits) // 2, lit].sum(axis=1) >= READ_SHARE * max(int(lit.sum()), 1))
    if not len(read_well):
        return None
    finest = int(read_well[0])
    pairs = Pairs.of((lit & clear[finest:].all(axis=0)).reshape(sample.mask.shape))
    steps = pairs.steps(number_of(digits[finest:], code.base, reflected=code.reflected))
    if len(steps) < ENOUGH or not steps.any():
        return None
    jumps = steps > JUMP * max(float(np.median(steps[steps > 0])), 1.0)
    count = projector.extent(code.axis) / code.without(finest).stripe_px
    others.append((f"reflected is {str(not code.reflected).lower()} in the frames' patterns: check it", digits, not code.reflected))
    for first, second in combinations(range(finest, len(digits)), 2):
        order = np.arange(len(digits))
        order[[first, second]] = second, first
        others.append((f"the digits {first} and {second} are exchanged: check digit in the frames' patterns", digits[order],
                       code.reflected))
    mended = []
    for words, shown, reflected in others:
        numbers = number_of(shown[finest:], code.base, reflected=reflected)
        better, after = mends(numbers, pairs, steps, jumps, count, outside=False), pairs.steps(numbers)
        after = after[after > 0]
        if better is not None and (after > JUMP * np.median(after)).mean() < LEFT_JUMPS:  # more where the camera moves between frames
            mended.append((better, words))
    if not mended:
        return None
    return f"the {code.axis} stripes of the kary code do not follow each other as declared; they do if {min(mended)[1]}"


def _exponent_of(part: np.ndarray, levels: np.ndarray) -> float | None:
    """Return the exponent of light = level^γ under which readings of digits, parts of white [digits, pixels], lie far nearer to levels
    [levels] than as declared; None if they lie near these."""
    away = {exponent: float(np.abs(part[..., None] - levels**exponent).min(axis=-1).mean()) for exponent in EXPONENTS}
    bent = min(away, key=lambda exponent: away[exponent])
    return bent if away[bent] < BENT_LEFT * away[1.0] and away[1.0] > LEAST_BENT else None
