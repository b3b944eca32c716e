"""Checks of what codes are declared to be, by the redundancy that they have: stripes follow each other, lie on the projector, and waves run
with the stripes that number them. No calibration is needed, and scenes with edges, shadows and noise have the same redundancy.
"""

from collections.abc import Sequence
from itertools import combinations
from typing import NamedTuple

import numpy as np
from scipy.ndimage import uniform_filter1d

from kernels.structured.pattern_frames import NoiseModel
from kernels.structured.phase import weights
from service.depth.patterns.decoders import PatternProjector
from service.depth.patterns.digit_checks import check_digits
from service.depth.patterns.levels import contrasts
from service.depth.patterns.pattern_checks import ENOUGH, Sample
from service.depth.patterns.stripe_steps import AT_A_PLACE, BEYOND_SHARE, CLEAR_BIT, CLEAR_SIGMAS, JUMP, READ_SHARE, Pairs, mends
from stage.patterns.binary import BinaryCode
from stage.patterns.codes import Collected
from stage.patterns.kary import KaryCode
from stage.patterns.phase import FULL_STEPS, PhaseCode

DENSE = 0.8
"""Part of the neighbours with other bits that differ in one alone, from which on they lie in stripes side by side: stripes three apart may
differ in one bit too."""
CONTRADICTED, FOLLOWED = 0.25, 0.4
"""Part of the neighbours that differ in one bit of a Gray code alone whose stripes follow each other: below the first for a bit, the order
of bits is wrong, and above the second for every bit, it is right. In scenes full of edges it is 0.73 at least for the right order."""
INVERTED = 0.7
"""The same part where dark and bright are exchanged, from which on all bits are inverted: exchanged bits and orders reach less."""
LEAST_ROWS = 5
"""Number of image rows in which a bit must change at such neighbours to be judged."""
LEAST_PERIODS = 4
"""Number of periods that must be seen for a wave to be compared: over fewer, uneven light makes other periods fit as well."""
CLEAR_WAVE = 0.4
"""Least length of the mean of a wave's phasors over its stripes: 0.64 where stripes are half a period wide, and 1 where they are narrow."""
SOME = 3000
"""Number of pixels whose phasors are compared."""
BESIDE_STRIPE, IN_STRIPES, OUT_OF_STRIPES = 0.05, 0.98, 0.85
"""Part of a period by which waves, each of two stripes and more, may tell a place beside the stripe of their pixel; the part of the pixels
of which they do not, from which on they run with the stripes, and below which they do not. It was more than .98 in 18 right captures and
60 of stairs along the stripes, of which 4 and 14 were told another period, because an image row crosses their stripes in few places; waves
that have nothing to do with the stripes are within by .6."""
AS_DECLARED, OFFSET = (0.9, 0.7), (0.12, 0.2)
"""Length of the mean at the declared period over the largest at any, below which another period is named, and periods by which a wave is
offset, from which on it is doubted: with stripes up to half a period, and with wider ones, which tell less. A wave that runs backwards is
an offset where the stripes are half a period wide and lie along the image rows, and right ones look backwards, by .9, where they lie about
so."""


class Stripes(NamedTuple):
    """The bits of one code, in Gray code, that a sample of the pixels reads."""

    bits: np.ndarray  # [bits, rows, cols] bool, the finest that is read first
    known: np.ndarray  # [rows, cols] bool: all of them are read
    finest: int
    """Number of finer bits that are left out."""


def check_codes(sample: Sample, collected: Collected, projector: PatternProjector, noise: NoiseModel) -> str | None:
    """Return a sentence if the stripes or the waves of a sample contradict what they are declared to be; None if they do not."""
    for code in collected.codes:
        if isinstance(code, BinaryCode):
            extent = projector.extent(code.axis)
            stripes = read_stripes(sample, code, collected, noise)
            if stripes is not None:
                found = _check_order(stripes, code, extent) or _check_waves(sample, stripes, code, collected, noise)
                if found is not None:
                    return f"frames: {found}"
        elif isinstance(code, KaryCode):
            found = check_digits(sample, code, collected, projector, noise)
            if found is not None:
                return f"frames: {found}"
    return None


