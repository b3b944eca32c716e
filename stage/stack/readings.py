"""What the readings of the frames under lights show of a capture that its manifest does not say: a level below full scale at which they are
clipped, and a mask of all but the object.

Each is told by what a right capture does not show: shading has no level that many readings share and none exceeds, and a mask that reaches
all around the image and leaves out what lies within is of an object where that is bright, or has a shape.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy import ndimage

from stage.capture.capture import Capture
from stage.capture.light import DistantLight, PointLight
from stage.capture.manifest import Frame
from stage.colour.colour import GREY_WEIGHTS, LARGEST_INTEGER
from stage.formats import images
from stage.stack.correction import Correction

PIXELS, READ, MOST_FRAMES = 2000, 300_000, 12
"""Pixels of the object and of the rest whose readings are compared, those of the object whose highest reading is looked for, and frames."""
FEWEST_FRAMES = 4
"""Frames from which on they are compared."""
NEAR_TOP, LEVELS, SPIKE = 0.8, 16, 5.0
"""Least part of the highest reading that is compared with it, different readings there, of shading, and how many times more pixels have the
highest reading than any other."""
FEWEST_CLIPPED, UNLIKE = 20, 1.1
"""Fewest readings of all frames that are called clipped, and ratio of their numbers in two frames: a facet has one size in all."""
EIGHT_BITS = 255
"""The largest integer of eight bits."""
AROUND, WITHIN, LEFT_OUT = 0.9, 0.5, 0.1
"""Least part of the pixels at the border of an image that a mask of the rest has, least part of what it leaves out that is away from the
border, and least part of the image that it leaves out."""
DARK, PLANE, SHAPED = 0.2, 0.1, 3.0
"""Brightness of what the mask has over that of what it leaves out, and residual of one normal there, below which it is none of the object;
and how many times that residual is of what it leaves out."""

ALPHA = (2, 4)
"""Counts of the channels of images with alpha."""
CLEAR = "mask: it is white everywhere and has alpha, which is not read: write the object white and the rest black"


class Seen(NamedTuple):
    """What one frame shows."""

    full: int
    """The largest integer of its file; 0 of floating-point values."""
    top: float
    """The highest recorded value of the object."""
    at_top: int
    """The number of readings that have it."""
    crowd: int
    """The largest number of readings that have one value near below, and how many such values there are."""
    levels: int
    inside: np.ndarray  # [pixels, 3] float32, radiance over the strength of the light, of some pixels of the object
    outside: np.ndarray  # the same of what the mask leaves out


def said_by_readings(capture: Capture) -> list[str]:
    """Return a sentence for each of these that some frames of a capture under lights show and its doubts do not say already."""
    lit = [(frame, frame.light) for frame in capture.manifest.frames if isinstance(frame.light, DistantLight | PointLight)]
    if len(lit) < FEWEST_FRAMES or capture.is_polarised:
        return []
    mask, correction = capture.mask(), Correction.of(capture)
    clear = mask.all() and capture.manifest.mask is not None and images.read_header(capture.file(capture.manifest.mask)).stored in ALPHA
    inside, outside = np.flatnonzero(mask), np.flatnonzero(~mask)
    some = [(places, correction.at(places)) for places in (_evenly(inside, PIXELS), _evenly(outside, PIXELS))]
    read = _evenly(inside, READ)

    def see(frame: Frame, light: DistantLight | PointLight) -> Seen:
        recorded = capture.recorded(frame.image)
        flat, full = recorded.reshape(-1, 3), int(np.iinfo(recorded.dtype).max) if recorded.dtype.kind == "u" else 0
        values, counts = np.unique(flat[read], return_counts=True)
        near = counts[:-1][values[:-1] >= NEAR_TOP * values[-1]]
        strength = np.array(light.irradiance if isinstance(light, DistantLight) else light.intensity, np.float32)
        strength[strength == 0] = np.inf  # a channel without light shows nothing
        return Seen(full, float(values[-1]) / (full or 1), int(counts[-1]), int(near.max(initial=0)), len(near),
                    *(at.corrected(flat[places][:, None], frame)[:, 0] / strength for places, at in some))

    seen = [see(*lit[index]) for index in _evenly(np.arange(len(lit)), MOST_FRAMES)]
    said = [*_clipped(capture.manifest.saturation, seen), *_turned_mask(mask, seen), *([CLEAR] if clear else [])]
    return [sentence for sentence in said if sentence not in capture.doubts]


def _evenly(places: np.ndarray, count: int) -> np.ndarray:
    return places[np.linspace(0, len(places) - 1, min(count, len(places))).astype(int)]


def _clipped(saturation: float | None, frames: Sequence[Seen]) -> list[str]:
    """Return the sentence for a level below full scale at which readings are clipped, or for eight bits in files of sixteen."""
    top, full = max((each.top, each.full) for each in frames)
    if full == LARGEST_INTEGER and round(top * full) == EIGHT_BITS:
        return [f"frames[].image: the highest reading is {EIGHT_BITS} of {full}, as where 8 bits lie in 16-bit files: write them as 8-bit "
                "images, which most cameras encode as srgb_texture"]
    at = [each for each in frames if each.top == top]
    spikes = [each for each in at if each.levels >= LEVELS and each.at_top > SPIKE * each.crowd]
    limit = saturation or (1.0 if full else np.inf)
    sizes = [each.at_top for each in spikes]
    if sum(sizes) < FEWEST_CLIPPED or max(sizes) < UNLIKE * min(sizes) or top >= limit:
        return []
    told = f"{top:.4g}" + (f" ({round(top * full)} of {full})" if full else "")
    return [f"saturation: many readings of {len(at)} images are {told}, and none is above: they are clipped there, and are taken for light "
            f"that was measured: give saturation {np.floor(top * 1e5) / 1e5:.5g}"]


def _turned_mask(mask: np.ndarray, frames: Sequence[Seen]) -> list[str]:
    """Return the sentence for a mask of all but the object."""
    border = np.ones(mask.shape, dtype=bool)
    border[1:-1, 1:-1] = False
    parts, _ = ndimage.label(~mask)
    at_border, left_out = np.isin(parts, np.unique(parts[border])), int((~mask).sum())
    if mask[border].mean() < AROUND or left_out < LEFT_OUT * mask.size or (~mask & ~at_border).sum() < WITHIN * left_out:
        return []
    inside, outside = (np.stack(side) @ np.array(GREY_WEIGHTS) for side in ([each.inside for each in frames],
                                                                            [each.outside for each in frames]))
    dark = np.median(inside.max(axis=0)) < DARK * np.median(outside.max(axis=0))
    flat = _shape(inside) < PLANE and _shape(outside) > SHAPED * _shape(inside)
    return [f"mask: it reaches all around the image and leaves out what is within, which is {'brighter' if dark else 'no plane'}: if that "
            "is the object, it is the mask of the background: invert it"] if dark or flat else []


def _shape(readings: np.ndarray) -> float:
    """Return the median residual of pixels [frames, pixels] that would all face one way."""
    length = np.linalg.norm(readings, axis=0)
    if not length.any():
        return 0.0
    shade = readings[:, length > 0] / length[length > 0]
    return float(np.median(np.linalg.norm(shade - np.median(shade, axis=1, keepdims=True), axis=0)))
