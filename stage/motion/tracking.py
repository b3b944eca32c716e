"""The tracking frames of a capture, and the intervals between them in which its other frames lie.

The frames of a manifest are taken to be in order of time, at equal time steps.
"""

from typing import NamedTuple

from stage.capture.capture import Capture
from stage.capture.light import FullLight
from stage.capture.manifest import FILE_NAME, Frame
from stage.errors import ManifestError

SIDE_MIN_PX, SIDE_MAX_PX = 16, 32766
"""The least side of an image, two patches of the flow search, and the largest side, which OpenCV can address."""
EXTRAPOLATION = 1.0
"""The tracking intervals that a frame may lie before the first or after the last tracking frame: the motion of the subject is
extrapolated there."""


class Tracking(NamedTuple):
    """The tracking frames of a capture, in order of time."""

    frames: tuple[Frame, ...]
    times: tuple[int, ...]
    """The index of each tracking frame in the manifest."""
    reference: int
    """The index in `frames` of the tracking frame to whose time all frames are aligned."""


class Interval(NamedTuple):
    """The frames between two consecutive tracking frames."""

    first: int
    """The index of the earlier tracking frame; the later one is the next."""
    lights: tuple[int, ...]
    """The indices of the frames in the stack."""
    fractions: tuple[float, ...]
    """The time of each frame, from 0 at the earlier to 1 at the later tracking frame; outside all tracking frames below 0 or above 1."""


def tracking_frames(capture: Capture, *, to: str | None = None) -> Tracking:
    """Return the tracking frames of a capture, which all lights lit.
    `to`: the image of the tracking frame to align to; None stands for the middle one, and the later of two middle ones. Raises
    ManifestError if there are fewer than two, `to` is none of them, or the images are too small or too large for optical flow."""
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
    """Return the intervals with their frames of a stack: from the reference on in time, then from the reference backwards."""
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
