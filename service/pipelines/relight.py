"""Capture and environment → frames: the linear combination of the captured images."""

import os
import re
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

import numpy as np

from kernels import device as devices
from kernels import packs
from kernels.relight.batch import combine_batch
from kernels.relight.combine import combine
from kernels.relight.environment import integrate_cells, light_weights
from service.errors import RequestError
from service.progress import Progress, Timings
from service.provenance import metadata
from service.requests import RelightRequest
from stage import exr, images
from stage.capture import Capture
from stage.colour import convert, linear_space
from stage.errors import ImageError
from stage.frames import rotation_about_y
from stage.ingest import open_stack
from stage.light import PointLight
from stage.lighting import lights_from_centre
from stage.motion.tracking import tracking_frames
from stage.stack import Stack

CHUNK_BYTES = 512 << 20
"""Of finished half frames that are held at one time: bounds the memory of a long range."""
ENVIRONMENT_SUFFIXES = {".exr", ".hdr"}
HALF_MAX = 65504.0
MAX_FRAMES = 100_000
"""Over an hour of film; more is a slip of the finger that would fill the memory before the first frame."""


class RelightResult(NamedTuple):
    """What a relight made."""

    frames: tuple[Path, ...]
    clipped: int
    """Pixels above the largest half value, stored as that value."""
    near_lights: int
    """Point lights that were taken as distant ones, as the object's centre sees them."""


def relight(request: RelightRequest, progress: Progress | None = None) -> RelightResult:
    """Relight a capture.

    Args:
        request: capture, environment, frames and where to put them.
        progress: told of every stage.

    Raises:
        RequestError: a bad frame range, a pattern without ####, or a frame that would replace an input.
        StageError, KernelError: bad input; names file and field.
        StorageError: a frame cannot be written; frames already there are whole.
    """
    timings = Timings(progress)
    device = devices.resolve(request.device)
    numbers = frame_numbers(request.frames)
    paths = [frame_path(request.out, number) for number in numbers]
    timings.stage("open", 1)
    capture = Capture.open(request.capture)
    lights = lights_from_centre(capture)
    near = len(capture.lit_by(PointLight))
    tracking = tracking_frames(capture, to=request.align_to) if request.aligned else None
    space = linear_space(capture.manifest.color_space)
    environment = read_environment(request.environment, space)
    inputs = {request.environment.resolve(), *(capture.file(name).resolve() for _, name in capture.files())}
    for path in paths:
        if path.resolve() in inputs:
            raise RequestError(f"--out {request.out}: {path} is an input: choose another folder or name")
    timings.stage("ingest", len(capture.sources()))
    stack = open_stack(capture, cache=request.cache, tracking=tracking, progress=lambda done, _: timings.advance(done))
    timings.stage("weights", len(numbers))
    turns = [request.spin_degrees * i / len(numbers) for i in range(len(numbers))]
    weights = np.zeros((len(numbers), 3, stack.shape[1]), dtype=np.float32)
    for index, degrees in enumerate(turns):
        cells = integrate_cells(environment, lights.direction, rotation_about_y(degrees)[None], device=device)
        weights[index] = light_weights(cells, lights.irradiance, stack.scale)[0]
        timings.advance(index + 1)
    timings.stage("frames", len(numbers))
    provenance = metadata(request, capture=capture.name, inputs=stack.key)
    if near:
        provenance["relit:lights"] = f"{near} near lights taken as distant, as the object's centre sees them"
    clipped = written = 0
    for chunk, frames in _combine_chunks(stack, weights, device):
        clipped += int((frames > HALF_MAX).any(axis=1).sum())
        half = np.minimum(frames, HALF_MAX).astype(np.float16).reshape(
            len(frames), 3, -1)[:, :, : stack.pixel_count].reshape(len(frames), 3, capture.camera.height, capture.camera.width)

        def write(item: tuple[int, np.ndarray]) -> None:
            index, pixels = item
            attributes = {**provenance, "relit:frame": str(numbers[index]), "relit:turn_degrees": f"{turns[index]:.6g}"}
            exr.write(paths[index], dict(zip("RGB", pixels, strict=True)), color_space=space, metadata=attributes)

        with ThreadPoolExecutor(os.cpu_count() or 1, thread_name_prefix="relit-write") as pool:
            for _ in pool.map(write, zip(chunk, half, strict=True)):
                written += 1
                timings.advance(written)
    timings.close()
    return RelightResult(tuple(paths), clipped, near)


