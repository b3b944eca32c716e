"""A picture of what was understood of a capture: lights on the dome, or frames in their order; mask, saturation and histogram."""

import os
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

import numpy as np

from service.relight.sheet import BACKGROUND, display, display_gain, dome_places, fit, write_sheet
from stage.capture.capture import Capture
from stage.capture.lighting import has_placeholders, lights_from_centre
from stage.capture.manifest import Frame
from stage.colour.colour_spaces import Review, linear_space
from stage.errors import StageError
from stage.stack.correction import Correction
from stage.tof.raw_frames import read_frame

SIZE = 720
"""The side of the dome, and the height of what stands beside it, pixels."""
TILE, ACROSS = 240, 6
"""The height of frames that are shown in their order, pixels, and how many stand side by side."""
LARGEST, SMALLEST = 120, 12
"""The most and the least rows of the image of a light."""
REACH = (SIZE - LARGEST) / 2
"""The distance of the widest light from the middle of the dome, pixels."""
RING_DEGREES = 30
"""The angle from one ring of the dome to the next."""
MOST_FRAMES = 60
"""The most frames that are shown in their order; of more, evenly spaced ones are."""
THUMBNAIL = 160
"""The rows of the small images that are kept of the frames."""
RED, GREY, DIM = (0.95, 0.2, 0.15), (0.45, 0.47, 0.5), (0.2, 0.21, 0.23)
STOPS = (-16, 8)
"""The range of the histogram, in powers of two of its unit."""
BINS = 4 * (STOPS[1] - STOPS[0])
"""The bins of the histogram, a quarter of a stop each; the first has darker readings and 0 too, the last brighter ones."""


class _Views(NamedTuple):
    """The frames of a capture, made small, and their sums."""

    images: list[np.ndarray | None]  # [rows, cols, 3] scene-linear, the part around the object; None: cannot be read
    counts: np.ndarray  # [2, BINS] unsaturated and saturated readings of the object
    mask: np.ndarray  # [rows, cols] bool
    mean: np.ndarray  # [rows, cols, 3] float32, mean of the frames, of time of flight without their signs
    saturated: np.ndarray  # [rows, cols] in how many frames each pixel is saturated


def write_picture(path: Path, capture: Capture, peak: float, suspects: Mapping[str, float], review: Review,
                  done: Callable[[int], None]) -> None:
    """Write the picture of a capture.
    `suspects`: lights that disagree with the others, by their images; they are red. `done`: called with the count of frames that have been
    read."""
    unit = 1.0 if peak <= 2.0 ** STOPS[1] else 2.0 ** (np.ceil(np.log2(peak)) - STOPS[1])
    views = _read(capture, unit, done)
    images, (mean,) = _shown(views.images, capture, review), _shown([views.mean], capture, review)
    inside, hit = views.mask[..., None], views.saturated[views.mask] > 0
    part = np.minimum(views.saturated / max(len(images) / 4, 1), 1)[..., None]
    over = np.where(part > 0, (0.35 + 0.65 * part) * np.array(RED), mean.mean(axis=-1, keepdims=True) * 0.5)
    mask = f"mask: {100 * views.mask.mean():.3g} % inside", np.where(inside, mean, 0.35 * mean + 0.25 * np.array((0.1, 0.3, 0.6)))
    saturated = f"saturated: {100 * hit.mean():.3g} % of the object", over
    histogram = f"readings, log, {unit * 2.0 ** STOPS[0]:.3g} to {unit * 2.0 ** STOPS[1]:.3g}", _histogram(views.counts)
    directions = _directions(capture)
    if directions:
        dome = f"lights as the camera sees them, {RING_DEGREES} degrees from ring to ring", _dome(capture, images, directions, suspects)
        write_sheet(path, [[dome, mask], [saturated, histogram]], height=SIZE)
        return
    chosen = np.unique(np.linspace(0, len(images) - 1, min(MOST_FRAMES, len(images))).round().astype(int))
    tiles = [(_title(capture.manifest.frames[index], images[index]), images[index]) for index in chosen]
    write_sheet(path, [[mask, saturated, histogram], *(tiles[begin:begin + ACROSS] for begin in range(0, len(tiles), ACROSS))], height=TILE)


def _read(capture: Capture, unit: float, done: Callable[[int], None]) -> _Views:
    """Read every frame; `unit` is that of the histogram."""
    mask, correction = capture.mask(), Correction.of(capture, full_scale=True)
    rows, cols = (np.flatnonzero(mask.any(axis=axis)) for axis in (1, 0))
    around = slice(rows[0], rows[-1] + 1), slice(cols[0], cols[-1] + 1)
    views = _Views([], np.zeros((2, BINS), int), mask, np.zeros((*mask.shape, 3), np.float32), np.zeros(mask.shape, np.int32))

    def read(frame: Frame) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray] | None:
        try:
            if frame.tof is None:
                pixels, over = correction.apply(frame)
            else:
                values, over = read_frame(capture, frame), None
                grey = values if values.shape == mask.shape else values.sum(axis=1).reshape(mask.shape)
                pixels = np.repeat(np.nan_to_num(grey)[..., None], 3, axis=-1).astype(np.float32)
        except StageError:
            return None
        over = np.zeros(mask.shape, bool) if over is None else over
        level = np.abs(pixels[mask]).max(axis=-1) * ((frame.exposure_s or 1.0) / unit)
        bins = np.clip((np.log2(np.maximum(level, 2.0 ** STOPS[0])) - STOPS[0]) * 4, 0, BINS - 1).astype(int)
        counts = np.stack([np.bincount(bins[over[mask] == which], minlength=BINS) for which in (False, True)])
        return fit(pixels[around], THUMBNAIL, kernel="triangle"), counts, pixels, over

    with ThreadPoolExecutor(min(4, os.cpu_count() or 1), thread_name_prefix="relit-picture") as pool:
        for found in pool.map(read, capture.manifest.frames):
            views.images.append(None if found is None else found[0])
            for total, values in zip((views.counts, views.mean, views.saturated), found[1:] if found is not None else (), strict=False):
                total += np.abs(values)
            done(len(views.images))
    return views._replace(mean=views.mean / max(sum(image is not None for image in views.images), 1))


