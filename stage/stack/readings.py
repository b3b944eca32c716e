"""What the readings of the frames under lights show of a capture that its manifest does not say: a level below full scale at which they are
clipped, and a mask of all but the object.

Each is told by what a right capture does not show: shading has no level that many readings share and none exceeds, and a mask that reaches
all around the image and leaves out what lies within is of an object where that is bright, or has a shape.
"""

from collections.abc import Callable, Sequence

import numpy as np
from scipy import ndimage

from stage.capture.capture import Capture
from stage.capture.light import DistantLight, PointLight
from stage.colour.colour import GREY_WEIGHTS, LARGEST_INTEGER
from stage.formats import images
from stage.stack.correction import Correction
from stage.stack.peaks import Peak, Peaks, evenly

PIXELS = 2000
"""Pixels of the object and of the rest whose readings are compared."""
FIRST = 6
"""Frames that decide whether the others are looked at: of 103 synthetic captures with clipping that all twelve show, six pass one over
where they have the frontal lights, and four where no light is known, which a solve tells once it has decoded all."""
FOURTEEN_BITS = 0.25
"""Part of full scale that 14 bits at the lower end of 16 reach, to which cameras with 12 or 14 are clipped."""
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


def said_by_readings(capture: Capture, peaks: Peaks | None = None, advance: Callable[[int], None] | None = None) -> list[str]:
    """Return a sentence for each of these that some frames of a capture under lights show and its doubts do not say already.
    `peaks`: those of frames that are decoded already; of others a few are decoded, or all that were chosen, where the few do not decide.
    `advance`: called with the count of frames that were looked at, MOST_FRAMES at most."""
    peaks = Peaks(capture) if peaks is None else peaks
    if not peaks.frames:
        return []
    mask, saturation = capture.mask() if peaks.mask is None else peaks.mask, capture.manifest.saturation
    clear = mask.all() and capture.manifest.mask is not None and images.read_header(capture.file(capture.manifest.mask)).stored in ALPHA
    turned = _turned_mask(capture, mask, peaks) if _reaches_around(mask) else []
    spread = dict.fromkeys([*evenly(np.array([*peaks.frames]), FIRST).tolist(), *peaks.frames])
    toward = {image: light.direction[2] for image in spread if isinstance(light := peaks.frames[image].light, DistantLight)}
    for done, image in enumerate(sorted(spread, key=lambda image: -toward.get(image, 0.0)), start=1):
        if image not in peaks.found:
            peaks.note(image, capture.recorded(image))
        if advance is not None:
            advance(done)
        if _decided(saturation, [*peaks.found.values()]):
            break
    said = [*_clipped(saturation, [*peaks.found.values()]), *turned, *([CLEAR] if clear else [])]
    return [sentence for sentence in said if sentence not in capture.doubts]


def _decided(saturation: float | None, peaks: Sequence[Peak]) -> bool:
    """Return whether more frames would not change what is said of clipping: none do where a reading reaches the limit, and hardly any
    where several have neither clipped readings nor a highest one as low as cameras of few bits are clipped at."""
    top, full = max((each.top, each.full) for each in peaks)
    suspicious = (full == LARGEST_INTEGER and top <= FOURTEEN_BITS) or any(each.is_spike for each in peaks)
    return top >= _limit(saturation, full) or (len(peaks) >= FIRST and not suspicious)


def _limit(saturation: float | None, full: int) -> float:
    """Return the value from which readings are known to be clipped. `full`: as of `Peak`."""
    return saturation or (1.0 if full else np.inf)


def _clipped(saturation: float | None, frames: Sequence[Peak]) -> list[str]:
    """Return the sentence for a level below full scale at which readings are clipped, or for eight bits in files of sixteen."""
    top, full = max((each.top, each.full) for each in frames)
    if full == LARGEST_INTEGER and round(top * full) == EIGHT_BITS:
        return [f"frames[].image: the highest reading is {EIGHT_BITS} of {full}, as where 8 bits lie in 16-bit files: write them as 8-bit "
                "images, which most cameras encode as srgb_texture"]
    at = [each for each in frames if each.top == top]
    spikes = [each for each in at if each.is_spike]
    sizes = [each.at_top for each in spikes]
    if sum(sizes) < FEWEST_CLIPPED or max(sizes) < UNLIKE * min(sizes) or top >= _limit(saturation, full):
        return []
    told = f"{top:.4g}" + (f" ({round(top * full)} of {full})" if full else "")
    return [f"saturation: many readings of {len(at)} images are {told}, and none is above: they are clipped there, and are taken for light "
            f"that was measured: give saturation {np.floor(top * 1e5) / 1e5:.5g}"]


def _reaches_around(mask: np.ndarray) -> bool:
    """Return whether a mask has the border of its image and leaves out what lies within, as that of all but the object does."""
    border = np.ones(mask.shape, dtype=bool)
    border[1:-1, 1:-1] = False
    left_out = mask.size - int(mask.sum())
    if mask[border].mean() < AROUND or left_out < LEFT_OUT * mask.size:
        return False
    parts, _ = ndimage.label(~mask)
    return bool((~mask & ~np.isin(parts, np.unique(parts[border]))).sum() >= WITHIN * left_out)


def _turned_mask(capture: Capture, mask: np.ndarray, peaks: Peaks) -> list[str]:
    """Return the sentence for a mask of all but the object, by some pixels of it and of what it leaves out in each frame of the peaks."""
    correction, seen = Correction.of(capture), list[list[np.ndarray]]()
    sides = [(places, correction.at(places)) for places in (evenly(np.flatnonzero(side), PIXELS) for side in (mask, ~mask))]
    for image, frame in peaks.frames.items():
        recorded, light = capture.recorded(image), frame.light
        peaks.note(image, recorded)
        assert isinstance(light, DistantLight | PointLight)
        strength = np.array(light.irradiance if isinstance(light, DistantLight) else light.intensity, np.float32)
        strength[strength == 0] = np.inf  # a channel without light shows nothing
        flat = recorded.reshape(-1, 3)
        seen.append([at.corrected(flat[places][:, None], frame)[:, 0] / strength @ np.array(GREY_WEIGHTS) for places, at in sides])
    inside, outside = map(np.stack, zip(*seen, strict=True))
    dark = np.median(inside.max(axis=0)) < DARK * np.median(outside.max(axis=0))
    flat_inside = _shape(inside) < PLANE and _shape(outside) > SHAPED * _shape(inside)
    return [f"mask: it reaches all around the image and leaves out what is within, which is {'brighter' if dark else 'no plane'}: if that "
            "is the object, it is the mask of the background: invert it"] if dark or flat_inside else []


def _shape(readings: np.ndarray) -> float:
    """Return the median residual of pixels [frames, pixels] that would all face one way."""
    length = np.linalg.norm(readings, axis=0)
    if not length.any():
        return 0.0
    shade = readings[:, length > 0] / length[length > 0]
    return float(np.median(np.linalg.norm(shade - np.median(shade, axis=1, keepdims=True), axis=0)))
