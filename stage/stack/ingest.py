"""Ingest of a capture: its images are decoded on a thread pool and written as a stack cache, which is keyed by their content."""

import hashlib
import json
import math
import os
import threading
import zlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from stage.capture.capture import Capture
from stage.capture.light import OffLight
from stage.capture.manifest import Frame
from stage.colour.colour_spaces import BUILT_IN, is_linear, location
from stage.colour.configuration import current
from stage.errors import ManifestError, storage
from stage.files import replacing
from stage.motion.tracking import Tracking
from stage.stack import stack as stacks
from stage.stack import stack_checksums
from stage.stack.align import VERSION, Alignment, Warp
from stage.stack.correction import CodedRadiance, Correction, Radiance
from stage.stack.fingerprint import Fingerprints
from stage.stack.stack import CHANNELS, LIGHT_PAD, PIXEL_PAD, Stack

LAYOUT = 3
"""The version of the cache; a change of the layout or the arithmetic raises it, so that older caches are rebuilt."""
CACHE_FOLDER = ".relit"
"""The folder of the cache inside the folder of a capture."""
ALIGNED = "aligned-"
"""The prefix of the keys of aligned stacks: the cache keeps one aligned stack, and one of the frames as recorded."""
DECODE_BYTES = 2 << 30
"""The bytes that all images which are decoded at one time may take."""
CODED_BYTES_PER_PIXEL, BYTES_PER_PIXEL, ALIGNED_BYTES_PER_PIXEL = 20, 40, 160
"""The bytes of a pixel while its image is looked up in a table (file, codes, a plane to write), while it is corrected (half and float RGB,
masks, planes to write), and while it is warped."""
LOOK_UP_CODES = 1 << 16
"""Codes that are looked up at one time: their positions are half a megabyte, which stays in the second-level cache."""
LARGEST_FACTOR = 126
"""Exponents below this make a factor that is a normal float32, with which a product is exact; `ldexp` takes eight times as long."""
FLOATING = {".exr", ".hdr"}
"""Suffixes of images without integers: no value of theirs is known to be clipped unless the capture says so."""
TOP_EXPONENT = 15
"""The brightest value of a light is stored in [2^14, 2^15): below 65504, the largest half, with 29 stops of normal values."""

FrameProgress = Callable[[int, int], None]
"""A function that is called after every frame with the count of decoded frames and the count of all frames."""


@dataclass(frozen=True)
class Ingest:
    """The light frames of a capture after hashing and before decoding: the key of their stack is known, the stack need not exist."""

    capture: Capture
    frames: list[Frame]
    tracking: Tracking | None
    folder: Path
    """The folder of the cache."""
    hint: str
    """Advice in error messages: the option that names another folder."""
    fingerprints: Fingerprints
    key: str
    """The key of the stack: a hash of everything that the stored values depend on."""

    @classmethod
    def of(cls, capture: Capture, *, cache: Path | None = None, tracking: Tracking | None = None) -> "Ingest":
        """Hash the images of the light frames of a capture.

        Args:
            cache: the folder for the cache; None stands for `.relit` in the folder of the capture.
            tracking: tracking frames, to the reference of which every frame is warped; None leaves the frames as recorded.

        Raises:
            ManifestError: no light lit any frame of the capture.
        """
        frames = capture.sources()
        if not frames:
            raise ManifestError(f"{capture.folder}: frames: none is lit by a distant, point, extended or gradient light")
        folder = cache if cache is not None else capture.folder / CACHE_FOLDER
        fingerprints = Fingerprints(capture.folder, folder / "files.json")
        hint = "" if cache is not None else " (--cache names another folder for it)"
        return cls(capture, frames, tracking, folder, hint, fingerprints, _key(capture, frames, tracking, fingerprints))

    def stack(self, progress: FrameProgress | None = None) -> Stack:
        """Return the stack from the cache, and build it first when the cache does not hold it.

        Args:
            progress: called after every decoded frame, or once with all frames when the cache holds the stack.

        Raises:
            ManifestError: a frame lies too far outside the tracking frames.
        """
        found = stacks.find(self.folder, self.key)
        if found is not None:
            if progress is not None:
                progress(len(self.frames), len(self.frames))
            self.capture.clipped.update(found.clipped)
            return found
        alignment = None if self.tracking is None else Alignment(self.capture, self.tracking, self.frames)
        with storage(f"make the stack cache{self.hint} in", self.folder):
            self.folder.mkdir(parents=True, exist_ok=True)
        built = _build(self.capture, self.frames, alignment, self.folder, self.key, progress)
        self.fingerprints.remember()
        _drop_others(self.folder, self.key)
        return built


