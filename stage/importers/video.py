"""Frames of a video file as images of a capture, decoded by OpenCV."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from stage.errors import ManifestError, storage
from stage.files import replacing
from stage.formats.images import write_png

SUFFIXES = {".avi", ".m4v", ".mkv", ".mov", ".mp4", ".mpg", ".mxf", ".webm", ".wmv"}
LOSSLESS = {"FFV1", "FFVH", "HFYU", "ULRG", "ULRA"}
"""Codes of codecs that keep all values."""


class FrameRange(NamedTuple):
    """The range of frames of a video that are used, counted from 0."""

    first: int
    last: int | None
    """The last one, included; None: that of the video."""
    step: int
    option: str = "--video-frames"
    """The option that says it."""

    @classmethod
    def parse(cls, text: str, option: str = "--video-frames") -> "FrameRange":
        """Return the range that a text such as 12-600:6 says: first, last and step."""
        span, _, step = text.partition(":")
        first, dash, last = span.partition("-")
        if not (first.isdecimal() and (last.isdecimal() or not last) and (step.isdecimal() or not step)) or (dash and not last):
            raise ManifestError(f"{option} {text}: give first, last and step, such as 12-600:6, 12-600 or 12")
        found = cls(int(first), int(last) if last else None, int(step or 1), option)
        if found.step < 1 or (found.last is not None and found.last < found.first):
            raise ManifestError(f"{option} {text}: goes backwards or nowhere: give first, last and step, such as 12-600:6")
        return found


class VideoFrames(NamedTuple):
    """The images that were made of a video."""

    folder: Path
    sentence: str
    """A sentence for the user that says which frames were read."""
    assumed: tuple[str, ...]
    """Sentences for the entry `assumed` of the manifest."""
    rate: float | None
    """Frames of the video a second; None: it does not say."""


def is_video(path: Path) -> bool:
    """Return whether the suffix of a path is that of a video."""
    return path.suffix.lower() in SUFFIXES


def unpack(video: Path, folder: Path, frames: FrameRange) -> VideoFrames:
    """Write frames of a video as PNG images of 8 bits, named by their numbers, after all of them were found readable.
    `folder`: of the images; those that are there already are replaced. Raises ManifestError if the file is no video that OpenCV decodes, or
    it ends before the last frame."""
    with _opened(video) as capture:
        code = int(capture.get(cv2.CAP_PROP_FOURCC))
        rate = capture.get(cv2.CAP_PROP_FPS) or None
        codec = "".join(chr(code >> shift & 255) for shift in (0, 8, 16, 24)).strip("\0 ") or "unknown codec"
        count = 0
        while (frames.last is None or count <= frames.last) and capture.grab():
            count += 1
    last = count - 1 if frames.last is None else frames.last
    if count <= last or last < frames.first:
        raise ManifestError(f"{video}: has {count} frames, 0 to {count - 1}, and {frames.option} asks for {frames.first} to "
                            f"{max(last, frames.first)}")
    numbers = range(frames.first, last + 1, frames.step)
    with storage("write", folder):
        folder.mkdir(parents=True, exist_ok=True)
    with _opened(video) as capture:
        for number in range(last + 1):
            if number not in numbers:
                capture.grab()
                continue
            read, picture = capture.read()
            if not read or picture.dtype != np.uint8:
                raise ManifestError(f"{video}: frame {number} cannot be decoded to 8 bits")
            target = folder / f"{video.stem}_{number:06d}.png"
            with storage("write", target), replacing(target) as temporary:
                write_png(temporary, picture[..., ::-1] if picture.ndim == 3 else picture, srgb=True)
    sentence = f"{len(numbers)} of {count if frames.last is None else 'its'} frames, {numbers[0]} to {numbers[-1]}, {codec}"
    if codec.upper() in LOSSLESS:
        return VideoFrames(folder, f"{sentence}, lossless", (), rate)
    return VideoFrames(folder, f"{sentence}, compressed", (
        f"images: are frames of a compressed video ({codec}, 8 bits): fine stripes and dark places are coarser than the camera saw them, "
        "their noise is not that of a camera, and colours have half the resolution in most videos",), rate)


@contextmanager
def _opened(video: Path) -> Iterator[cv2.VideoCapture]:
    with storage("read", video):
        video.open("rb").close()
    capture = cv2.VideoCapture(str(video))
    try:
        if not capture.isOpened():
            raise ManifestError(f"{video}: is no video that OpenCV decodes")
        yield capture
    finally:
        capture.release()
