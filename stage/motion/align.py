"""Lit frames of a moving subject → the same frames as at the time of one tracking frame.

The flow from the reference tracking frame to each other one says where every point of the subject was at their times;
between two of them it moved evenly along a straight line (Wenger et al. 2005, Performance relighting and reflectance
transformation with time-multiplexed illumination; Guo et al. 2019, The Relightables). All of this lies on the pixels of the
reference, so that no flow is inverted or chained.
"""

from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any

import numpy as np

from stage.capture import Capture
from stage.correction import Correction, Radiance
from stage.errors import ImageError
from stage.manifest import Frame
from stage.motion.tracking import Interval, Tracking, intervals

if TYPE_CHECKING:
    from stage.motion.flow import Flow

VERSION = 1
"""Raised when the arithmetic changes, so that older caches are rebuilt."""
DARKEST = 0.05
"""Of another tracking frame's brightness: a frame below it was not lit by every light."""

Warp = Callable[[int, Radiance], Radiance]
"""Called with a light's place in the stack and its corrected image; `saturated` of what it gives is where there is no reading."""


class Alignment:
    """Warps the frames of a stack, one tracking interval at a time: two flows are held, however long the capture is."""

    def __init__(self, capture: Capture, tracking: Tracking, frames: list[Frame]) -> None:
        """Args: the capture, its tracking frames, and the frames of its stack.

        Raises:
            ManifestError: a frame lies too far outside the tracking frames; names it.
        """
        self._tracking = tracking
        self._mask = capture.mask()
        self._intervals = intervals(capture, tracking, frames)
        self._facts: list[tuple[int, dict[str, Any]]] = []
        self._lost: list[int] = []

    def batches(self, correction: Correction) -> Iterator[tuple[tuple[int, ...], Warp]]:
        """The lights of one interval after the other, with what warps their images; a warp may be called from several threads.

        Args:
            correction: of the capture; tracking frames go through it like all others.

        Raises:
            ImageError: a tracking frame is unreadable, or dark; names the file.
        """
        from stage.motion import flow  # OpenCV takes 0.15 s to load, which a subject that stands still need not wait for

        frames, middle = self._tracking.frames, self._tracking.reference
        white: dict[int, float] = {}

        def look(index: int) -> np.ndarray:
            radiance = correction.apply(frames[index]).pixels
            white[index] = flow.white_level(radiance, self._mask)
            dim, bright = sorted((index, middle), key=lambda one: white[one])
            if white[dim] <= DARKEST * white[bright]:
                path = correction.capture.file(frames[dim].image)
                raise ImageError(f"{path}: is dark inside the mask: a tracking frame shows the subject under every light")
            return flow.display(radiance, white[index])  # each by its own white: flashes differ

        reference = look(middle)
        still = flow.Flow(np.zeros((*self._mask.shape, 2), np.float32), np.ones(self._mask.shape, bool))
        last, later = still, True
        for interval in self._intervals:
            if later and interval.first < middle:  # from the reference backwards now
                last, later = still, False
            guess = None if last is still else flow.carry_on(last, self._mask)
            near, last = last, flow.match(reference, look(interval.first + later), guess)
            begin, end = (near, last) if later else (last, near)
            self._note(interval, begin, end)
            yield interval.lights, self._warp(interval, begin, end)

    def statistics(self) -> dict[str, Any]:
        """What the report says, once all batches are done."""
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
