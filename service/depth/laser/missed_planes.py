"""Frames of a sweep that are missing, doubled or in another order: from one frame to the next a stripe moves as far as their planes do.

On a smooth surface the stripe of a line moves by about the same part of the way of its plane from frame to frame. Where it moves twice as
far between two of them on nearly all lines, or not at all, the images are not those of the planes from there on. An edge of depth makes
the stripe jump by any part, and rarely in the same two frames on most lines.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from kernels.status import Status
from kernels.structured.stripe import plane_depths
from service.depth.laser.stripe_map import StripeSamples, plane_cuts
from stage.capture.camera import Camera
from stage.capture.light import LaserPlane

AROUND = 2
"""Steps on either side with which a step is compared, those of the same line."""
LEAST_LINES = 16
"""Number of lines that must tell a step."""
NEAR, AGREEING = 0.5, 0.75
"""Distance from the median, as a part of it or of one step, within which this part of the lines must move."""
WHOLE = 0.15
"""Largest distance of the median from a whole number of steps, as a part of it or of one step."""
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
    lines = 1 + max((int(part.line.max()) for part in samples if len(part.line)), default=-1)
    if len(samples) < 2 * AROUND + 2 or lines < LEAST_LINES:
        return []
    deep = np.concatenate([part.depth[part.depth > 0] for part in samples])
    middle_m = float(np.median(deep)) if len(deep) else 1.0
    place, cut = np.full((2, len(samples), lines), np.nan)
    for number, part in enumerate(samples):
        seen = (part.status == Status.OK) & np.isfinite(part.place)
        place[number, part.line[seen]] = part.place[seen]
        cut[number, part.line[seen]] = plane_cuts(part.line[seen], part.place[seen], planes[number : number + 1], np.zeros(seen.sum(), int),
                                                  camera, middle_m, along=along)
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
        steps, size = round(middle), max(1.0, abs(middle))
        if steps != 1 and abs(middle - steps) < WHOLE * size and (np.abs(part - middle) < NEAR * size).mean() > AGREEING:
            found.append(Misstep(number + 1, steps))
    return [] if len(found) == 1 and found[0].planes < 0 else found  # as where a second stripe is taken for the first in one frame


def widen_missed(samples: Sequence[StripeSamples], planes: Sequence[LaserPlane], steps: Sequence[Misstep], camera: Camera, *,
                 along: str) -> list[StripeSamples]:
    """Add to the deviations of each frame's samples what the planes by which it may lie aside make of their depths."""
    aside = np.zeros(len(samples), int)
    for step in steps:
        aside[step.frame :] += step.planes - 1
    likely = [value for value, count in zip(*np.unique(aside, return_counts=True), strict=True) if count >= SHARE * len(aside)]
    widened = []
    for number, part in enumerate(samples):
        away = max((abs(int(aside[number]) - int(value)) for value in likely), default=0)
        other = planes[number + away if number + away < len(planes) else max(number - away, 0)]
        u, v = (part.place, part.line + 0.5) if along == "row" else (part.line + 0.5, part.place)
        x, y = camera.plane_at(u.astype(np.float64), v.astype(np.float64))
        with np.errstate(invalid="ignore"):
            off = np.abs(plane_depths(x, y, np.array(other.point_m), np.array(other.normal), along=along).depth - part.depth)
        widened.append(part._replace(sigma=np.where((part.depth > 0) & (away > 0), np.hypot(part.sigma, np.nan_to_num(off)), part.sigma)))
    return widened


def missed_sentence(steps: Sequence[Misstep], images: Sequence[str]) -> str:
    """Return what is said of frames that are out of step; `images`: of the frames of the sweep."""
    first = steps[0]
    moves = "does not move" if first.planes == 0 else f"moves {first.planes} planes on" if first.planes > 0 else (
        f"moves {-first.planes} planes back")
    more = f", and {len(steps) - 1} more such steps" if len(steps) > 1 else ""
    return (f"frames[].laser: from {images[first.frame - 1]} to {images[first.frame]} the stripe {moves} where their planes are one apart"
            f"{more}: frames are missing, doubled or in another order; the standard deviations hold what that makes of the depths")
