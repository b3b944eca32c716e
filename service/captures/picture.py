"""A picture of what was understood of a capture: lights on the dome, or frames in their order; mask, saturation and histogram."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import OpenImageIO as oiio

from service.captures.frame_views import BINS, STOPS, CaptureView, FrameView
from service.light.sheet import BACKGROUND, INK, display, fit
from stage.capture import Capture
from stage.colour_spaces import linear_space
from stage.errors import StageError
from stage.files import replacing
from stage.images import write_png
from stage.lighting import has_placeholders, lights_from_centre

Colour = tuple[float, float, float]
"""Red, green and blue as they are displayed, 0…1."""
SIZE = 960
"""The side of the dome, pixels."""
SIDE, MARGIN, LINE = 460, 24, 20
"""The width of what stands beside the dome, the space around everything, and the height of a line of text, pixels."""
LARGEST, SMALLEST = 150, 16
"""The most and the least rows of the image of a light."""
REACH = (SIZE - LARGEST) / 2
"""The distance of the widest light from the middle, pixels."""
MOST_FRAMES = 100
"""The most frames that are shown in their order; of more, evenly spaced ones are."""
MOST_LINES = 12
"""The most sentences below the picture."""
RED, GREY, DIM = (0.95, 0.2, 0.15), (0.45, 0.47, 0.5), (0.2, 0.21, 0.23)
EXPOSURE_PERCENTILE, EXPOSURE_TARGET = 99.0, 0.8
"""This percentile of the readings becomes this value before the display transform, alike in all frames."""


class _Canvas:
    """An image that pictures, lines and texts are put on."""

    def __init__(self, height: int, width: int) -> None:
        self.pixels = np.empty((height, width, 3), np.float32)
        self.pixels[:] = BACKGROUND
        self._texts: list[tuple[int, int, str, Colour]] = []

    def put(self, top: int, left: int, image: np.ndarray, frame: Colour | None = None, width: int = 2) -> None:
        """Put an image [rows, cols, 3] with a frame around it; what is beyond the edge is cut."""
        if frame is not None:
            image = np.pad(image, ((width, width), (width, width), (0, 0)))
            image[:width], image[-width:], image[:, :width], image[:, -width:] = frame, frame, frame, frame
            top, left = top - width, left - width
        rows, cols = self.pixels.shape[:2]
        image = image[max(-top, 0) : rows - top, max(-left, 0) : cols - left]
        top, left = max(top, 0), max(left, 0)
        self.pixels[top : top + image.shape[0], left : left + image.shape[1]] = image

    def circle(self, row: float, col: float, radius: float, colour: Colour, width: float = 1.0) -> None:
        """Draw a circle."""
        y, x = np.ogrid[: self.pixels.shape[0], : self.pixels.shape[1]]
        self.pixels[np.abs(np.hypot(y - row, x - col) - radius) <= width / 2] = colour

    def text(self, top: int, left: int, words: str, colour: Colour = INK, *, ground: bool = False) -> None:
        """Write a line of text whose letters stand on `top`; with `ground` what is below it is covered."""
        if ground:
            self.pixels[max(top - 14, 0) : max(top + 4, 0), max(left - 2, 0) : max(left + 9 * len(words), 0)] = BACKGROUND
        self._texts.append((left, top, words, colour))

    def write(self, path: Path) -> None:
        """Write the image as a PNG."""
        buffer = oiio.ImageBuf(self.pixels)
        for left, top, words, colour in self._texts:
            oiio.ImageBufAlgo.render_text(buffer, left, top, words, 15, "", colour)
        with replacing(path) as temporary:
            write_png(temporary, np.asarray(buffer.get_pixels(oiio.UINT8)), srgb=True)


def write_picture(path: Path, capture: Capture, view: CaptureView, suspects: Mapping[str, float], sentences: Sequence[str]) -> None:
    """Write the picture of a capture.

    Args:
        path: the PNG.
        capture: an opened capture.
        view: its frames.
        suspects: lights that disagree with the others, by their images; they are red.
        sentences: written below it, the first of them.

    Raises:
        StorageError: the picture cannot be written.
    """
    lines = [line for sentence in sentences[:MOST_LINES] for line in _wrapped(sentence, (SIZE + SIDE) // 8)]
    canvas = _Canvas(SIZE + LINE * (len(lines) + 2) + 2 * MARGIN, SIZE + SIDE + 3 * MARGIN)
    canvas.text(MARGIN, MARGIN, f"{capture.name}: {len(view.frames)} frames of {capture.camera.width}x{capture.camera.height}, "
                                f"{capture.manifest.color_space}")
    directions = _directions(capture)
    images = _shown([each.image for each in view.frames], view, capture)
    if directions:
        _dome(canvas, view.frames, images, directions, suspects)
    else:
        _in_order(canvas, view.frames, images)
    _beside(canvas, capture, view)
    for number, line in enumerate(lines):
        canvas.text(SIZE + 2 * MARGIN + LINE * (number + 1), MARGIN, line, RED if line.startswith(("wrong", "finding")) else INK)
    canvas.write(path)


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


def _shown(images: Sequence[np.ndarray | None], view: CaptureView, capture: Capture) -> list[np.ndarray]:
    """Return images as they are displayed, alike exposed; crossed where there is none."""
    there = [image for image in images if image is not None]
    if not there:
        return [_crossed(1.0)] * len(images)
    if view.signed:
        low, high = np.percentile(np.stack(there), [1, 99])
        return [_crossed(1.0) if image is None else np.clip((image - low) / max(high - low, 1e-12), 0, 1) for image in images]
    level = float(np.percentile(np.stack(there), EXPOSURE_PERCENTILE))
    gain, space = EXPOSURE_TARGET / level if level > 0 else 1.0, linear_space(capture.manifest.color_space)
    together = display(np.concatenate([np.maximum(image, 0) * np.float32(gain) for image in there]), space)
    parts = iter(np.split(together, len(there)))
    return [_crossed(there[0].shape[1] / there[0].shape[0]) if image is None else next(parts) for image in images]


def _crossed(aspect: float, rows: int = 64) -> np.ndarray:
    """Return the image of a frame that cannot be read."""
    cols = max(2, round(rows * aspect))
    y, x = np.mgrid[:rows, :cols] / np.array([rows - 1, cols - 1])[:, None, None]
    return np.where((np.minimum(np.abs(x - y), np.abs(x + y - 1)) < 0.04)[..., None], RED, DIM).astype(np.float32)


def _dome(canvas: _Canvas, frames: Sequence[FrameView], images: Sequence[np.ndarray], directions: dict[str, np.ndarray],
          suspects: Mapping[str, float]) -> None:
    """Draw each light where it stands as the camera sees it: the angle from the view axis is the distance from the middle."""
    top, left = MARGIN + LINE, MARGIN
    angle = {image: float(np.degrees(np.arccos(np.clip(way[2], -1, 1)))) for image, way in directions.items()}
    widest = max(*angle.values(), 10.0)  # its image ends at the edge
    step = 30 if widest > 60 else 15 if widest > 30 else 5
    middle = top + SIZE / 2, left + SIZE / 2
    for degrees in range(step, int(min(widest * SIZE / 2 / REACH, 180)) + 1, step):
        radius = degrees / widest * REACH
        canvas.circle(*middle, radius, GREY if degrees == 90 else DIM, 2 if degrees == 90 else 1)
        canvas.text(round(middle[0] + radius) - 6, round(middle[1]) + 4, f"{degrees} degrees", GREY)
    canvas.text(top + 10, left, "the lights as the camera sees them: the view axis is in the middle", GREY)
    places = {}
    for name, way in directions.items():
        outwards = way[:2] / max(float(np.hypot(*way[:2])), 1e-9) * angle[name] / widest * REACH
        places[name] = np.array([middle[0] - outwards[1], middle[1] + outwards[0]])
    points = np.array(list(places.values()))
    apart = np.linalg.norm(points[:, None] - points, axis=-1) + np.diag(np.full(len(points), np.inf))
    nearest = float(np.median(apart.min(axis=1))) if len(points) > 1 else SIZE / 3
    rows = int(np.clip(nearest, SMALLEST, LARGEST))
    order = sorted((index for index, each in enumerate(frames) if each.frame.image in places),
                   key=lambda index: frames[index].frame.image in suspects)
    for index in order:
        name = frames[index].frame.image
        image = fit(images[index], max(4, round(rows * min(1.0, images[index].shape[0] / images[index].shape[1]))), kernel="triangle")
        row, col = (round(float(value)) for value in places[name])
        suspect = name in suspects
        canvas.put(row - image.shape[0] // 2, col - image.shape[1] // 2, image, RED if suspect else GREY, 4 if suspect else 1)
        if suspect:
            canvas.text(row - image.shape[0] // 2 - 8, col - image.shape[1] // 2, name, RED, ground=True)


def _in_order(canvas: _Canvas, frames: Sequence[FrameView], images: Sequence[np.ndarray]) -> None:
    """Draw frames in their order, row by row."""
    chosen = np.unique(np.linspace(0, len(frames) - 1, min(MOST_FRAMES, len(frames))).round().astype(int))
    aspect = images[chosen[0]].shape[1] / images[chosen[0]].shape[0]
    across = next(count for count in range(1, len(chosen) + 1)
                  if -(-len(chosen) // count) * ((SIZE / count - 8) / aspect + LINE + 8) <= SIZE or count == len(chosen))
    rows = max(4, int(min((SIZE / across - 8) / aspect, SIZE - LINE)))
    for number, index in enumerate(chosen):
        row, col = divmod(number, across)
        top, left = MARGIN + LINE + row * (rows + LINE + 8) + LINE, MARGIN + col * SIZE // across
        image = fit(images[index], rows, kernel="triangle")[:, : SIZE // across - 8]
        canvas.put(top, left, image)
        frame = frames[index].frame
        words = frame.image.rsplit("/", 1)[-1] + (f", {frame.pattern.describe()}" if frame.pattern is not None else "")
        canvas.text(top - 5, left, words[: max(4, image.shape[1] // 8)], GREY)


def _beside(canvas: _Canvas, capture: Capture, view: CaptureView) -> None:
    """Draw the mask over the mean image, where readings saturate, and their histogram."""
    left, top = SIZE + 2 * MARGIN, MARGIN + LINE
    height = (SIZE - 3 * LINE - 2 * MARGIN) // 3
    rows, cols = view.mask.shape
    tall = max(4, min(height, round(SIDE * rows / cols)))
    mean, = _shown([view.mean], view, capture)
    outside = np.where(view.mask[..., None], mean, 0.35 * mean + 0.25 * np.array((0.1, 0.3, 0.6)))
    share = 100 * view.mask.mean()
    kind = "mean image" if not view.signed else "mean of the frames without their signs"
    canvas.text(top + LINE - 5, left, f"{kind}; blue: outside the mask ({share:.3g} % are inside)")
    canvas.put(top + LINE, left, fit(outside, tall, kernel="triangle"))
    top += height + LINE + MARGIN
    counted = view.saturated[view.mask]
    grey = np.repeat(mean.mean(axis=-1, keepdims=True), 3, axis=-1) * 0.5
    part = np.minimum(view.saturated / max(len(view.frames) / 4, 1), 1)[..., None]
    red = grey * (1 - part) + (0.35 + 0.65 * part) * np.array(RED)
    canvas.text(top + LINE - 5, left, f"saturated in a frame or more: {100 * (counted > 0).mean():.3g} % of the object")
    canvas.put(top + LINE, left, fit(np.where(part > 0, red, grey), tall, kernel="triangle"))
    top += height + LINE + MARGIN
    canvas.text(top + LINE - 5, left, "readings of the object, linear, by stops; red: saturated")
    canvas.put(top + LINE, left, _histogram(np.sum([each.counts for each in view.frames], axis=0), height - LINE))
    for stop in range(STOPS[0], STOPS[1] + 1, 4):
        level = view.unit * 2.0**stop
        words = f"{level:.4g}" if level >= 1 else f"1/{1 / level:.5g}"
        canvas.text(top + LINE + height - 4, left + min(round((stop - STOPS[0]) * 4 / BINS * SIDE), SIDE - 30), words, GREY)


def _histogram(counts: np.ndarray, height: int) -> np.ndarray:
    """Return bars [height, SIDE, 3] of the square roots of counts [2, BINS]: grey unsaturated readings below red saturated ones."""
    top = max(float(counts.sum(axis=0)[1:].max()), 1.0)  # the first bin has the unlit pixels, and may be much higher
    column = np.minimum(np.arange(SIDE) * BINS // SIDE, BINS - 1)
    up = (height - np.arange(height))[:, None] / height
    whole = np.minimum(np.sqrt(counts.sum(axis=0) / top), 1)[column]
    clear = whole * (counts[0] / np.maximum(counts.sum(axis=0), 1))[column]
    image = np.broadcast_to(np.array(DIM) * 0.6, (height, SIDE, 3)).copy()
    image[up <= whole] = RED
    image[up <= clear] = np.array(GREY) * 1.4
    return image


def _wrapped(sentence: str, width: int) -> list[str]:
    """Return the lines of a sentence, each of at most so many characters where its words allow it."""
    lines = [""]
    for word in sentence.split():
        if lines[-1] and len(lines[-1]) + len(word) >= width:
            lines.append("    ")
        lines[-1] += ("" if not lines[-1].strip() else " ") + word
    return lines
