"""Frames of a sweep that are missing, doubled or in another order: from one frame to the next a stripe moves as far as their planes do.

On a smooth surface the stripe of a line moves by about the same part of the way of its plane from frame to frame. Where it moves twice as
far between two of them on nearly all lines, or not at all, the images are not those of the planes from there on. An edge of depth makes
the stripe jump by any part, and rarely in the same two frames on most lines.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from kernels.status import Status
from service.depth.laser.stripe_map import StripeSamples, plane_cuts
from stage.capture.camera import Camera
from stage.capture.light import LaserPlane

AROUND = 2
"""Steps on either side with which a step is compared, those of the same line."""
LEAST_LINES = 16
"""Number of lines that must tell a step."""
NEAR, AGREEING = 0.5, 0.75
"""Distance from the median, in steps, within which this part of the lines must move."""
WHOLE = 0.15
"""Largest distance of the median from a whole number of steps, in steps. As a part of the median it took three steps and a half for
four: of 160 simulated right sweeps, half of them over plates and pillars with upright edges, 23 were told, now 6; of as many with a frame
missing, doubled or exchanged 86 to 95 % were, now 78 to 93 %."""
SHARE = 0.1
"""Part of the frames that lie equally many planes aside, from which on they may be the ones that are right."""


class Misstep(NamedTuple):
    """A step of the stripe that is not the step of its plane."""

    frame: int
    """The frame that it ends in, among those of one sweep."""
    planes: int
    """By how many planes the stripe moves in it."""


def missteps(samples: Sequence[StripeSamples], planes: Sequence[LaserPlane], camera: Camera, *, along: str) -> list[Misstep]:
    """Return the steps at which a sweep of planes is out of step with its images.
    `samples`, `planes`: of each frame whose stripe crosses the same lines, in order."""
    if len(samples) < 2 * AROUND + 2:
        return []
    whole = StripeSamples.joined(samples)
    seen = (whole.status == Status.OK) & np.isfinite(whole.place)
    whole, frame = whole.where(seen), np.repeat(np.arange(len(samples)), [len(part.line) for part in samples])[seen]
    place, cut = np.full((2, len(samples), int(whole.line.max(initial=0)) + 1), np.nan)
    place[frame, whole.line] = whole.place
    cut[frame, whole.line] = plane_cuts(whole, frame, planes, camera, along=along)
    with np.errstate(divide="ignore", invalid="ignore"):
        moved = np.diff(place, axis=0) / np.diff(cut, axis=0)
    found = []
    for number in range(len(moved)):
        around = moved[max(number - AROUND, 0) : number + AROUND + 1]
        told = np.isfinite(moved[number]) & (np.isfinite(around).sum(axis=0) >= AROUND + 1)
        if told.sum() < LEAST_LINES:
            continue
        part = moved[number, told] / np.nanmedian(around[:, told], axis=0)
        middle = float(np.median(part))
        steps = round(middle)
        if steps != 1 and abs(middle - steps) < WHOLE and (np.abs(part - middle) < NEAR).mean() > AGREEING:
            found.append(Misstep(number + 1, steps))
    return [] if len(found) == 1 and found[0].planes < 0 else found  # as where a second stripe is taken for the first in one frame


def widen_missed(samples: Sequence[StripeSamples], planes: Sequence[LaserPlane], steps: Sequence[Misstep], camera: Camera, *,
                 along: str) -> list[StripeSamples]:
    """Add to the deviations of each frame's samples what the planes by which it may lie aside make of their depths."""
    aside = np.zeros(len(samples), int)
    for step in steps:
        aside[step.frame :] += step.planes - 1
    likely = [value for value, count in zip(*np.unique(aside, return_counts=True), strict=True) if count >= SHARE * len(aside)]
    widened = list(samples)
    for number, part in enumerate(samples):
        away = max((abs(int(aside[number]) - int(value)) for value in likely), default=0)
        if away:
            other = planes[number + away if number + away < len(planes) else max(number - away, 0)]
            widened[number] = part.widened(part.depth_change(other, camera, along=along))
    return widened


def missed_sentence(steps: Sequence[Misstep], images: Sequence[str]) -> str:
    """Return what is said of frames that are out of step; `images`: of the frames of the sweep."""
    first = steps[0]
    moves = "does not move" if first.planes == 0 else f"moves {first.planes} planes on" if first.planes > 0 else (
        f"moves {-first.planes} planes back")
    more = f", and {len(steps) - 1} more such steps" if len(steps) > 1 else ""
    return (f"frames[].laser: from {images[first.frame - 1]} to {images[first.frame]} the stripe {moves} where their planes are one apart"
            f"{more}: frames are missing, doubled or in another order, or an edge of depth lies along the stripe there; the standard "
            "deviations hold what missing frames make of the depths")
