"""Ingest of a capture: its images are decoded on a thread pool and written as a stack cache, which is keyed by their content."""

import hashlib
import json
import math
import os
import threading
import zlib
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from stage.capture.capture import Capture
from stage.capture.light import OffLight
from stage.capture.manifest import Frame
from stage.colour.colour_spaces import is_linear
from stage.colour.configuration import current
from stage.colour.location import BUILT_IN, location
from stage.errors import ImageError, ManifestError, storage
from stage.files import replacing
from stage.motion.tracking import Interval, Tracking, intervals
from stage.stack import stack as stacks
from stage.stack.correction import Correction, Radiance
from stage.stack.fingerprint import Fingerprints
from stage.stack.peaks import Peaks
from stage.stack.stack import Stack
from stage.stack.stack_file import StackFile

if TYPE_CHECKING:
    from stage.motion.flow import Flow

VERSION = 1
"""The version of the alignment; a change of the arithmetic raises it, so that older caches are rebuilt."""
DARKEST = 0.05
"""The least brightness of a tracking frame relative to another one: a darker frame was not lit by all lights."""
Warp = Callable[[int, Radiance], Radiance]
"""A function from the index of a light in the stack and its corrected image to the aligned image, whose `saturated` is True where no
reading exists."""


class Alignment:
    """The alignment of the frames of a stack, one tracking interval at a time, so that two flows at most are in memory."""

    def __init__(self, capture: Capture, tracking: Tracking, frames: list[Frame]) -> None:
        """Assign the frames of a stack to the intervals between tracking frames."""
        self._tracking = tracking
        self._mask = capture.mask()
        self._intervals = intervals(capture, tracking, frames)
        self._facts: list[tuple[int, dict[str, Any]]] = []
        self._lost: list[int] = []

    def batches(self, correction: Correction) -> Iterator[tuple[tuple[int, ...], Warp]]:
        """Yield the lights of one interval after another with the warp of their images, which several threads may call."""
        from stage.motion import flow  # OpenCV takes 0.15 s to load, which only aligned captures need

        frames, middle = self._tracking.frames, self._tracking.reference
        white: dict[int, float] = {}

        def tracking_image(index: int) -> np.ndarray:
            radiance = correction.apply(frames[index]).pixels
            white[index] = flow.white_level(radiance, self._mask)
            dim, bright = sorted((index, middle), key=lambda one: white[one])
            if white[dim] <= DARKEST * white[bright]:
                path = correction.capture.file(frames[dim].image)
                raise ImageError(f"{path}: is dark inside the mask: a tracking frame shows the subject under every light")
            return flow.display(radiance, white[index])  # each frame by its own white level, because flashes differ

        reference = tracking_image(middle)
        still = flow.Flow(np.zeros((*self._mask.shape, 2), np.float32), np.ones(self._mask.shape, bool))
        last, later = still, True
        for interval in self._intervals:
            if later and interval.first < middle:  # now backwards in time from the reference
                last, later = still, False
            guess = None if last is still else flow.extrapolate(last, self._mask)
            previous, last = last, flow.find_flow(reference, tracking_image(interval.first + later), guess)
            begin, end = (previous, last) if later else (last, previous)
            self._note(interval, begin, end)
            yield interval.lights, self._warp(interval, begin, end)

    def statistics(self) -> dict[str, Any]:
        """Return the statistics for the report, when all batches are done."""
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
FLOATING = {".exr", ".hdr"}
"""Suffixes of images without integers: no value of theirs is known to be clipped unless the capture says so."""

FINGERPRINTS = "files.json"
"""The file of the content hashes in the folder of the cache."""

FrameProgress = Callable[[int, int], None]
"""A function that is called after every frame with the count of decoded frames and the count of all frames."""


class Begun(Protocol):
    """A stack that was begun before all its images were there; stage.stack.early has it."""

    def take(self, ingest: "Ingest", path: Path) -> tuple[StackFile, set[int], dict[str, Any]] | None:
        """Move the file to a path; return it, the lights whose planes are those of the frames, and kept peaks; None: it is of no use."""


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
    def of(cls, capture: Capture, *, cache: Path | None = None, tracking: Tracking | None = None,
           progress: Callable[[float], None] = lambda _: None) -> "Ingest":
        """Hash the images of the light frames of a capture.
        `cache`: the folder for the cache; None stands for `.relit` in the folder of the capture. `tracking`: tracking frames, to the
        reference of which every frame is warped; None leaves the frames as recorded. `progress`: called with the fraction of the files that
        are hashed. Raises ManifestError if no light lit any frame of the capture."""
        frames = capture.sources()
        if not frames:
            raise ManifestError(capture.none_is_lit("a distant, point, extended or gradient light"))
        folder = cache if cache is not None else capture.folder / CACHE_FOLDER
        fingerprints = Fingerprints(capture.folder, folder / FINGERPRINTS, progress)
        hint = "" if cache is not None else " (--cache names another folder for it)"
        return cls(capture, frames, tracking, folder, hint, fingerprints, stack_key(capture, frames, tracking, fingerprints))

    def stack(self, progress: FrameProgress | None = None, early: "Begun | None" = None) -> Stack:
        """Return the stack from the cache, and build it first when the cache does not hold it.
        `progress`: called after every decoded frame, or once with all frames when the cache holds the stack. `early`: images that were
        decoded when they came; its file becomes that of the stack. Raises ManifestError if a frame lies too far outside the tracking
        frames."""
        found = stacks.find(self.folder, self.key)
        if found is not None:
            if progress is not None:
                progress(len(self.frames), len(self.frames))
            self.capture.clipped.update(found.clipped)
            return found
        alignment = None if self.tracking is None else Alignment(self.capture, self.tracking, self.frames)
        with storage(f"make the stack cache{self.hint} in", self.folder):
            self.folder.mkdir(parents=True, exist_ok=True)
        built = _build(self, alignment, early if self.tracking is None else None, progress)
        self.fingerprints.remember()
        _drop_others(self.folder, self.key)
        return built


