"""Frames that do not show their pattern: dark or even where stripes are declared, once more the picture before, or copies of another.

A projector that misses a picture, or a camera that is triggered too late, leaves them. One bit is then the same everywhere, or that of
another frame, and stripes far from each other are taken for one.
"""

from collections.abc import Sequence

import numpy as np

from kernels.structured.pattern_frames import NoiseModel
from service.depth.patterns.pattern_checks import ENOUGH, Sample
from stage.capture.manifest import Frame
from stage.patterns.binary import BinaryCode
from stage.patterns.codes import Code, Collected
from stage.patterns.kary import KaryCode
from stage.patterns.phase import FULL_STEPS, PhaseCode

DARK, BRIGHT, OTHERS = 0.25, 0.75, 0.05
"""Parts of the difference of a pixel's brightest and darkest reading below and above which a stripe is dark and bright, and the least share
of both where a frame shows stripes."""
EVEN = 0.98
"""Share of the pixels that are dark, or bright, in a frame without stripes; and of those that are the same in two frames of one picture."""
COARSER = 2
"""Coarser bits or digits with stripes, between whose edges there are some of the finer one."""
ALIKE, OTHER_WAVES = 1.5, 2
"""Largest ratio of the periods of waves that are alike, and the least number of such frames that show stripes: where a scene is so narrow
that a wave may be dark all over it, its opposite is bright all over it. Three steps have no opposite, and are judged beside other waves, or
under stripes that number them: a third of a turn is dark in one and has stripes in both others."""
OPPOSITE = 0.9
"""Least share of the pixels that are dark in a frame and bright in its inverse, or the reverse, where both show their patterns."""
SAME_PART, SAME_SIGMAS = 0.1, 5.0
"""Largest difference of two readings of one picture, as a part of that difference, and in deviations of a reading."""


def check_frames(sample: Sample, collected: Collected, frames: Sequence[Frame], noise: NoiseModel) -> str | None:
    """Return a sentence about the frames of a sample that do not show their pattern; None if all seem to."""
    grey = sample.grey
    lit = sample.lit(grey, noise)
    if lit.sum() < ENOUGH:
        return None
    grey = grey[:, lit]
    whole = np.ptp(grey, axis=0)
    level = (grey - grey.min(axis=0)) / whole
    dark, bright = (level < DARK).mean(axis=1), (level > BRIGHT).mean(axis=1)
    stripes, even = np.minimum(dark, bright) >= OTHERS, np.maximum(dark, bright) >= EVEN
    alone = [code for code in collected.codes if isinstance(code, PhaseCode) and len(code.frames) == FULL_STEPS
             and all(other is code or other.axis != code.axis for other in collected.codes)]
    missed = sorted(row for code in collected.codes if code not in alone for row in _without_stripes(code, stripes, even))
    if missed:
        names, shows = ", ".join(frames[row].image for row in missed), "shows" if len(missed) == 1 else "show"
        return f"frames: {names} {shows} no stripes, and others do: the projector has missed the pattern; take the sequence again"
    near = np.maximum(SAME_PART * whole, SAME_SIGMAS * np.sqrt(noise.variance(grey.max(axis=0))))
    judged = _judged(collected, level)
    for row in range(1, len(grey)):
        if (judged[row] and stripes[row] and stripes[row - 1] and frames[row].pattern != frames[row - 1].pattern
                and (np.abs(grey[row] - grey[row - 1]) < near).mean() >= EVEN):
            return (f"frames: {frames[row].image} and {frames[row - 1].image} show the same, and other patterns are declared: the "
                    "projector has missed one, or the camera was too early or late; take the sequence again")
    apart = {row for code in collected.codes if isinstance(code, BinaryCode) and code.name != "gray"  # in pictures without noise
             for row in (*code.frames, *(code.inverses or ()))}
    earlier: dict[bytes, int] = {}
    for row in (int(row) for row in np.flatnonzero(stripes) if row not in apart):
        same = earlier.setdefault(sample.values[row][:, lit].tobytes(), row)
        if frames[row].pattern != frames[same].pattern:
            return (f"frames: {frames[row].image} and {frames[same].image} are the same to the last bit, and other patterns are declared: "
                    "one is a copy of the other; import the images again, or take the sequence again")
    return None


def _judged(collected: Collected, level: np.ndarray) -> np.ndarray:
    """Return the frames, [frames] bool, that may not be alike the frame before; `level`: [frames, pixels] of each pixel's range.

    Two bits of a binary or XOR code, and a bit and the inverse of another, are alike over half of the projector or a quarter. A bit that is
    opposite to its own inverse shows its pattern.
    """
    judged = np.ones(len(level), bool)
    for code in collected.codes:
        if isinstance(code, BinaryCode) and code.inverses is not None:
            frames, inverses = list(code.frames), list(code.inverses)
            opposite = ((level[frames] < 0.5) != (level[inverses] < 0.5)).mean(axis=1) >= OPPOSITE
            judged[frames] = judged[inverses] = ~opposite
        elif isinstance(code, BinaryCode) and code.name != "gray":
            judged[list(code.frames)] = False
    return judged


def _without_stripes(code: Code, stripes: np.ndarray, even: np.ndarray) -> list[int]:
    """Return the frames of a code that are even where the scene is wide enough to show stripes; `stripes`, `even`: [frames] bool."""
    if isinstance(code, PhaseCode):
        periods, rows = np.array(code.periods_px), np.array(code.frames)
        alike = np.maximum(periods[:, None], periods) <= ALIKE * np.minimum(periods[:, None], periods)
        return [int(rows[place]) for place in np.flatnonzero(even[rows])
                if (others := alike[place] & ~even[rows]).sum() >= OTHER_WAVES and stripes[rows[others]].all()]
    if not isinstance(code, BinaryCode | KaryCode) or (isinstance(code, KaryCode) and code.colors is not None):
        return []
    missed = [row for digit, row in enumerate(code.frames) if even[row] and stripes[list(code.frames[digit + 1 :])].sum() >= COARSER]
    inverses = code.inverses if isinstance(code, BinaryCode) else None
    for row, inverse in zip(code.frames, inverses, strict=True) if inverses is not None else ():
        missed += [one for one, other in ((row, inverse), (inverse, row)) if even[one] and stripes[other] and one not in missed]
    return missed