def frame_numbers(text: str) -> list[int]:
    """`7` or `1-24` as numbers.

    Raises:
        RequestError: not that form, backwards, or more than MAX_FRAMES.
    """
    match = re.fullmatch(r"(\d+)(?:-(\d+))?", text.strip())
    if match is None:
        raise RequestError(f"--frames {text}: give a number, or first-last such as 1-24")
    first = int(match[1])
    last = int(match[2]) if match[2] is not None else first
    if last < first:
        raise RequestError(f"--frames {text}: runs backwards: give {last}-{first}")
    if last - first >= MAX_FRAMES:
        raise RequestError(f"--frames {text}: asks for {last - first + 1} frames: {MAX_FRAMES} at most in one run")
    return list(range(first, last + 1))


def frame_path(pattern: str, number: int) -> Path:
    """The pattern with its run of # replaced by the number, padded with zeros to the run's length.

    Raises:
        RequestError: no run of # in the file name, several, or a suffix other than .exr.
    """
    folder, name = os.path.split(pattern)
    runs = re.findall(r"#+", name)
    if len(runs) != 1 or "#" in folder:
        raise RequestError(f"--out {pattern}: the file name needs one run of # for the frame number, such as frame.####.exr")
    if not name.lower().endswith(".exr"):
        raise RequestError(f"--out {pattern}: frames are OpenEXR: end the name in .exr")
    return Path(folder) / name.replace(runs[0], f"{number:0{len(runs[0])}d}")


def read_environment(path: Path, space: str) -> np.ndarray:
    """Read a lat-long map into a working space.

    Returns:
        [rows, cols, 3] float32 scene-linear radiance.

    Raises:
        ImageError: not EXR or HDR, not twice as wide as high, or impossible values (counted).
    """
    if path.suffix.lower() not in ENVIRONMENT_SUFFIXES:
        raise ImageError(f"{path}: an environment is a lat-long .exr or .hdr")
    header = images.read_header(path)
    if header.width != 2 * header.height:
        raise ImageError(f"{path}: is {header.width}x{header.height}: a lat-long map is twice as wide as high")
    pixels = images.read_pixels(path).astype(np.float32)
    images.check_radiance(path, pixels)
    given = exr.color_space_of(exr.read_header(path).metadata) if path.suffix.lower() == ".exr" else "lin_rec709_scene"
    try:
        converted = convert(pixels, given, space)
    except ValueError as error:
        raise ImageError(f"{path}: {error}") from error
    return np.maximum(converted, 0)  # a colour outside the working space's gamut has a negative channel


def _combine_chunks(stack: Stack, weights: np.ndarray, device: str) -> Iterator[tuple[range, np.ndarray]]:
    """(frame indices, [frames, 3, pixels padded] float32) for as many frames at a time as memory allows."""
    channels, _, pixels = stack.shape
    size = max(1, CHUNK_BYTES // (4 * channels * pixels))
    for begin in range(0, len(weights), size):
        chunk = range(begin, min(begin + size, len(weights)))
        frames = np.empty((len(chunk), channels, pixels), dtype=np.float32)
        for start, stop in stack.bands(4 * channels * len(chunk)):
            band = packs.upload(stack.band(start, stop), device=device)
            if len(chunk) == 1:
                frames[0, :, start:stop] = combine(band, weights[begin]).numpy()
            else:
                frames[:, :, start:stop] = combine_batch(band, weights[chunk.start : chunk.stop]).numpy()
        yield chunk, frames