def open_stack(capture: Capture, *, cache: Path | None = None, tracking: Tracking | None = None,
               progress: FrameProgress | None = None) -> Stack:
    """Return the stack of the light frames of a capture, as `Ingest.of` and `Ingest.stack` do."""
    return Ingest.of(capture, cache=cache, tracking=tracking).stack(progress)


def stack_key(capture: Capture, frames: list[Frame], tracking: Tracking | None, fingerprints: Fingerprints) -> str:
    """Return a hash of everything that the stored values of frames depend on."""
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


def _build(ingest: Ingest, alignment: Alignment | None, early: Begun | None, progress: FrameProgress | None) -> Stack:
    capture, frames, folder, key = ingest.capture, ingest.frames, ingest.folder, ingest.key
    pixel_count = capture.camera.width * capture.camera.height
    with replacing(stacks.values_path(folder, key), flush=False) as temporary:  # the index has checksums of all planes
        begun = None if early is None else early.take(ingest, temporary)
        if begun is None:
            with storage("make the stack cache", stacks.values_path(folder, key)):
                begun = StackFile(temporary, len(frames), pixel_count), set(), {}
        file, there, noted = begun
        (peaks := Peaks(capture)).recall(noted)
        with closing(file):
            _write(file, replace(Correction.of(capture, full_scale=True), note=peaks.note), frames, alignment, there, progress)
    motion = None if alignment is None else alignment.statistics()
    return _complete(ingest, file, motion, peaks.kept())


def _write(file: StackFile, correction: Correction, frames: list[Frame], alignment: Alignment | None, there: Collection[int],
           progress: FrameProgress | None) -> None:
    """Decode the frames whose planes are not there yet."""
    lock, done = threading.Lock(), len(there)

    def take(light: int, warp: Warp | None) -> None:
        nonlocal done
        file.write(light, correction.coded(frames[light]) if warp is None else warp(light, correction.apply(frames[light])))
        with lock:
            done += 1
            if progress is not None:
                progress(done, len(frames))

    batches: Iterable[tuple[Sequence[int], Warp | None]] = [([light for light in range(len(frames)) if light not in there], None)]
    if alignment is not None:
        batches = alignment.batches(correction)
    bytes_per_pixel = ALIGNED_BYTES_PER_PIXEL
    if alignment is None:
        bytes_per_pixel = CODED_BYTES_PER_PIXEL if correction.has_codes(frames[0]) else BYTES_PER_PIXEL
    workers = max(1, min(os.cpu_count() or 1, DECODE_BYTES // (bytes_per_pixel * math.prod(correction.capture.image_resolution))))
    with ThreadPoolExecutor(workers, thread_name_prefix="relit-ingest") as pool:
        try:
            for batch, warp in batches:
                for job in [pool.submit(take, light, warp) for light in batch]:
                    job.result()
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise


def _complete(ingest: Ingest, file: StackFile, motion: dict[str, Any] | None, peaks: dict[str, Any]) -> Stack:
    """Write the saturation bits and the index of a stack whose values are in place."""
    folder, key, camera = ingest.folder, ingest.key, ingest.capture.camera
    built = Stack(folder, key, tuple(frame.image for frame in ingest.frames), file.scale, camera.width * camera.height, motion,
                  clipped=dict(ingest.capture.clipped), peaks=peaks)
    marked = bool(file.saturated.any())
    try:
        if marked:
            with replacing(stacks.saturated_path(folder, key)) as temporary:
                np.save(temporary, file.saturated)
        stacks.write_index(built, file.checksums.ravel().tolist(), zlib.crc32(file.saturated.data) if marked else None)
    except BaseException:
        stacks.remove(folder, key)
        raise
    return built


def _drop_others(folder: Path, key: str) -> None:
    """Remove older stacks from the cache: aligned stacks if this stack is aligned, otherwise stacks of the frames as recorded."""
    for index in folder.glob("stack-*.json"):
        old = index.stem.removeprefix("stack-")
        if old != key and old.startswith(ALIGNED) == key.startswith(ALIGNED):
            stacks.remove(folder, old)
