"""Frames of each pattern at several exposures, joined: every pixel takes all exposures at which none of its frames is clipped.

The light that the chosen exposures gather is counted together, (Σ tᵢ Iᵢ) / Σ tᵢ, which is the mean with the least noise under photon noise.
All frames of a pixel take the same exposures, so that their ratios stay, and their noise is that of one long exposure of Σ tᵢ.

Source: Hasinoff, Durand and Freeman, "Noise-optimal capture for high dynamic range photography", CVPR 2010, section 3.
"""

from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from stage.capture.capture import Capture
from stage.capture.manifest import FILE_NAME, Frame
from stage.errors import ManifestError
from stage.stack.correction import FULL_SCALE, Correction, Radiance

SAME = 0.01
"""Part by which two exposure times may differ and count as one: EXIF has fractions of small integers."""


class ExposureSeries(NamedTuple):
    """The frames of patterns that were all taken at several exposures."""

    shown: tuple[Frame, ...]
    """One frame of each pattern, in the order in which the patterns come first: the shortest."""
    taken: tuple[tuple[Frame, ...], ...]
    """All frames of each pattern, the shortest exposure first."""

    @property
    def times_s(self) -> tuple[float, ...]:
        """The exposure times, the shortest first."""
        return tuple(frame.exposure_s or 0.0 for frame in self.taken[0])


def exposure_series(capture: Capture, frames: Sequence[Frame]) -> ExposureSeries | None:
    """Return the frames of patterns by their exposures; None where no pattern was taken at more than one.
    Raises ManifestError if some patterns were not taken at an exposure that others were, or the images do not say where they saturate."""
    groups: dict[object, list[Frame]] = {}
    for frame in frames:
        groups.setdefault(frame.pattern, []).append(frame)
    taken = tuple(tuple(sorted(group, key=lambda frame: frame.exposure_s or 0.0)) for group in groups.values())
    several = [group for group in taken if any(_differ(a, b) for a, b in pairwise(group))]
    if not several:
        return None
    where = f"{capture.folder / FILE_NAME}: frames"
    most = max(several, key=len)
    for group in taken:
        if len(group) != len(most) or any(_differ(a, b) for a, b in zip(group, most, strict=True)):
            pattern = group[0].pattern
            assert pattern is not None
            times, others = (", ".join(f"{frame.exposure_s:g}" for frame in frames) for frames in (group, most))
            raise ManifestError(f"{where}: {pattern.describe()} was taken at {times} s, other patterns at {others} s: every pattern "
                                "needs all exposures once")
    return ExposureSeries(tuple(group[0] for group in taken), taken)


def frames_shown(capture: Capture) -> tuple[list[Frame], ExposureSeries | None]:
    """Return one frame of each pattern of a capture, and the series that they are joined from, where there is one."""
    taken = [frame for frame in capture.manifest.frames if frame.pattern is not None]
    series = exposure_series(capture, taken)
    return (taken if series is None else list(series.shown)), series


def _differ(one: Frame, other: Frame) -> bool:
    a, b = one.exposure_s or 0.0, other.exposure_s or 0.0
    return abs(a - b) > SAME * max(a, b)


class JoinedExposures:
    """The frames of a series, joined one by one."""

    def __init__(self, capture: Capture, series: ExposureSeries, progress: Callable[[int], None] | None = None) -> None:
        """Read all frames once, to learn at which exposures no frame of a pixel is clipped.
        `progress`: called after every pattern with the count of patterns that have been read. Raises ManifestError if a frame does not say
        where it saturates."""
        self._correction = Correction.of(capture, full_scale=True)
        self._taken = {frame.image: group for frame, group in zip(series.shown, series.taken, strict=True)}
        times = series.times_s
        clipped = np.zeros((len(times), capture.camera.height, capture.camera.width), dtype=bool)
        for done, group in enumerate(series.taken, start=1):
            for number, frame in enumerate(group):
                saturated = self._correction.apply(frame).saturated
                if saturated is None:
                    raise ManifestError(f"{capture.folder / FILE_NAME}: saturation: is missing: exposures of floating-point images are "
                                        "joined where none is clipped, and nothing says from which value they are")
                clipped[number] |= saturated
            if progress is not None:
                progress(done)
        self._weight = np.where(clipped, 0, np.array(times, dtype=np.float32)[:, None, None])
        self._lost = clipped.all(axis=0)
        self._weight[0][self._lost] = times[0]  # clipped even in the shortest: its frames say in which of them
        self._total = self._weight.sum(axis=0)
        self.counts = tuple(int((self._weight[number] > 0).sum()) for number in range(len(times)))
        """Number of pixels that take each exposure."""
        self.exposure = (self._total / sum(times)).astype(np.float32)
        """[rows, cols] light that a pixel has gathered, over that of all exposures: 1 where no frame is clipped."""
        limit = FULL_SCALE if capture.manifest.saturation is None else capture.manifest.saturation
        self.full_scale = limit / sum(times)
        """The largest reading of one exposure over the time of all, in the unit of the corrected images."""

    def read(self, frame: Frame) -> Radiance:
        """Return the joined frame of a pattern: radiance, and where all its exposures are clipped.
        `frame`: one of `ExposureSeries.shown`."""
        total = np.zeros((*self._total.shape, 3), dtype=np.float32)
        saturated = np.zeros_like(self._lost)
        for number, taken in enumerate(self._taken[frame.image]):
            radiance = self._correction.apply(taken)
            total += self._weight[number, ..., None] * radiance.pixels
            if number == 0 and radiance.saturated is not None:
                saturated = radiance.saturated & self._lost
        return Radiance(total / self._total[..., None], saturated)