def open_stack(capture: Capture, *, cache: Path | None = None, tracking: Tracking | None = None,
               progress: FrameProgress | None = None) -> Stack:
    """Return the stack of the light frames of a capture, as `Ingest.of` and `Ingest.stack` do."""
    return Ingest.of(capture, cache=cache, tracking=tracking).stack(progress)


def _key(capture: Capture, frames: list[Frame], tracking: Tracking | None, fingerprints: Fingerprints) -> str:
    """Return a hash of everything that the stored values depend on."""
    manifest = capture.manifest
    off = [frame for frame, _ in capture.lit_by(OffLight)]
    corrections = [name for name in (manifest.dark, manifest.flat) if name is not None]
    if manifest.mask is not None and (manifest.flat is not None or tracking is not None):
        corrections.append(manifest.mask)  # the flat and the tracking frames are scaled over the mask
    read = frames + off + ([] if tracking is None else [*tracking.frames])
    images = [frame.image for frame in read]
    inputs = {
        "layout": LAYOUT,
        "resolution": manifest.camera.resolution,
        "color_space": manifest.color_space,
        "saturation": manifest.saturation,
        "exposures": [frame.exposure_s for frame in read],
        "images": images,
        "light_count": len(frames),
        "corrections": [manifest.dark, manifest.flat],
        "content": fingerprints.of([*images, *corrections]),
    }
    if manifest.saturation is None and any(Path(frame.image).suffix.lower() not in FLOATING for frame in frames):
        inputs["saturation"] = "largest integer"
    if manifest.color_matrix is not None:
        inputs["color_matrix"] = manifest.color_matrix
    if any(frame.color_matrix is not None for frame in read):
        inputs["color_matrices"] = [frame.color_matrix for frame in read]
    if location() != BUILT_IN and not is_linear(manifest.color_space):
        inputs["ocio"] = current().label
    if capture.pixels.clip_negative:
        inputs["negative"] = "clipped"
    if capture.pixels.crop is not None:
        inputs["crop"] = capture.pixels.crop
    if tracking is not None:
        time_of = {frame.image: time for time, frame in enumerate(manifest.frames)}
        inputs["align"] = [VERSION, tracking.times, tracking.reference, [time_of[frame.image] for frame in frames]]
    digest = hashlib.blake2b(json.dumps(inputs, sort_keys=True).encode(), digest_size=8).hexdigest()
    return digest if tracking is None else ALIGNED + digest


