"""Stripes of laser frames on a target, along rows and along columns of the image, and the frames that show the target without them."""

from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np

from kernels.device import to_numpy
from kernels.status import Status
from kernels.structured.stripe import KNOWN_REACH, find_stripe
from service.depth.laser.stripes import Signal
from stage.capture.capture import Capture
from stage.capture.light import LaserPlane
from stage.capture.manifest import Frame
from stage.colour.colour import GREY_WEIGHTS
from stage.patterns.base import UniformPattern
from stage.stack.correction import Correction

Along = Literal["row", "column"]
ALONG: tuple[Along, ...] = ("row", "column")


def laser_frames(capture: Capture) -> list[Frame]:
    """Return the frames of a capture under a laser plane."""
    return [frame for frame in capture.manifest.frames if isinstance(frame.laser, LaserPlane)]


class SeenStripe(NamedTuple):
    """The points of a stripe that was looked for along rows or columns, one on each line that shows it."""

    along: Along
    lines: np.ndarray  # [n] number of the line
    centre: np.ndarray  # [n] place on the line
    width: np.ndarray  # [n] standard deviation of the profile, pixels
    peak: np.ndarray  # [n] reading at the peak, less the light beside the laser

    def image(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the image coordinates u and v, [n] each."""
        across, down = self.centre.astype(np.float64), self.lines + 0.5
        return (across, down) if self.along == "row" else (down, across)

    def within(self, mask: np.ndarray, width: float) -> "SeenStripe":
        """Return the points whose profile, of this width, lies in the mask: of one that is cut the middle is elsewhere than of what is
        left."""
        first, end = (np.floor(self.centre + reach * width).astype(int) for reach in (-KNOWN_REACH, KNOWN_REACH))
        before = np.cumsum(np.pad(mask if self.along == "row" else mask.T, ((0, 0), (1, 0))), axis=1)  # pixels of the mask
        most = before.shape[1] - 1
        inside = before[self.lines, np.clip(end + 1, 0, most)] - before[self.lines, np.clip(first, 0, most)]
        kept = inside == end + 1 - first
        return self.where(kept)

    def where(self, kept: np.ndarray) -> "SeenStripe":
        """Return some of the points, [n] bool."""
        return SeenStripe(self.along, self.lines[kept], self.centre[kept], self.width[kept], self.peak[kept])


def find_stripes(signal: Signal, albedo: np.ndarray | None, device: str) -> list[SeenStripe]:
    """Return a stripe as it is seen along rows, and along columns."""
    found = []
    for along in ALONG:
        stripe = find_stripe(np.ascontiguousarray(signal.values), along=along, noise=signal.noise, device=device, albedo=albedo)
        lines = np.flatnonzero(to_numpy(stripe.status) == Status.OK)
        found.append(SeenStripe(along, lines, *(to_numpy(each)[lines] for each in (stripe.centre, stripe.width, stripe.amplitude))))
    return found


def whole_stripes(stripes: list[list[SeenStripe]], masks: Sequence[np.ndarray]) -> list[list[SeenStripe]]:
    """Return the stripes of all frames without points whose profile leaves the mask of their frame, [rows, cols] bool."""
    widths = np.concatenate([seen.width for pair in stripes for seen in pair])
    if not len(widths):
        return stripes
    width = float(np.median(widths))
    return [[seen.within(mask, width) for seen in pair] for pair, mask in zip(stripes, masks, strict=True)]


def uniform(capture: Capture, correction: Correction, code: str) -> np.ndarray | None:
    """Return the frame under a white or black projection, [rows, cols, 3] linear; None: there is none."""
    frames = (frame for frame in capture.manifest.frames if isinstance(frame.pattern, UniformPattern) and frame.pattern.code == code)
    frame = next(frames, None)
    return None if frame is None else correction.apply(frame).pixels


def even_light(capture: Capture, correction: Correction) -> np.ndarray | None:
    """Return the grey of the target, [rows, cols] float32, under a white projection, or else under the light of the room.

    The light of the room is a frame without the laser, or that under a black projection. None: no frame shows the target.
    """
    shown = uniform(capture, correction, "white")
    if shown is None:
        shown = correction.ambient if correction.ambient is not None else uniform(capture, correction, "black")
    return None if shown is None else np.asarray(shown @ np.array(GREY_WEIGHTS, np.float32), dtype=np.float32)
