"""Waves that go on beyond the declared border of the projector, whose places there would be taken for others inside.

Where a surface crosses that border, the phases of its neighbouring pixels are those of one row of columns on both sides of it. Noise, blur
and bounced light make no such row.
"""

import numpy as np

from kernels.structured.pattern_frames import NoiseModel
from kernels.structured.unwrap import unwrap_range
from service.depth.patterns.decoders import PatternProjector
from service.depth.patterns.pattern_checks import Sample
from service.depth.patterns.wave_checks import CROSSING_SHARE, CROSSINGS, MISFIT, NOISE_TIMES, Waves, joint_fit, unnumbered, waves_of
from stage.patterns.codes import Collected

LOOKED_AT = 2.0
"""How far places are looked for, as a multiple of the projector, where the periods tell them apart so far."""
LEAST_BEYOND = 1.05
"""Least such multiple at which anything is looked for."""
FITS = 1.5
"""Misfit of a pixel whose place counts, over the median misfit up to which waves agree."""
NEAR = 0.25
"""Largest step between neighbouring pixels of one surface, shortest periods."""
BESIDE_PERIODS = 0.5
"""Shortest periods by which a surface must go on to both sides of the border: more than noise and blur."""
ONE_WAVE_PART = 1 / 8
"""Part of the period that counts as the shortest one for both, of one wave that is wider than the projector."""


def check_range(sample: Sample, collected: Collected, projector: PatternProjector, noise: NoiseModel) -> str | None:
    """Return a sentence if surfaces go on beyond the border of the projector, which has the exponent of its waves where they are bent."""
    for code in unnumbered(collected):
        waves = waves_of(sample, code, projector, noise)
        if waves is not None and (farthest := _farthest(waves)) is not None:
            return (f"frames: the {code.axis} phases go on beyond the {waves.extent} {code.axis}s of the projector, to about "
                    f"{farthest:.0f}: check projector.resolution, and period_px in the frames' patterns")
    return None


def _farthest(waves: Waves) -> float | None:
    """Return the last place of surfaces that cross the border of the projector; None where too few do."""
    looked_at = LOOKED_AT * waves.extent
    looked_at = min(looked_at, 0.98 * unwrap_range(tuple(waves.periods.tolist()), looked_at))
    if looked_at < LEAST_BEYOND * waves.extent:
        return None
    shortest = float(waves.periods.min())
    place = np.full(waves.clear.shape, np.nan)
    if len(waves.periods) == 1:
        place[waves.clear] = waves.turns[0, waves.clear] % 1 * shortest
        shortest *= ONE_WAVE_PART
    else:
        misfit, found = joint_fit(waves.turns[:, waves.clear], waves.periods, looked_at)
        limit = FITS * np.maximum(MISFIT, NOISE_TIMES * waves.deviation[waves.clear])
        place[waves.clear] = np.where(misfit < limit, found, np.nan)
    rows, ends, beside = 0, [], BESIDE_PERIODS * shortest
    for line in place:
        joined = np.abs(np.diff(line)) < NEAR * shortest
        rows += bool(joined.any())
        borders = np.flatnonzero(np.diff(np.concatenate([[0], joined.astype(np.int8), [0]])))
        runs = (line[first : last + 1] for first, last in zip(borders[::2], borders[1::2], strict=True))
        ends += [max((run.max() for run in runs if run.min() < waves.extent - beside and run.max() > waves.extent + beside), default=0.0)]
    ends = [end for end in ends if end > 0]
    return float(np.median(ends)) if len(ends) >= max(CROSSINGS, CROSSING_SHARE * rows) else None
