"""What the camera does not see of stripes: edges that pass between two pixels, and digits and bits that are finer than its pixels or blur.

Pixels of a camera see about as much of a surface as they are apart, and an edge changes the light of one of them at least. Images that are
rendered or shrunk without a filter show points of the surface: an edge lies anywhere between two of them.

The mean of all levels of a k-ary code is a level itself or lies near one: a blurred digit is read as the middle one and sure of it. Of
stripes that are seen about two of k have the darkest and the brightest level, or all have a colour whose channels are dark or bright.
"""

import numpy as np

from kernels.structured.edges import EDGE_ERROR, WHOLE, edge_error_of
from kernels.structured.pattern_frames import NoiseModel
from service.depth.patterns.code_checks import read_stripes
from service.depth.patterns.decoders import PatternProjector
from service.depth.patterns.pattern_checks import LIT_SIGMAS, Sample
from service.depth.patterns.readings import line_readings
from stage.patterns.base import Axis
from stage.patterns.binary import BinaryCode
from stage.patterns.codes import Collected
from stage.patterns.kary import KaryCode
from stage.stack.planes import Planes

PAIRS = 32
"""Number of pairs of neighbouring image rows whose edges are looked at, evenly spread."""
SEEN_PART, OF_A_STEP = {1: 0.25, 3: 0.02}, {1: 0.25, 3: 0.4}
"""By the number of channels, the least part of the pixels with outer levels, over that of the stripes with them, of a digit that is seen,
and the distance from these levels within which they have it, as a part of that to the next level. Colours are told by all channels
together: half of the pixels may see two stripes."""
FEW_EDGES = 16
"""Number of edges that count as seen by pixels as wide as they are apart, so that few edges tell nothing."""


def measured_edge_error(planes: Planes, mask: np.ndarray, collected: Collected, noise: NoiseModel) -> float:
    """Return the RMS error in camera pixels of an edge of a Gray code with inverses that is found by linear interpolation."""
    codes = [code for code in collected.codes if isinstance(code, BinaryCode) and code.name == "gray" and code.inverses is not None]
    if not codes:
        return EDGE_ERROR
    seen, whole = FEW_EDGES, FEW_EDGES * (1 - WHOLE)
    grey, inside = _pairs_of_rows(planes, mask)
    for code in codes:
        assert code.inverses is not None
        bits, inverses = grey[list(code.frames)], grey[list(code.inverses)]
        apart, clearest = bits - inverses, np.abs(bits - inverses).max(axis=0)
        deviation = np.sqrt(2 * noise.read**2 + noise.gain * np.maximum(bits + inverses, 0).max(axis=0))
        known = inside & (clearest > LIT_SIGMAS * deviation)
        for side, other in ((np.s_[..., :-1], np.s_[..., 1:]), (np.s_[..., ::2, :], np.s_[..., 1::2, :])):  # along rows, and across pairs
            changes = (apart[side] > 0) != (apart[other] > 0)
            edge = (changes.sum(axis=0) == 1) & known[side] & known[other]
            full = np.abs(apart) >= WHOLE * clearest
            seen += int(edge.sum())
            whole += int((changes & full[side] & full[other]).any(axis=0)[edge].sum())
    return edge_error_of(whole / seen)


def unseen_digits(sample: Sample, collected: Collected, projector: PatternProjector,
                  noise: NoiseModel) -> tuple[tuple[str, Axis, int], ...]:
    """Return the codes of k-ary digits and plain bits, their axes, and how many of the finest digits the camera does not resolve."""
    found: list[tuple[str, Axis, int]] = []
    for code in collected.codes:
        if isinstance(code, BinaryCode) and code.name == "binary":
            stripes = read_stripes(sample, code, collected, noise)
            count = 0 if stripes is None else max(stripes.finest - 1, 0)  # the last is wrong by a stripe at most, within five deviations
            found.append((code.name, code.axis, count))
        if not isinstance(code, KaryCode) or collected.white is None or collected.black is None:
            continue
        count = 0
        levels, light = projector.levels_of(code), sample.digit_light(code)
        own = np.array(code.colors) if code.colors is not None else levels
        outer = np.flatnonzero(((own == own.min(axis=0)) | (own == own.max(axis=0))).all(axis=1))
        white, black = light[collected.white], light[collected.black]
        lit = sample.whole & (white - black > LIT_SIGMAS * np.sqrt(noise.variance(white))).all(axis=0)
        apart = np.abs(levels[:, None] - levels).max(axis=2)
        reach = OF_A_STEP[light.shape[1]] * np.where(np.eye(code.base, dtype=bool), np.inf, apart).min(axis=1)
        for number in code.frames[:-1] if lit.any() and len(outer) else ():
            part = np.clip(((light[number] - black) / np.maximum(white - black, 1e-9))[:, lit].T, levels.min(axis=0), levels.max(axis=0))
            seen = np.any([np.abs(part - levels[level]).max(axis=1) < reach[level] for level in outer], axis=0)
            if seen.mean() > SEEN_PART[light.shape[1]] * len(outer) / code.base:
                break
            count += 1
        found.append((code.name, code.axis, count))
    return tuple(found)


def unseen_sentences(codes: Collected, projector: PatternProjector) -> list[str]:
    """Return what is said of digits and bits that the camera does not resolve, of the codes that are left without them."""
    said = []
    for code in codes.codes:
        if isinstance(code, BinaryCode | KaryCode) and (number := projector.unseen(code)):
            what = "bit" if isinstance(code, BinaryCode) else "digit"
            said.append(f"frames[].pattern: the camera does not resolve the finest {f'{number} {what}s' if number > 1 else what} of the "
                        f"{code.axis} {code.name} code: {'they are' if number > 1 else 'it is'} left out, and stripes are "
                        f"{code.stripe_px:g} px wide; focus projector and camera, or project wider stripes")
    return said


def _pairs_of_rows(planes: Planes, mask: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the readings [frames, 2 pairs, cols] of pairs of neighbouring rows, and which pixels count."""
    first = np.unique(np.linspace(0, len(mask) - 1, PAIRS + 2).astype(int)[1:-1] // 2 * 2)
    first = first[first + 1 < len(mask)]
    rows = np.stack([first, first + 1], axis=1).ravel()
    grey, clipped = line_readings(planes, rows, 1)
    return grey, mask[rows] if clipped is None else mask[rows] & ~clipped