def check_inverted(sample: Sample, collected: Collected, noise: NoiseModel) -> str | None:
    """Return a sentence if the stripes of a Gray or XOR code follow each other only if dark and bright are exchanged in all of its bits.
    A plain binary code is mirrored by that, which the geometry alone tells."""
    for code in collected.codes:
        if not isinstance(code, BinaryCode) or code.name == "binary":
            continue
        stripes = read_stripes(sample, code, collected, noise)
        edges = None if stripes is None else Edges.of(stripes.bits, Pairs.of(stripes.known))
        if stripes is None or edges is None or edges.following() >= CONTRADICTED:
            continue
        inverted = edges.ends.copy()
        inverted[:None if code.name == "gray" else code.base_bit + 1 - stripes.finest - edges.finest] ^= True  # the base turns coarser bits
        if edges.following(inverted) >= INVERTED:
            words = ("patterns and inverses are exchanged: check inverse in the frames' patterns" if code.inverses is not None else
                     f"dark and bright are exchanged in all bits of the {code.name} code: give the images of the patterns, not of their "
                     "inverses, or invert these images")
            return f"frames: neighbouring {code.axis} stripes follow each other only if {words}"
    return None


def read_stripes(sample: Sample, code: BinaryCode, collected: Collected, noise: NoiseModel) -> Stripes | None:
    """Return the bits of a code; None without the frames that tell them, or if too few pixels read them."""
    if code.lacks(collected.white, collected.black) is not None:
        return None
    grey = sample.grey
    contrast = contrasts(grey, code, collected)
    both = 2 * grey[list(code.frames)] - contrast  # light of a bit and its inverse
    largest = np.abs(contrast).max(axis=0)
    deviation = np.sqrt(2 * noise.read**2 + noise.gain * np.maximum(both, 0))
    lit = sample.mask.ravel() & (largest > CLEAR_SIGMAS / CLEAR_BIT * deviation.max(axis=0))
    if sample.saturated is not None:
        lit &= ~sample.saturated.any(axis=0)
    if lit.sum() < ENOUGH:
        return None
    read = (np.abs(contrast) > np.maximum(CLEAR_BIT * largest, CLEAR_SIGMAS * deviation)) & lit
    clear = read.sum(axis=1) >= READ_SHARE * lit.sum()
    finest = int(np.argmin(clear[::-1])) if not clear.all() else len(clear)
    finest = len(clear) - finest
    if len(clear) - finest < 3:
        return None
    bits = contrast > 0
    if code.name == "xor":
        bits[code.base_bit + 1 :] ^= bits[code.base_bit]
        if finest > code.base_bit:
            return None
    shape = (-1, *sample.mask.shape)
    return Stripes(bits[finest:].reshape(shape), read[finest:].all(axis=0).reshape(shape[1:]), finest)


def _numbers(bits: np.ndarray, *, gray: bool) -> np.ndarray:
    """Return the number that bits [bits, …] spell, bit 0 first."""
    if gray:
        bits = np.logical_xor.accumulate(bits[::-1], axis=0)[::-1]
    return np.tensordot(1 << np.arange(len(bits)), bits, 1)


def _check_order(stripes: Stripes, code: BinaryCode, extent: int) -> str | None:
    """Return what bits are declared wrongly, or how wide the projector looks; None if stripes follow each other as declared."""
    pairs = Pairs.of(stripes.known)
    declared = _numbers(stripes.bits, gray=code.name != "binary")
    steps = pairs.steps(declared)
    if len(steps) < ENOUGH:
        return None
    stripe_px = code.stripe_px * 2**stripes.finest
    swap = _exchanged(stripes.bits, pairs) if code.name == "gray" else None
    if swap is not None:
        return (f"neighbouring {code.axis} stripes differ in one bit, and do not follow each other as declared; they do if "
                f"{_exchange_words(swap, stripes)}")
    usual = max(float(np.median(steps[steps > 0])) if steps.any() else 1.0, 1.0)
    jumps = steps > JUMP * usual
    beyond = (np.minimum(*(declared.ravel()[side] for side in (pairs.first, pairs.second))) * stripe_px >= extent) & ~jumps
    outside = beyond.sum() > max(BEYOND_SHARE * len(steps), AT_A_PLACE)
    if steps.any():
        other = "binary" if code.name == "gray" else "gray"
        others = [(stripes.bits, other, f"a {code.name} code is declared, and they follow each other as those of a {other} code: check "
                   "code in the frames' patterns")] if code.name != "xor" else []
        if code.name == "binary":
            count = range(len(stripes.bits))
            others += [(_with_exchanged(stripes.bits, swap), code.name, f"they follow each other if {_exchange_words(swap, stripes)}")
                       for swap in combinations(count, 2)]
            others += [(stripes.bits ^ np.equal(count, bit)[:, None, None], code.name,
                        f"they follow each other if dark and bright of the bit {bit + stripes.finest} are exchanged: check inverse and the "
                        "order of its images in the frames' patterns") for bit in count]
        parts = [(mends(_numbers(bits, gray=name != "binary"), pairs, steps, jumps, extent / stripe_px, outside=bool(outside)), words)
                 for bits, name, words in others]
        mended = [(part, words) for part, words in parts if part is not None]
        if mended:
            return f"the {code.axis} stripes do not follow each other as declared; {min(mended)[1]}"
    if outside:
        widest = np.percentile(np.maximum(declared.ravel()[pairs.first], declared.ravel()[pairs.second])[~jumps], 99.9)
        return (f"{100 * beyond.mean():.2g} % of the {code.axis} stripes that are seen lie beyond the {extent} px of projector.resolution: "
                f"the projector looks {(widest + 1) * stripe_px:.0f} px large at least; check stripe_px and bit too")
    return None


