"""The highest readings of some frames of a capture under lights, noted while the frames are decoded for something else."""

import zlib
from collections.abc import Mapping
from contextlib import suppress
from typing import Any, NamedTuple

import numpy as np

from stage.capture.capture import Capture
from stage.capture.light import DistantLight, PointLight
from stage.errors import StageError

READ, MOST_FRAMES, FEWEST_FRAMES = 300_000, 12, 4
"""Pixels of the object whose highest reading is looked for, most frames in which it is, and frames under lights from which on it is."""
NEAR_TOP, LEVELS, SPIKE = 0.8, 16, 5.0
"""Least part of the highest reading that is compared with it, different readings there, of shading, and how many times more pixels have the
highest reading than any other."""


class Peak(NamedTuple):
    """The highest readings of the object in one frame."""

    full: int
    """The largest integer of its file; 0 of floating-point values."""
    top: float
    """The highest recorded value."""
    at_top: int
    """The number of readings that have it."""
    crowd: int
    """The largest number of readings that have one value near below, and how many such values there are."""
    levels: int

    @property
    def is_spike(self) -> bool:
        """Whether the highest value has more readings than any value of shading."""
        return self.levels >= LEVELS and self.at_top > SPIKE * self.crowd


class Peaks:
    """The peaks of frames that stand for all, noted by whoever decodes frames, in several threads or one."""

    def __init__(self, capture: Capture, mask: np.ndarray | None = None) -> None:
        """Choose frames, none of a capture of few, or of polarised pairs. `mask`: that of the capture, [rows, cols] bool; None: it is read,
        and nothing is noted where it cannot be."""
        lit = [frame for frame in capture.manifest.frames if isinstance(frame.light, DistantLight | PointLight)]
        judged = len(lit) >= FEWEST_FRAMES and not capture.is_polarised
        self.frames = {lit[index].image: lit[index] for index in evenly(np.arange(len(lit)), MOST_FRAMES)} if judged else {}
        """The chosen frames by their images."""
        self.found: dict[str, Peak] = {}
        """The peaks of those that were decoded, by their images."""
        self.mask: np.ndarray | None = None
        """The mask of the object, [rows, cols] bool; None where no frame is chosen or it cannot be read."""
        self._pixels: tuple[np.ndarray, ...] | None = None
        self._key = 0
        with suppress(StageError):
            if judged:
                self.mask = capture.mask() if mask is None else mask
                pixels = evenly(np.flatnonzero(self.mask), READ)
                self._pixels = np.unravel_index(pixels, (capture.camera.height, capture.camera.width))
                self._key = zlib.crc32(pixels.tobytes())

    def note(self, image: str, recorded: np.ndarray) -> None:
        """Note the peak of a chosen frame; `recorded`: [rows, cols, 3] uint8, uint16, float16 or float32, the values of its file."""
        if self._pixels is None or image not in self.frames:
            return
        full, some = int(np.iinfo(recorded.dtype).max) if recorded.dtype.kind == "u" else 0, recorded[self._pixels]
        values, counts = np.unique(some if full else some.astype(np.float32), return_counts=True)
        near = counts[:-1][values[:-1] >= NEAR_TOP * values[-1]]
        self.found[image] = Peak(full, float(values[-1]) / (full or 1), int(counts[-1]), int(near.max(initial=0)), len(near))

    def kept(self) -> dict[str, Any]:
        """Return the peaks as JSON, for `recall`."""
        return {"pixels": self._key, "found": {image: self.found[image] for image in self.frames if image in self.found}}

    def recall(self, kept: Mapping[str, Any]) -> None:
        """Take peaks over that `kept` has returned, unless they are of the pixels of another mask."""
        if kept.get("pixels") == self._key:
            self.found |= {image: Peak(*peak) for image, peak in kept["found"].items() if image in self.frames}


def evenly(places: np.ndarray, count: int) -> np.ndarray:
    """Return places that are evenly spread among all, [count] or as many as there are."""
    return places[np.linspace(0, len(places) - 1, min(count, len(places))).astype(int)]
