"""Pixels whose surface has moved between frames: sums of frames that are even light, of one part of the sequence and of another, differ.

A bit and its inverse, a wave over its shifts, and white and black add up to parts of white that are the same at all pixels, whatever the
projector's response. Where one of them is another part, another surface was seen, or an edge or a texture has passed.
"""

from typing import NamedTuple

import numpy as np

from kernels.structured.pattern_frames import NoiseModel
from service.depth.patterns.levels import even_means
from service.depth.patterns.pattern_checks import ENOUGH, FULL_PART, LIT_SIGMAS, Sample
from service.depth.patterns.readings import DECODE_BYTES_PER_PIXEL
from stage.patterns.binary import BinaryCode
from stage.patterns.codes import Collected
from stage.patterns.phase import PhaseCode
from stage.stack.planes import Planes

CLEAR_SIGMAS, LEAST_PART = 6.0, 0.04
"""Least difference of a sum from its usual part of white, in deviations of noise and in white, from which on a surface has moved: lamps
flicker by less."""
MOST_MOVED, SAID = 0.2, 0.005
"""Parts of the compared pixels above which it is no motion of single things, and from which on it is said."""


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
        spread = np.sqrt(noise.read**2 + noise.gain * np.maximum(grey[self.white], 0))
        return np.asarray(grey[self.white] - grey[self.black] > LIT_SIGMAS * spread)

    def parts(self, grey: np.ndarray, noise: NoiseModel) -> tuple[np.ndarray, np.ndarray]:
        """Return the sums less black as parts of white less black, [sums, pixels], and their deviations, [pixels]."""
        white = np.maximum(grey[self.white] - grey[self.black], 1e-9)
        sums = self.rows.astype(np.float32) @ grey
        deviation = np.sqrt(2 * (noise.read**2 + noise.gain * np.maximum(grey[self.white], 0))) / white
        return (sums - grey[self.black]) / white, deviation

    def moved(self, sample: Sample, noise: NoiseModel) -> np.ndarray:
        """Return where surfaces have moved, [pixels] bool; nowhere where a reading is or may be clipped, whose sums say nothing."""
        grey = sample.grey
        part, deviation = self.parts(grey, noise)
        away = np.abs(part - self.usual[:, None]).max(axis=0)
        found = np.asarray(self.lit(grey, noise) & (away > np.maximum(CLEAR_SIGMAS * deviation, LEAST_PART)))
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