def _with_exchanged(bits: np.ndarray, swap: tuple[int, int]) -> np.ndarray:
    order = np.arange(len(bits))
    order[list(swap)] = swap[::-1]
    return bits[order]


def _exchange_words(swap: tuple[int, int], stripes: Stripes) -> str:
    return f"the bits {' and '.join(str(bit + stripes.finest) for bit in swap)} are exchanged: check bit in the frames' patterns"


class Edges(NamedTuple):
    """Near pixels of a row that differ in one bit of a Gray code alone: right bits put them into stripes side by side."""

    ends: np.ndarray  # [bits, 2, pairs] bool, without finer bits that do not change one after another
    of_bit: list[np.ndarray]  # [pairs] bool each: where a bit changes, of the bits that change in enough rows
    finest: int
    """Number of finer bits that are left out."""

    @classmethod
    def of(cls, bits: np.ndarray, pairs: Pairs) -> "Edges | None":
        """Return those pairs; stripes side by side differ in one bit, and few others do, unless neighbouring pixels lie
        several stripes apart. Then the finest bits are left out; None if all are."""
        flat = bits.reshape(len(bits), -1)
        changes = flat[:, pairs.first] != flat[:, pairs.second]
        counts = np.cumsum(changes[::-1], axis=0)[::-1]  # of changes in each bit and all coarser ones
        dense = [bit for bit, count in enumerate(counts[:-2]) if (count == 1).sum() >= DENSE * (count > 0).sum()]
        if not dense:
            return None
        finest = dense[0]
        flat, changes, alone = flat[finest:], changes[finest:], counts[finest] == 1
        ends = flat[:, np.stack([pairs.first, pairs.second])[:, alone]]
        return cls(ends, [edge for edge in changes[:, alone] if len(np.unique(pairs.row[alone][edge])) >= LEAST_ROWS], finest)

    def following(self, ends: np.ndarray | None = None) -> float:
        """Return the least part, of all bits, of the pairs whose stripes follow each other; `ends` are other bits of the pairs."""
        first, second = _numbers(self.ends if ends is None else ends, gray=True)
        follow = np.abs(second - first) == 1
        return min((float(follow[edge].mean()) for edge in self.of_bit), default=1.0)


def _exchanged(bits: np.ndarray, pairs: Pairs) -> tuple[int, int] | None:
    """Return two bits of a Gray code that are exchanged; None if none are."""
    edges = Edges.of(bits, pairs)
    if edges is None or edges.following() >= CONTRADICTED:
        return None
    likely, swap = max((edges.following(_with_exchanged(edges.ends, swap)), swap) for swap in combinations(range(len(edges.ends)), 2))
    return (swap[0] + edges.finest, swap[1] + edges.finest) if likely >= FOLLOWED else None


