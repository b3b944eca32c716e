"""Alignment of the lit frames of a moving subject to the time of one tracking frame, the reference.

The optical flow from the reference to every other tracking frame gives the position of each point of the subject at their times;
between two tracking frames a point is taken to move evenly along a straight line. Flow is defined on the pixels of the reference, so
that no flow is inverted or chained.

Source: Wenger et al., "Performance relighting and reflectance transformation with time-multiplexed illumination", SIGGRAPH 2005;
    Guo et al., "The Relightables", SIGGRAPH Asia 2019.
"""

from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any

import numpy as np

from stage.capture.capture import Capture
from stage.capture.manifest import Frame
from stage.errors import ImageError
from stage.motion.tracking import Interval, Tracking, intervals
from stage.stack.correction import Correction, Radiance

if TYPE_CHECKING:
    from stage.motion.flow import Flow

VERSION = 1
"""The version of the alignment; a change of the arithmetic raises it, so that older caches are rebuilt."""
DARKEST = 0.05
"""The least brightness of a tracking frame relative to another one: a darker frame was not lit by all lights."""

Warp = Callable[[int, Radiance], Radiance]
"""A function from the index of a light in the stack and its corrected image to the aligned image, whose `saturated` is True where no
reading exists."""


class Alignment:
    """The alignment of the frames of a stack, one tracking interval at a time, so that two flows at most are in memory."""

    def __init__(self, capture: Capture, tracking: Tracking, frames: list[Frame]) -> None:
        """Assign the frames of a stack to the intervals between tracking frames."""
        self._tracking = tracking
        self._mask = capture.mask()
        self._intervals = intervals(capture, tracking, frames)
        self._facts: list[tuple[int, dict[str, Any]]] = []
        self._lost: list[int] = []

    def batches(self, correction: Correction) -> Iterator[tuple[tuple[int, ...], Warp]]:
        """Yield the lights of one interval after another with the warp of their images, which several threads may call."""
        from stage.motion import flow  # OpenCV takes 0.15 s to load, which only aligned captures need

        frames, middle = self._tracking.frames, self._tracking.reference
        white: dict[int, float] = {}

        def tracking_image(index: int) -> np.ndarray:
            radiance = correction.apply(frames[index]).pixels
            white[index] = flow.white_level(radiance, self._mask)
            dim, bright = sorted((index, middle), key=lambda one: white[one])
            if white[dim] <= DARKEST * white[bright]:
                path = correction.capture.file(frames[dim].image)
                raise ImageError(f"{path}: is dark inside the mask: a tracking frame shows the subject under every light")
            return flow.display(radiance, white[index])  # each frame by its own white level, because flashes differ

        reference = tracking_image(middle)
        still = flow.Flow(np.zeros((*self._mask.shape, 2), np.float32), np.ones(self._mask.shape, bool))
        last, later = still, True
        for interval in self._intervals:
            if later and interval.first < middle:  # now backwards in time from the reference
                last, later = still, False
            guess = None if last is still else flow.extrapolate(last, self._mask)
            previous, last = last, flow.find_flow(reference, tracking_image(interval.first + later), guess)
            begin, end = (previous, last) if later else (last, previous)
            self._note(interval, begin, end)
            yield interval.lights, self._warp(interval, begin, end)

    def statistics(self) -> dict[str, Any]:
        """Return the statistics for the report, when all batches are done."""
        parts = [part for interval in self._intervals for part in interval.fractions]
        return {
            "reference": self._tracking.frames[self._tracking.reference].image,
            "tracking_frames": len(self._tracking.frames),
            "extrapolated_frames": sum(not 0 <= part <= 1 for part in parts),
            "no_reading_fraction": round(sum(self._lost) / (len(parts) * int(self._mask.sum())), 5),
            "intervals": [facts for _, facts in sorted(self._facts, key=lambda entry: entry[0])],
        }

    def _warp(self, interval: Interval, begin: "Flow", end: "Flow") -> Warp:
        fraction_of = dict(zip(interval.lights, interval.fractions, strict=True))

        def warp(light: int, radiance: Radiance) -> Radiance:
            from stage.motion import resample

            part = np.float32(fraction_of[light])
            displacement = (1 - part) * begin.displacement + part * end.displacement
            known = (begin.known | (part == 1)) & (end.known | (part == 0))
            x, y, inside = resample.positions(displacement)
            none = ~(known & inside)
            self._lost.append(int(none[self._mask].sum()))
            if radiance.saturated is not None:
                none |= resample.touched(radiance.saturated, x, y)
            return Radiance(resample.bicubic(radiance.pixels, x, y), none)

        return warp

    def _note(self, interval: Interval, begin: "Flow", end: "Flow") -> None:
        both = begin.known & end.known & self._mask
        moved = np.linalg.norm((end.displacement - begin.displacement)[both], axis=-1)
        distance = {"median": round(float(np.median(moved)), 3), "max": round(float(moved.max()), 3)} if len(moved) else {}
        self._facts.append((interval.first, {
            "from": self._tracking.frames[interval.first].image,
            "to": self._tracking.frames[interval.first + 1].image,
            "frames": len(interval.lights),
            "displacement_px": distance,
            "disagreement_fraction": round(1 - int(both.sum()) / int(self._mask.sum()), 5),
        }))
