"""Which frames follow a moving subject, and between which two of them each other frame lies.

Frames follow each other in time as they do in the manifest, at even steps.
"""

from typing import NamedTuple

from stage.capture import Capture
from stage.errors import ManifestError
from stage.light import FullLight
from stage.manifest import FILE_NAME, Frame

SIDE_MIN_PX, SIDE_MAX_PX = 16, 32766
"""Of the image: two of the search's patches each way, and what OpenCV can address."""
EXTRAPOLATION = 1.0
"""How far a frame may lie before the first tracking frame or after the last, in tracking intervals: the subject is taken to move
on as it did, which is a guess that one interval bounds."""


class Tracking(NamedTuple):
    """The tracking frames of a capture, in order of time."""

    frames: tuple[Frame, ...]
    times: tuple[int, ...]
    """Of each: its place in the manifest."""
    reference: int
    """Which of `frames` shows the common time."""


class Interval(NamedTuple):
    """What lies between two neighbouring tracking frames."""

    first: int
    """Of the two tracking frames, the earlier; the other is the next."""
    lights: tuple[int, ...]
    """Frames of the stack, by their place in it."""
    fractions: tuple[float, ...]
    """When each was taken: 0 at the first tracking frame, 1 at the next; below 0 or above 1 only outside all of them."""


def tracking_frames(capture: Capture, *, to: str | None = None) -> Tracking:
    """The frames that every light lit.

    Args:
        capture: an opened capture.
        to: image of the tracking frame that shows the common time; None: the middle one, the later of two.

    Raises:
        ManifestError: fewer than two, or `to` is none of them, or the image is too small or too large to be followed.
    """
    where = capture.folder / FILE_NAME
    times = tuple(index for index, frame in enumerate(capture.manifest.frames) if isinstance(frame.light, FullLight))
    if len(times) < 2:
        raise ManifestError(f"{where}: frames: {len(times)} lit by a full light: --align follows the subject through "
                            "two or more such tracking frames")
    width, height = capture.camera.resolution
    if min(width, height) < SIDE_MIN_PX or max(width, height) > SIDE_MAX_PX:
        raise ManifestError(f"{where}: camera.resolution: is {width}x{height}: --align needs {SIDE_MIN_PX} to {SIDE_MAX_PX} "
                            "pixels each way")
    frames = tuple(capture.manifest.frames[time] for time in times)
    names = [frame.image for frame in frames]
    if to is not None and to not in names:
        raise ManifestError(f"{where}: frames: {to} is no tracking frame: --align-to takes one of {', '.join(names)}")
    return Tracking(frames, times, len(frames) // 2 if to is None else names.index(to))


def intervals(capture: Capture, tracking: Tracking, frames: list[Frame]) -> list[Interval]:
    """The frames of a stack by the interval they lie in, intervals outward from the reference: first later, then earlier ones.

    Raises:
        ManifestError: a frame lies too far outside the tracking frames; names it.
    """
    time_of = {frame.image: time for time, frame in enumerate(capture.manifest.frames)}
    members: list[list[tuple[int, float]]] = [[] for _ in tracking.times[1:]]
    for light, frame in enumerate(frames):
        time = time_of[frame.image]
        first = max(0, sum(t <= time for t in tracking.times[:-1]) - 1)
        begin, end = tracking.times[first : first + 2]
        fraction = (time - begin) / (end - begin)
        if not -EXTRAPOLATION <= fraction <= 1 + EXTRAPOLATION:
            side = "before the first" if fraction < 0 else "after the last"
            raise ManifestError(f"{capture.folder / FILE_NAME}: frames[{time}]: lies more than one tracking interval {side} "
                                "tracking frame, too far to say where the subject was")
        members[first].append((light, fraction))
    order = [*range(tracking.reference, len(members)), *reversed(range(tracking.reference))]
    return [Interval(first, tuple(light for light, _ in members[first]), tuple(part for _, part in members[first]))
            for first in order]
