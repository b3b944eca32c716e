"""Describe each captured frame: its light in words and numbers, how bright it is, and a small picture of it."""

import math
import os
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import OpenImageIO as oiio

from service.reporting.progress import Timings
from service.viewing.reduction import block_sums, plane_means, step_within
from stage.capture.capture import Capture
from stage.capture.light import DistantLight, PointLight
from stage.capture.lighting import has_placeholders, lights_from_centre
from stage.capture.manifest import LIT_BY, Frame
from stage.colour.colour import convert
from stage.errors import ImageError, StageError, storage
from stage.files import replacing
from stage.formats.images import pixels_of, write_jpeg
from stage.results.light_basis import numbers
from stage.stack.correction import Correction
from stage.stack.ingest import BYTES_PER_PIXEL, DECODE_BYTES

PREVIEW_PIXELS = 144 * 144
"""Most pixels of the reduced image of a frame, from which its thumbnail and the exposure are taken."""
WHITE_PERCENTILE = 99.0
"""The percentile of the object's brightest channel that is shown as white."""
DARK_SHARE = 0.01
"""A pixel counts as dark where its brightest channel is below this share of white."""
UNMEASURED = "a light that nobody has measured"
"""The label of a placeholder."""
POLARISER = {"none": "", "cross": ", crossed polariser", "parallel": ", parallel polariser"}
"""Words for the polariser of the camera in the label of a light."""


class FrameImage(NamedTuple):
    """One frame, made small."""

    preview: np.ndarray  # [rows, cols, 3] float32, scene-linear; mean over the object's pixels of each block
    mean: np.ndarray  # [3] float64, over the mask
    saturated: float
    """Share of the mask, 0…1."""


class CaptureImages(NamedTuple):
    """All frames of a capture, made small."""

    images: list[FrameImage | None]
    """One for each frame of the manifest; None: it cannot be read."""
    faults: list[str]
    """Reasons why frames cannot be read."""
    inside: np.ndarray  # [rows, cols] bool of the previews: blocks with a pixel of the object
    measured: list[bool]
    """True for frames that are measurements, and not ambient light, a tracking frame or a photograph under an environment."""

    @property
    def usable(self) -> bool:
        """Return whether all measurements can be read."""
        return all(image is not None for image, measured in zip(self.images, self.measured, strict=True) if measured)

    @property
    def white(self) -> float:
        """Return the radiance of white: a percentile of the brightest channel of the mean image; 0 where everything is dark."""
        shown = [image.preview for image, measured in zip(self.images, self.measured, strict=True) if image is not None and measured]
        return max(0.0, white_of(np.asarray(np.mean(shown, axis=0, dtype=np.float64)), self.inside)) if shown else 0.0


def white_of(radiance: np.ndarray, inside: np.ndarray) -> float:
    """Return the radiance that is shown as white: a percentile of the brightest channel of those pixels; 0 without any."""
    return float(np.percentile(radiance[inside].max(axis=-1), WHITE_PERCENTILE)) if inside.any() else 0.0