def _check_waves(sample: Sample, stripes: Stripes, code: BinaryCode, collected: Collected, noise: NoiseModel) -> str | None:
    """Return how the waves of the same axis run otherwise than the stripes; None if they run with them, or do not tell."""
    phase = next((other for other in collected.codes if isinstance(other, PhaseCode) and other.axis == code.axis and not other.micro), None)
    if phase is None:
        return None
    stripe_px = code.stripe_px * 2**stripes.finest
    place, known, centre = _smooth_place(stripes, gray=code.name != "binary", stripe_px=stripe_px)
    for period, frames, shifts in phase.waves:
        if len(frames) < FULL_STEPS or stripe_px > period:
            continue
        readings = sample.grey[list(frames)]
        _, along, across = weights(np.array(shifts), period).T @ readings
        swing = np.hypot(along, across)
        good = known.ravel() & (swing > CLEAR_SIGMAS * np.sqrt(noise.variance(readings.mean(axis=0))))
        if good.sum() < ENOUGH:
            continue
        some = np.flatnonzero(good)[:: max(1, int(good.sum()) // SOME)]
        phasors = (along + 1j * across)[some] / swing[some]
        turned = np.angle(phasors * np.exp(-2j * np.pi * centre.ravel()[some] / period))
        wide = 2 * stripe_px > period
        inside = float((np.abs(turned) / (2 * np.pi) <= stripe_px / period / 2 + BESIDE_STRIPE).mean())
        if not wide and inside >= IN_STRIPES:
            continue
        found = _compare_wave(phasors, place.ravel()[some], period, wide=wide)
        if found is None and not wide and inside < OUT_OF_STRIPES:
            found = f"lie beside their stripes at {100 * (1 - inside):.0f} % of the pixels: check period_px, offset_rad, and stripe_px"
        if found is not None:
            return f"the {code.axis} phases of {period:g} px {found} in the frames' patterns"
    return None


def _smooth_place(stripes: Stripes, *, gray: bool, stripe_px: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the places in the projector of pixels from the stripes about them, [rows, cols] in its pixels, where they are known, and the
    middles of their stripes."""
    number = _numbers(stripes.bits, gray=gray).astype(np.float64)
    changes = np.diff(number, axis=1) != 0
    both = stripes.known[:, 1:] & stripes.known[:, :-1]
    width = 2 * int(np.clip(both.sum() / max((changes & both).sum(), 1) / 2, 0, stripes.known.shape[1] // 8)) + 1
    weight = uniform_filter1d(stripes.known.astype(np.float64), width, axis=1, mode="constant")
    mean = uniform_filter1d(np.where(stripes.known, number, 0), width, axis=1, mode="constant") / np.maximum(weight, 1e-9)
    known = stripes.known & (np.abs(mean - number) <= 1)
    return (np.where(known, mean, number) + 0.5) * stripe_px, known, (number + 0.5) * stripe_px


def _compare_wave(phasors: np.ndarray, place: np.ndarray, period: float, *, wide: bool) -> str | None:
    """Return how a wave runs otherwise than declared: by the frequency at which its phasors [n] turn over their places [n] in pixels.

    `wide` says that the places are those of stripes wider than half a period.
    """
    span = float(np.ptp(np.percentile(place, [2, 98])))
    if span < LEAST_PERIODS * period:
        return None
    fine = 1 / (8 * span)
    frequencies = np.arange(-2 / period, 2 / period, 4 * fine)
    best = frequencies[np.abs(_turning(phasors, place, frequencies)).argmax()]
    near = best + fine * np.linspace(-4, 4, 65)
    strengths = np.abs(_turning(phasors, place, near))
    best, strength = float(near[strengths.argmax()]), float(strengths.max())
    if strength < CLEAR_WAVE:
        return None
    declared, free = _turning(phasors, place, np.array([1 / period, best]))
    offset, own = (float(np.angle(mean)) / (2 * np.pi) for mean in (declared, free))
    backwards = abs(best + 1 / period) * span < 0.5
    if abs(declared) >= AS_DECLARED[wide or backwards] * strength and abs(offset) <= OFFSET[wide]:
        return None
    if backwards:
        return "run against the stripes: check step, whose order is reversed,"
    if abs(declared) < AS_DECLARED[wide] * strength or abs(own) < abs(offset) / 2:
        return f"look like waves of {1 / abs(best):.4g} px{' against the stripes' if best < 0 else ''}: check period_px, and stripe_px"
    return f"are offset by {offset:+.2g} periods against the stripes: check step and offset_rad"


def _turning(phasors: np.ndarray, place: np.ndarray, frequencies: Sequence[float] | np.ndarray) -> np.ndarray:
    """Return the means of phasors [n] that are turned back at frequencies [f] over their places [n]."""
    return np.array([(phasors * np.exp(-2j * np.pi * frequency * place)).mean() for frequency in frequencies])