def _directions(capture: Capture) -> dict[str, np.ndarray]:
    """Return the direction of the light of each frame by its image; nothing where there are no distant or point lights."""
    if has_placeholders(capture):
        return {}
    try:
        lights = lights_from_centre(capture)
    except StageError:
        return {}
    lit = [frame for frame in capture.sources() if frame.light is not None and frame.light.type in ("distant", "point")]
    return {frame.image: direction for frame, direction in zip(lit, lights.direction, strict=True)}


def _shown(images: Sequence[np.ndarray | None], capture: Capture, review: Review) -> list[np.ndarray]:
    """Return images as they are displayed, alike exposed; crossed where there is none."""
    there = [image for image in images if image is not None]
    if not there:
        return [_crossed(1.0)] * len(images)
    if any(frame.tof is not None for frame in capture.manifest.frames):  # correlations have both signs
        low, high = np.percentile(np.stack(there), [1, 99])
        parts = iter([np.clip((image - low) / max(high - low, 1e-12), 0, 1) for image in there])
    else:
        gain = np.float32(display_gain(np.stack(there)))
        together = np.concatenate([np.maximum(image, 0) * gain for image in there])
        parts = iter(np.split(display(together, linear_space(capture.manifest.color_space), review), len(there)))
    return [_crossed(there[0].shape[1] / there[0].shape[0]) if image is None else next(parts) for image in images]


def _crossed(aspect: float) -> np.ndarray:
    y, x = np.meshgrid(np.linspace(0, 1, THUMBNAIL), np.linspace(0, 1, max(2, round(THUMBNAIL * aspect))), indexing="ij")
    return np.where((np.minimum(np.abs(x - y), np.abs(x + y - 1)) < 0.04)[..., None], RED, DIM).astype(np.float32)


def _dome(capture: Capture, images: Sequence[np.ndarray], directions: Mapping[str, np.ndarray],
          suspects: Mapping[str, float]) -> np.ndarray:
    """Return each light where it stands as the camera sees it: the angle from the view axis is the distance from the middle."""
    towards = np.array(list(directions.values()))
    widest = max(float(np.degrees(np.arccos(np.clip(towards[:, 2].min(), -1, 1)))), 10.0)  # its image ends at the edge
    y, x = np.ogrid[:SIZE, :SIZE]
    radius, step = np.hypot(y - SIZE / 2, x - SIZE / 2), RING_DEGREES * REACH / widest
    nearest = step * np.clip((radius / step).round(), 1, 180 // RING_DEGREES)
    dome = np.where((np.abs(radius - nearest) < 0.6)[..., None], DIM, BACKGROUND)
    points = dome_places(towards, side=SIZE, reach=REACH, widest_degrees=widest)
    places = dict(zip(directions, points, strict=True))
    apart = np.linalg.norm(points[:, None] - points, axis=-1) + np.diag(np.full(len(points), np.inf))
    rows = float(np.clip(np.median(apart.min(axis=1)) if len(points) > 1 else SIZE / 3, SMALLEST, LARGEST))
    shown = [(frame.image, image) for frame, image in zip(capture.manifest.frames, images, strict=True) if frame.image in places]
    for name, image in sorted(shown, key=lambda each: each[0] in suspects):
        image = fit(image, max(4, round(rows * min(1.0, image.shape[0] / image.shape[1]))), kernel="triangle")
        edge, colour = (4, RED) if name in suspects else (1, GREY)
        image = np.where(np.pad(np.ones((*image.shape[:2], 1), bool), ((edge, edge), (edge, edge), (0, 0))),
                         np.pad(image, ((edge, edge), (edge, edge), (0, 0))), colour)
        top, left = (round(float(place - side / 2)) for place, side in zip(places[name], image.shape[:2], strict=True))
        part = dome[max(top, 0):top + image.shape[0], max(left, 0):left + image.shape[1]]
        part[:] = image[max(-top, 0):max(-top, 0) + part.shape[0], max(-left, 0):max(-left, 0) + part.shape[1]]
    return dome


def _title(frame: Frame, image: np.ndarray) -> str:
    """Return what is written above a frame, as much of its end as its width has room for: names of frames begin alike."""
    words = frame.image.rsplit("/", 1)[-1] + (f", {frame.pattern.describe()}" if frame.pattern is not None else "")
    return words[-max(4, TILE * image.shape[1] // image.shape[0] // 8):]


def _histogram(counts: np.ndarray) -> np.ndarray:
    """Return bars of the square roots of counts [2, BINS], as an image: grey unsaturated readings below red saturated ones."""
    total = counts.sum(axis=0)
    whole = np.minimum(np.sqrt(total / max(float(total[1:].max()), 1.0)), 1)  # the first bin has the unlit pixels, and may be much higher
    column = np.arange(SIZE) * BINS // SIZE
    up = 1 - np.arange(SIZE)[:, None] / SIZE
    image = np.where((up <= whole[column])[..., None], RED, np.array(DIM) * 0.6)
    return np.where((up <= (whole * counts[0] / np.maximum(total, 1))[column])[..., None], np.array(GREY) * 1.4, image)
