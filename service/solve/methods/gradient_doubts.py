"""What gradient frames of one capture contradict of each other: exposures, black levels, and polarisers that are exchanged.

The two gradients of an axis add up to the full sphere, no gradient is brighter than that, and a crossed analyser passes less than a
parallel one: at every pixel, whatever it reflects.
"""

import numpy as np

from kernels.photometric.model.samples import evenly
from stage.capture.gradients import AXES, GradientFrames
from stage.colour.colour import GREY_WEIGHTS
from stage.stack.stack import Stack

PIXELS = 2000
"""Pixels, spread over the object, that are compared."""
LEAST_OFF = 0.05
"""Least part by which sums of gradients differ from the full frame, or readings exceed what they may: lamps keep their light to a
hundredth or two from frame to frame."""
MANY = 0.5
"""Part of the pixels that contradict: noise of dark pixels alone contradicts less."""


def gradient_doubts(stack: Stack, inside: np.ndarray, frames: GradientFrames) -> list[str]:
    """Return sentences for what the frames contradict of each other. `inside`: [pixels of the image] bool, the mask."""
    pixels = np.flatnonzero(inside)
    if not len(pixels):
        return []
    radiance, usable = stack.pick_radiance(pixels[evenly(len(pixels), PIXELS)])
    grey = (radiance @ GREY_WEIGHTS)[:, usable.all(axis=0)]
    if not grey.shape[1]:
        return []
    found = []
    for rows in (frames.diffuse, frames.parallel):
        if rows is not None and (full := _mean(grey, rows[:, 0] == 1)) is not None:
            found += _against_full(grey, rows, full, stack.frames)
    if frames.parallel is not None:
        cross, parallel = (grey[rows.any(axis=1)].mean(axis=0) for rows in (frames.diffuse, frames.parallel))
        if np.mean(cross > (1 + LEAST_OFF) * parallel) > MANY:
            found.append("frames[].light.polarization: the cross images are brighter than the parallel ones, which have the highlights "
                         "too: check which are which")
    return found


def _mean(grey: np.ndarray, chosen: np.ndarray) -> np.ndarray | None:
    return grey[chosen].mean(axis=0) if chosen.any() else None


def _against_full(grey: np.ndarray, rows: np.ndarray, full: np.ndarray, names: tuple[str, ...]) -> list[str]:
    """Return a sentence if the gradients of rows [frames, 4] contradict the full sphere [pixels]."""
    image = names[int(np.flatnonzero(rows[:, 0] == 1)[0])]
    mend = "check that all frames have one exposure (else give exposure_s) and no black level (else give dark)"
    for axis, name in enumerate(AXES, start=1):
        both = [_mean(grey, sign * rows[:, axis] > 0) for sign in (1, -1)]
        if both[0] is None or both[1] is None:
            continue
        times = float((both[0] + both[1]).sum() / max(full.sum(), 1e-30))
        if abs(times - 1) > LEAST_OFF:
            return [f"frames: the two gradients of axis {name} add up to {times:.2f} times the full frame {image}, in place of 1: {mend}"]
    for number in np.flatnonzero(rows[:, 0] == 0.5):
        if (part := float(np.mean(grey[number] > (1 + LEAST_OFF) * full))) > MANY:
            return [f"frames: {names[number]}, a gradient, is brighter than the full frame {image} at {100 * part:.0f} % of the pixels, "
                    f"which no light makes: {mend}"]
    return []