def _build(capture: Capture, frames: list[Frame], alignment: Alignment | None, folder: Path, key: str,
           progress: FrameProgress | None) -> Stack:
    pixel_count = capture.camera.width * capture.camera.height
    lights, pixels = stacks.padded(len(frames), LIGHT_PAD), stacks.padded(pixel_count, PIXEL_PAD)
    scale = np.zeros(lights, dtype=np.float32)
    saturated = np.zeros((lights // 8, pixels), dtype=np.uint8)
    padding = 2 * (pixels - pixel_count)
    checksums = np.full((CHANNELS, lights), stack_checksums.of_plane(np.zeros(pixel_count, dtype=np.float16), padding))
    correction = Correction.of(capture, full_scale=True)
    done = 0
    lock = threading.Lock()

    values = stacks.values_path(folder, key)
    with replacing(values, flush=False) as temporary, open(temporary, "r+b") as file:  # the index has checksums of all planes
        np.lib.format.write_array_header_1_0(
            file, {"descr": "<f2", "fortran_order": False, "shape": (CHANNELS, lights, pixels)})
        start = file.tell()
        with storage("make the stack cache", values):
            _reserve(file.fileno(), start + 2 * CHANNELS * lights * pixels)

        def take(light: int, warp: Warp | None) -> None:
            nonlocal done
            radiance = correction.coded(frames[light]) if warp is None else warp(light, correction.apply(frames[light]))
            planes, scale[light] = half_planes(radiance)
            for channel, plane in enumerate(planes):
                checksums[channel, light] = stack_checksums.of_plane(plane, padding)
                _write_all(file.fileno(), plane, start + 2 * (channel * lights + light) * pixels)
            with lock:
                if radiance.saturated is not None and radiance.saturated.any():
                    saturated[light // 8, :pixel_count] |= radiance.saturated.reshape(-1).astype(np.uint8) << (light % 8)
                done += 1
                if progress is not None:
                    progress(done, len(frames))

        batches: Iterable[tuple[Sequence[int], Warp | None]] = [(range(len(frames)), None)]
        if alignment is not None:
            batches = alignment.batches(correction)
        bytes_per_pixel = ALIGNED_BYTES_PER_PIXEL
        if alignment is None:
            bytes_per_pixel = CODED_BYTES_PER_PIXEL if correction.has_codes(frames[0]) else BYTES_PER_PIXEL
        workers = max(1, min(os.cpu_count() or 1, DECODE_BYTES // (bytes_per_pixel * math.prod(capture.image_resolution))))
        with ThreadPoolExecutor(workers, thread_name_prefix="relit-ingest") as pool:
            try:
                for batch, warp in batches:
                    for job in [pool.submit(take, light, warp) for light in batch]:
                        job.result()
            except BaseException:
                pool.shutdown(cancel_futures=True)
                raise
    names = tuple(frame.image for frame in frames)
    motion = None if alignment is None else alignment.statistics()
    built = Stack(folder, key, names, scale, pixel_count, motion, clipped=dict(capture.clipped))
    try:
        if saturated.any():
            with replacing(stacks.saturated_path(folder, key)) as temporary:
                np.save(temporary, saturated)
        stacks.write_index(built, checksums.ravel().tolist(), zlib.crc32(saturated.data) if saturated.any() else None)
    except BaseException:
        stacks.remove(folder, key)
        raise
    return built


def half_planes(radiance: Radiance | CodedRadiance) -> tuple[Iterator[np.ndarray], float]:
    """Return the half planes of the channels of an image, [pixels] each, and the radiance of a stored 1.0, a power of two so that half
    images keep their bits."""
    values: np.ndarray
    if isinstance(radiance, CodedRadiance):
        codes, values = radiance.codes, radiance.values
        least, most = int(codes.min()), int(codes.max())
        # where codes are the bits of half values, `most` is the lowest value below zero if there is one, and this the highest
        signed = int(codes.view(np.int16).max()) % len(values) if codes.dtype == np.uint16 else most
        present = values[[least, most, signed]]
    else:
        codes, values = None, radiance.pixels
        present = values
    peak = max(float(present.max()), -float(present.min()))
    exponent = math.frexp(peak)[1] - TOP_EXPONENT if peak else 0

    def planes() -> Iterator[np.ndarray]:
        if codes is None:
            for channel in range(CHANNELS):
                yield _scaled(values[..., channel], exponent).reshape(-1)
            return
        half = _scaled(values, exponent)
        for channel in range(CHANNELS):
            yield _look_up(half, codes[..., channel])

    return planes(), math.ldexp(1.0, exponent)


def _scaled(values: np.ndarray, exponent: int) -> np.ndarray:
    """Return values divided by a power of two as half; those of codes that the image does not have may overflow."""
    factor = np.float32(math.ldexp(1.0, -exponent)) if abs(exponent) < LARGEST_FACTOR else None
    with np.errstate(over="ignore"):
        return (np.ldexp(values, -exponent) if factor is None else values * factor).astype(np.float16)


def _look_up(table: np.ndarray, codes: np.ndarray) -> np.ndarray:
    """Return the entries of a table for codes, [codes], a piece at a time: NumPy makes 64-bit positions of all codes that it is given."""
    flat = np.ascontiguousarray(codes).reshape(-1)
    found = np.empty(len(flat), dtype=table.dtype)
    for first in range(0, len(flat), LOOK_UP_CODES):
        piece = slice(first, first + LOOK_UP_CODES)
        np.take(table, flat[piece], out=found[piece], mode="clip")  # checks of the range would make a copy
    return found


def _write_all(descriptor: int, plane: np.ndarray, offset: int) -> None:
    """Write a plane with pwrite; a full disk is an error here, whereas a write to a mapped file would kill the process."""
    view = memoryview(plane.data).cast("B")
    while view:
        written = os.pwrite(descriptor, view, offset)
        view, offset = view[written:], offset + written


def _reserve(descriptor: int, size: int) -> None:
    """Reserve the space of the stack before the first frame is decoded, so that a full disk is known at once."""
    if hasattr(os, "posix_fallocate"):
        os.posix_fallocate(descriptor, 0, size)
    else:
        os.ftruncate(descriptor, size)


def _drop_others(folder: Path, key: str) -> None:
    """Remove older stacks from the cache: aligned stacks if this stack is aligned, otherwise stacks of the frames as recorded."""
    for index in folder.glob("stack-*.json"):
        old = index.stem.removeprefix("stack-")
        if old != key and old.startswith(ALIGNED) == key.startswith(ALIGNED):
            stacks.remove(folder, old)