def read_images(capture: Capture, mask: np.ndarray, timings: Timings) -> CaptureImages:
    """Decode every frame of a capture once."""
    frames = capture.manifest.frames
    sources = {frame.image for frame in capture.sources()}
    measured = [not sources or frame.image in sources for frame in frames]
    timings.stage("frames", len(frames))
    step, weight = step_within(mask.size, PREVIEW_PIXELS), mask.astype(np.float32)
    counted = block_sums(weight[..., None], step)
    inside = counted[..., 0] > 0
    try:
        correction = Correction.of(capture, full_scale=True)
    except StageError as error:
        return CaptureImages([None] * len(frames), [str(error)], inside, measured)

    def small(frame: Frame) -> FrameImage | str:
        try:
            pixels, saturated = _radiance(capture, correction, frame)
        except StageError as error:
            return str(error)
        sums = block_sums(pixels, step, weight)
        return FrameImage(np.divide(sums, counted, out=np.zeros_like(sums), where=counted > 0),
                          sums.sum(axis=(0, 1), dtype=np.float64) / mask.sum(),
                          0.0 if saturated is None else float((saturated & mask).sum() / mask.sum()))

    images: list[FrameImage | None] = []
    faults = []
    workers = max(1, min(os.cpu_count() or 1, DECODE_BYTES // (BYTES_PER_PIXEL * math.prod(capture.image_resolution))))
    with ThreadPoolExecutor(workers, thread_name_prefix="relit-view") as pool:
        for image in pool.map(small, frames):
            faults += [image] if isinstance(image, str) else []
            images.append(None if isinstance(image, str) else image)
            timings.advance(len(images))
    return CaptureImages(images, faults, inside, measured)


def one_frame(capture: Capture, found: CaptureImages, mask: np.ndarray, side: int) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the radiance [rows, cols, 3] of the brightest measured frame, its longer side at most `side` pixels, and the coverage
    [rows, cols] of the object; None: no frame can be read."""
    means = {index: image.mean.sum() for index, (image, measured) in enumerate(zip(found.images, found.measured, strict=True))
             if image is not None and measured}
    if not means:
        return None
    frame = capture.manifest.frames[max(means, key=lambda index: float(means[index]))]
    radiance, _ = _radiance(capture, Correction.of(capture, full_scale=True), frame)
    step, weight = -(-max(mask.shape) // side), mask.astype(np.float32)
    counted = block_sums(weight[..., None], step)
    sums = block_sums(radiance, step, weight)
    return np.divide(sums, counted, out=np.zeros_like(sums), where=counted > 0), plane_means(weight, step)


def describe_frames(capture: Capture, found: CaptureImages, thumbnails: list[list[int] | None],
                    suspects: dict[str, str]) -> list[dict[str, Any]]:
    """Return what view.json says of every frame: its place in the atlas of thumbnails, and a sentence where its light is suspect."""
    centre, unmeasured = _centre_lights(capture), has_placeholders(capture)
    white = found.white
    described = []
    for frame, image, place in zip(capture.manifest.frames, found.images, thumbnails, strict=True):
        direction, irradiance = centre.get(frame.image, (None, None))
        brightest = None if image is None else image.preview[found.inside].max(axis=-1)
        described.append({
            "image": frame.image, "kind": kind_of(frame),
            "label": UNMEASURED if unmeasured and frame.light is not None else label_of(frame),
            "direction": None if direction is None else numbers(direction),
            "near": isinstance(frame.light, PointLight),
            "irradiance": None if irradiance is None else numbers(irradiance),
            "exposure_s": frame.exposure_s,
            "saturated": None if image is None else round(image.saturated, 6),
            "dark": None if brightest is None else round(float((brightest < DARK_SHARE * white).mean()), 6) if white > 0 else 1.0,
            "mean": None if image is None else numbers(image.mean),
            "thumbnail": place,
            "suspect": suspects.get(frame.image),
        })
    return described


def kind_of(frame: Frame) -> str:
    """Return which of `LIT_BY` a frame has."""
    return next(name for name in LIT_BY if getattr(frame, name) is not None)


def label_of(frame: Frame) -> str:
    """Return what lit a frame, in a few words."""
    if isinstance(frame.light, DistantLight):
        return f"distant light, {_angles(np.array(frame.light.direction))}{POLARISER[frame.light.polarization]}"
    if isinstance(frame.light, PointLight):
        return "near light at {:.3g}, {:.3g}, {:.3g} m".format(*frame.light.position_m) + POLARISER[frame.light.polarization]
    if frame.stereo is not None:
        return f"texture, {1 + len(frame.stereo.images)} cameras"
    source = getattr(frame, kind_of(frame))
    facts = source.model_dump(mode="json", exclude_defaults=True)
    first = facts.pop("type", None) or facts.pop("code", "")
    short = [f"{name.removesuffix('_px')} {value}" if name != "axis" else str(value)
             for name, value in facts.items() if isinstance(value, str | int | float) and not isinstance(value, bool)]
    short += [name for name, value in facts.items() if value is True]
    return ", ".join([f"{first} {kind_of(frame)}" if kind_of(frame) != "tof" else f"time of flight {first}", *short])


def _angles(direction: np.ndarray) -> str:
    """Return a direction in words: degrees up or down, and to the right or left of the camera, as pages say of their light."""
    azimuth = np.degrees(np.arctan2(direction[0], direction[2]))
    elevation = np.degrees(np.arcsin(np.clip(direction[1] / np.linalg.norm(direction), -1, 1)))
    return f"{abs(elevation):.0f}° {'down' if elevation < 0 else 'up'}, {abs(azimuth):.0f}° to the {'left' if azimuth < 0 else 'right'}"


def _centre_lights(capture: Capture) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Return direction and irradiance at the object's centre of every distant or point light by its image; none where they are
    placeholders."""
    if has_placeholders(capture):
        return {}
    try:
        lights = lights_from_centre(capture)
        return {frame.image: (direction, irradiance)
                for frame, direction, irradiance in zip(capture.sources(), lights.direction, lights.irradiance, strict=True)}
    except StageError:  # lights of other kinds among them, or near ones without a scale: the distant ones are known all the same
        return {frame.image: (np.array(light.direction), np.array(light.irradiance)) for frame, light in capture.lit_by(DistantLight)}


def _radiance(capture: Capture, correction: Correction, frame: Frame) -> tuple[np.ndarray, np.ndarray | None]:
    """Return [rows, cols, 3] radiance of a frame, and which pixels saturate; of an array of a time-of-flight camera, its sum."""
    path = capture.file(frame.image)
    if path.suffix.lower() != ".npy":
        return correction.apply(frame)
    shape = capture.image_resolution[::-1]
    try:
        with storage("read", path):
            values = np.load(path, mmap_mode="r")
    except (ValueError, EOFError) as error:
        raise ImageError(f"{path}: is no array that NumPy reads") from error
    if values.shape[:2] != shape or values.ndim not in (2, 3) or values.dtype.kind not in "fiu":
        raise ImageError(f"{path}: has the shape {values.shape}: expected {shape} with or without bins")
    plane = capture.part_of(np.concatenate(list(_row_sums(values))))
    if not np.isfinite(plane).all():
        raise ImageError(f"{path}: holds values that are not finite")
    return np.repeat(plane[..., None], 3, axis=-1), None


def _row_sums(values: np.ndarray) -> Iterator[np.ndarray]:
    """Yield the sums over the bins, some rows at a time."""
    for row in range(0, len(values), 64):
        part = np.abs(values[row : row + 64].astype(np.float32))
        yield part if part.ndim == 2 else part.sum(axis=2)


CELL = 96
"""Longer side of a picture, pixels."""
MOST_BYTES = 2_000_000
"""Largest file; the quality of the JPEG is lowered until it is reached."""
QUALITIES = (88, 75, 60, 40, 20, 5)


def write_thumbnails(path: Path, found: CaptureImages, space: str) -> list[list[int] | None]:
    """Write the sheet, and return where the picture of each frame lies in it: x, y, width and height, or None where there is none."""
    shown = [image for image in found.images if image is not None]
    rows, cols = found.inside.shape
    height, width = (max(1, round(CELL * side / max(rows, cols))) for side in (rows, cols))
    across = max(1, math.ceil(math.sqrt(len(shown) * height / width)))
    down = max(1, -(-len(shown) // across))
    sheet = np.zeros((down * height, across * width, 3), dtype=np.float32)
    white = _white(found)
    places: list[list[int] | None] = []
    for image in found.images:
        if image is None:
            places.append(None)
            continue
        row, col = divmod(sum(place is not None for place in places), across)
        places.append([col * width, row * height, width, height])
        sheet[row * height : (row + 1) * height, col * width : (col + 1) * width] = fit(image.preview, height, width)
    encoded = convert(np.clip(sheet / white, 0, 1) if white > 0 else sheet, space, "srgb_texture")
    bytes_ = np.rint(255 * np.clip(encoded, 0, 1)).astype(np.uint8)
    for quality in QUALITIES:
        with replacing(path) as temporary:
            write_jpeg(temporary, bytes_, quality, subsampled=True)
        if path.stat().st_size <= MOST_BYTES:
            break
    return places


def _white(found: CaptureImages) -> float:
    """Return the radiance of white: the median over the frames of a percentile of each, so that one bright frame does not darken all."""
    lit = [white for image in found.images if image is not None and (white := white_of(image.preview, found.inside)) > 0]
    return float(np.median(lit)) if lit else 0.0


def fit(preview: np.ndarray, height: int, width: int) -> np.ndarray:
    """Return a picture [rows, cols, 3] with another size."""
    source = oiio.ImageBuf(np.ascontiguousarray(preview, dtype=np.float32))
    return pixels_of(oiio.ImageBufAlgo.resize(source, "triangle", roi=oiio.ROI(0, width, 0, height, 0, 1, 0, 3)))
