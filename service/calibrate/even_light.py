"""Images of a target under even light, without the laser, by which the images of its stripes are divided."""

import numpy as np

from stage.capture.capture import Capture
from stage.colour.colour import GREY_WEIGHTS
from stage.patterns.base import UniformPattern
from stage.stack.correction import Correction


def uniform(capture: Capture, correction: Correction, code: str) -> np.ndarray | None:
    """Return the frame under a white or black projection, [rows, cols, 3] linear; None: there is none."""
    frames = (frame for frame in capture.manifest.frames if isinstance(frame.pattern, UniformPattern) and frame.pattern.code == code)
    frame = next(frames, None)
    return None if frame is None else correction.apply(frame).pixels


def even_light(capture: Capture, correction: Correction) -> np.ndarray | None:
    """Return the grey of the target, [rows, cols] float32, under a white projection, or else under the light of the room.

    The light of the room is a frame without the laser, or that under a black projection. None: no frame shows the target.
    """
    shown = uniform(capture, correction, "white")
    if shown is None:
        shown = correction.ambient if correction.ambient is not None else uniform(capture, correction, "black")
    return None if shown is None else np.asarray(shown @ np.array(GREY_WEIGHTS, np.float32), dtype=np.float32)
