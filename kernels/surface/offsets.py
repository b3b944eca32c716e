"""Estimate the distances between the parts of a surface along the view, from the cast shadows that readings show.

An offset of a part is judged by the log-likelihood of all readings: log(1 + H (e^q - 1)), where q are the log odds that the reading lies in
shadow and H is the probability that the surface at that offset hides the light: 1 where the ray passes through the visible front, and less
where it is behind it all along its way. H is a step function of the offset with three steps, so one pass over the
readings gives the likelihood at all offsets.

Neighbouring readings err alike: the shape of a part errs, and highlights and bounced light are not known exactly. So neither the curvature
of the likelihood nor its height can be taken at face value. The lights are divided into groups by their direction, each of which throws
shadows on other places and tells more or less. The loss that each group is expected to have at an offset, if the best one is true, follows
from the readings whose shadow changes; what the losses deviate from their common ratio to it is their error (the ratio estimator of
Cochran, Sampling Techniques, 1977, chapter 6). The offset is left open between all values that the groups together do not contradict by
twice this error, and σ is at least that of leaving a group out in turn (the jackknife of Quenouille and Tukey).

A part moves along the lines of sight. The ray from a pixel to a distant light keeps its path in the image while a part moves, whether the
pixel lies on that part or on another. So along the path only the gap between the ray and the surface changes, everywhere by
the same amount: the offset in z of an orthographic camera, and in -log depth of a perspective one, where a part moves by growing about the
eye. The largest and the smallest gap therefore tell at which offsets the surface stands before the ray, and at which the whole
surface on the way lies in front of it.

A ray that passes through the visible front of a part is hidden. One that lies behind that front all along its way may pass behind the part.
Nothing tells how thick a part is; the guess is that its back is its front mirrored in its outline.
"""

from itertools import pairwise
from typing import NamedTuple

import numpy as np
import warp as wp

from kernels import device as devices
from kernels.device import to_numpy
from kernels.errors import ArrayError
from kernels.surface.shadows import (
    FIRST_STEP,
    MARGIN_PIXELS,
    MARGIN_SLOPE,
    Camera,
    Projection,
    between_pixels,
    pixel_span,
    project,
    surface_point,
)

OUTLINE_0, OUTLINE_1, OUTLINE_2 = 1.875, -1.25, 0.375
"""Weights of the last three gaps for that at the outline, which lies half a step farther on in the mean: the parabola through them. Flat
parts have their largest and smallest gaps there; round ones have them elsewhere, and are too steep at the outline."""
NO_GAP = -1.0e30
"""Stands for the largest gap where the path never crosses the surface that moves against the pixel."""
AROUND = 2.0
"""Pixels around the box of a part within which a path is followed: far more than rounding moves it."""
STEEP = 0.01
"""Motion in the picture, for a unit of length at unit distance, below which rounding may turn a path: it is followed in any case."""


class PartShadows(NamedTuple):
    """Gaps between the surface and the ray from each pixel to each light."""

    highest: wp.array  # [pixels, lights] float32: largest height of the surface above the ray, over all of it that moves against the pixel
    lowest: wp.array  # [pixels, lights] float32: the least
    back: wp.array  # [pixels, lights] float32: least height of the guessed back above the ray
    opening: wp.array  # [pixels, lights] vec2: gaps, between the lowest and the highest, at which the ray passes through a hole; 0, 0: none
    hidden: wp.array  # [pixels, lights] uint8: whether surface that moves with the pixel hides the light, whatever the offset; 0 where the
    # path passes by the part that moves


@wp.func
def _passes_by(start: wp.vec3, way: wp.vec3, camera: Camera, u: float, v: float, box: wp.vec4i) -> bool:
    """Return whether the picture of the line from a point at (u, v) never comes near a box of pixels."""
    far = wp.where(camera.perspective, -start[2], 1.0)
    turn = wp.where(camera.perspective, way[2], 0.0) / far
    across, up = way[0] + start[0] * turn, way[1] + start[1] * turn
    if across * across + up * up < STEEP * STEEP:
        return False
    right, down = camera.scale[0] * across, -camera.scale[1] * up
    right, down = wp.where(right == 0.0, 1.0e-20, right), wp.where(down == 0.0, 1.0e-20, down)
    left_at, right_at = (float(box[1]) - AROUND - u) / right, (float(box[3]) + 1.0 + AROUND - u) / right
    upper_at, lower_at = (float(box[0]) - AROUND - v) / down, (float(box[2]) + 1.0 + AROUND - v) / down
    entered = wp.max(wp.min(left_at, right_at), wp.min(upper_at, lower_at))
    left = wp.min(wp.max(left_at, right_at), wp.max(upper_at, lower_at))
    return left < wp.max(entered, 0.0)


@wp.func
def _with_run(gaps: wp.vec4, low: float, high: float) -> wp.vec4:
    """Return the lowest and the highest gap on a path, and the ends of the widest opening between them, with those of one more run over the
    surface: a ray that passes behind one run and before another passes through a hole, or beside an arm, and meets nothing."""
    if gaps[1] == NO_GAP:
        return wp.vec4(low, high, 0.0, 0.0)
    one = wp.vec2(gaps[2], wp.clamp(low, gaps[2], gaps[3]))  # what the run leaves of the opening so far
    other = wp.vec2(wp.clamp(high, gaps[2], gaps[3]), gaps[3])
    beyond = wp.vec2(wp.min(gaps[1], low), low)  # between the runs so far and this one, which lies above them all
    beneath = wp.vec2(high, wp.max(gaps[0], high))  # or below
    widest = one
    if other[1] - other[0] > widest[1] - widest[0]:
        widest = other
    if beyond[1] - beyond[0] > widest[1] - widest[0]:
        widest = beyond
    if beneath[1] - beneath[0] > widest[1] - widest[0]:
        widest = beneath
    return wp.vec4(wp.min(gaps[0], low), wp.max(gaps[1], high), widest[0], widest[1])


@wp.kernel
def _march(first: int,
           pixels: wp.array(dtype=wp.vec2i),
           toward: wp.array(dtype=wp.vec3),
           height: wp.array2d(dtype=float),
           part: wp.array2d(dtype=wp.int32),
           thickness: wp.array2d(dtype=float),
           moving: int,
           box: wp.vec4i,
           camera: Camera,
           # outputs
           highest: wp.array2d(dtype=float),
           lowest: wp.array2d(dtype=float),
           back: wp.array2d(dtype=float),
           opening: wp.array2d(dtype=wp.vec2),
           hidden: wp.array2d(dtype=wp.uint8)):
    n = first + wp.tid()
    row, col = pixels[n][0], pixels[n][1]
    rows, cols = part.shape[0], part.shape[1]
    moves = part[row, col] == moving
    start = surface_point(row, col, height, camera)
    pixel = pixel_span(start[2], camera)
    thin = wp.where(camera.perspective, pixel / wp.max(-start[2], 1.0e-9), pixel)  # a pixel, in the unit of gaps
    for light in range(toward.shape[0]):
        way = toward[light]
        across = wp.sqrt(way[0] * way[0] + way[1] * way[1])
        stride = pixel / wp.max(across, 1.0e-4)
        travelled = FIRST_STEP * stride
        gaps = wp.vec4(-NO_GAP, NO_GAP, 0.0, 0.0)  # the lowest, the highest, and the opening between them
        top, bottom, rear = float(NO_GAP), float(-NO_GAP), float(-NO_GAP)  # of this run; literals could not change inside the loop
        own = wp.uint8(0)
        crossed, last = wp.int32(0), wp.int32(-1)  # pixels on the way of the part that is crossed, and that part
        before, sooner, soonest, flat = float(0.0), float(0.0), float(0.0), bool(False)  # the last gaps to it, and whether it is flat
        steps = rows + cols
        if part[row, col] < 0 or (not moves and _passes_by(start, way, camera, float(col) + 0.5, float(row) + 0.5, box)):
            steps = 0
        for _ in range(steps):
            point = start + travelled * way
            at = project(point, camera)
            c, r = int(wp.floor(at[0])), int(wp.floor(at[1]))
            if c < 0 or r < 0 or c >= cols or r >= rows or (camera.perspective and point[2] >= 0.0):
                break
            here = part[r, c]
            if crossed > 2 and here != last and flat:
                rim = OUTLINE_0 * before + OUTLINE_1 * sooner + OUTLINE_2 * soonest
                top, bottom = wp.max(top, rim), wp.min(bottom, rim)
            if here != last or (here == moving) == moves:
                crossed = 0
            if top > NO_GAP and here != last:
                gaps = _with_run(gaps, bottom, top)
                top, bottom = float(NO_GAP), float(-NO_GAP)
            last = here
            if here >= 0:
                # between pixels where all four are of one part: the largest of many gaps at the nearest pixels would be too large
                level = height[r, c]
                u, v = at[0] - 0.5, at[1] - 0.5
                left, upper = int(wp.floor(u)), int(wp.floor(v))
                if (left >= 0 and upper >= 0 and left < cols - 1 and upper < rows - 1 and part[upper, left] == here
                        and part[upper, left + 1] == here and part[upper + 1, left] == here and part[upper + 1, left + 1] == here):
                    level = between_pixels(height, u, v)
                if (here == moving) == moves:
                    if level - point[2] > MARGIN_PIXELS * pixel + MARGIN_SLOPE * travelled * across:
                        own = wp.uint8(1)
                        break
                else:
                    gap = wp.where(camera.perspective, wp.log(point[2] / level), level - point[2])
                    top, bottom = wp.max(top, gap), wp.min(bottom, gap)
                    rear = wp.min(rear, gap - thickness[r, c])
                    flat = thickness[r, c] < thin
                    if crossed == 2 and flat:
                        rim = OUTLINE_0 * sooner + OUTLINE_1 * before + OUTLINE_2 * gap
                        top, bottom = wp.max(top, rim), wp.min(bottom, rim)
                    soonest = sooner
                    sooner = before
                    before = gap
                    crossed += 1
            travelled += stride
        if top > NO_GAP:
            gaps = _with_run(gaps, bottom, top)
        highest[n, light] = gaps[1]
        lowest[n, light] = gaps[0]
        back[n, light] = wp.min(rear, gaps[0])
        opening[n, light] = wp.vec2(gaps[2], gaps[3])
        hidden[n, light] = own


def march_part(
    pixels: wp.array,  # [n] vec2i, row and column; those of no part find no gap
    toward: wp.array,  # [lights] vec3, unit directions to the lights
    height: wp.array,  # [rows, cols] float32, camera-frame z
    part: wp.array,  # [rows, cols] int32, the part of each pixel, below 0 outside
    thickness: wp.array,  # [rows, cols] float32, guessed distance from front to back, in the unit of the gaps
    moving: int,  # number of the part that moves against all others
    box: wp.vec4i,  # first row and column of that part, and the last of each
    projection: Projection,
) -> PartShadows:
    """March from pixels to distant lights over a surface of which one part moves; not synchronised on CUDA.

    Gaps are in the unit of height, or for a perspective camera in log depth.
    """
    if not height.shape == part.shape == thickness.shape:
        raise ArrayError(f"height is {height.shape}, part {part.shape}, thickness {thickness.shape}: give one of each for every pixel")
    shape, device = (pixels.shape[0], toward.shape[0]), height.device.alias
    found = PartShadows(*(wp.empty(shape, dtype=kind, device=device) for kind in (float, float, float, wp.vec2, wp.uint8)))
    inputs = [pixels, toward, height, part, thickness, moving, box, projection.on_device()]
    devices.launch(_march, shape[0], inputs, list(found), device=device, uneven=True)
    return found


INSIDE, BEHIND = 0.6, 0.4
"""Probability that a ray is hidden which lies behind the front of a part all along its way: before the guessed back, and behind it."""
BEHIND_PLATE, FLAT = 0.1, 1.5
"""The latter of a plate, and the guessed thickness below which a part may be one, in standard deviations of the gaps."""
GROUPS = 8
"""Groups of lights, by their direction about the line of sight."""
STEPS = 1024
"""Offsets that are compared on each side of 0."""
LEAST_GAIN = 3.0
"""Log-likelihood, beyond twice its standard error between groups, by which an offset must be worse to be ruled out."""
ERRORS = 2.0
"""Standard errors by which it must be worse."""
LEAST_GROUPS = 1.5
"""Effective number of groups, (Σ e)² / Σ e² of their expected losses e, below which none can confirm the others."""


class Evidence(NamedTuple):
    """Log-likelihood of every compared offset of one part."""

    offsets: np.ndarray  # [m] in the unit of the gaps
    gain: np.ndarray  # [groups, m] log-likelihood of each group of lights, less that of offset 0
    expected: np.ndarray  # [groups, m] loss against the best offset that each group would have in the mean if that were the true one


class Offset(NamedTuple):
    """An offset with its uncertainty."""

    offset: float
    sigma: float
    low: float
    high: float
    """Bounds of the offsets that are not ruled out; the ends of the compared range where it is open."""
    agreed_low: float
    agreed_high: float
    """The same bounds if the groups of lights did not contradict each other."""


def weigh_offsets(
    shadows: PartShadows,
    odds: np.ndarray,  # [n, lights] log odds of shadow
    on_part: np.ndarray,  # [n] bool, whether the pixel lies on the part that moves
    group: np.ndarray,  # [lights] int, the group of each light, below GROUPS
    *,
    reach: float,  # largest offset that is compared, in the unit of the gaps
    blur: float,  # standard deviation of the gaps, in the same unit
) -> Evidence:
    """Return the likelihood of offsets between -reach and reach. Waits for the device."""
    highest, hidden = to_numpy(shadows.highest), to_numpy(shadows.hidden)
    told = (highest > NO_GAP) & (hidden == 0) & (odds != 0)
    gaps = [highest[told], to_numpy(shadows.lowest)[told], to_numpy(shadows.back)[told]]
    mine = np.broadcast_to(on_part[:, None], told.shape)[told]
    # a part that nears comes before others' pixels: free, hidden, then these lie behind its front, then behind its back; its own pixels
    # go the other way round
    flat = gaps[1] - gaps[2] < FLAT * blur  # as a plate: the readings choose whether light passes behind it
    places = [_bin(np.where(mine, gap, -gap), reach) for gap in gaps]
    low, high = to_numpy(shadows.opening)[told].T
    opens, closes = (_bin(np.where(mine, own, -other), reach) for own, other in ((low, high), (high, low)))
    bins = 2 * STEPS + 2
    first, changes = np.broadcast_to(group[None] * bins, told.shape)[told], [np.zeros_like(opens), *places, opens, closes]

    def along(levels: list[np.ndarray]) -> np.ndarray:
        apart = levels[-1] - levels[1]
        steps = [np.where(mine, levels[-1], levels[0]), *(np.where(mine, before - after, after - before) for before, after in
                                                          pairwise(levels)), apart, -apart]
        change = np.sum([np.bincount(first + place, step, GROUPS * bins) for place, step in zip(changes, steps, strict=True)], axis=0)
        return _blurred(np.cumsum(change.reshape(GROUPS, bins), axis=1)[:, :-1], blur / reach * STEPS)

    tried = [(0.0, 1.0, INSIDE, np.where(flat, behind, BEHIND)) for behind in (BEHIND, BEHIND_PLATE)]
    swing, size = np.expm1(odds[told]), np.abs(odds[told])
    states, gain = max(((states, along([np.log1p(state * swing) for state in states])) for states in tried),
                       key=lambda one: float(one[1].sum(axis=0).max()))
    best = int(np.argmax(gain.sum(axis=0)))
    passed = np.sum([place <= best for place in places], axis=0)
    sure = 1 / (1 + np.exp(-size))  # probability that a reading's odds have the sign of its state
    state = np.where((opens <= best) & (best < closes), 3, np.where(mine, 3 - passed, passed))
    dark = 1 - sure + np.choose(state, states) * (2 * sure - 1)
    up, down = np.expm1(size), np.expm1(-size)
    mean = along([dark * np.log1p(state * up) + (1 - dark) * np.log1p(state * down) for state in states])
    return Evidence(np.linspace(-reach, reach, 2 * STEPS + 1), gain - gain[:, STEPS, None], mean[:, best, None] - mean)


def choose_offset(evidence: Evidence, *, least_sigma: float) -> Offset:
    """Return the offset that the evidence speaks for, and its bounds; its standard deviation is `least_sigma` or more."""
    offsets, gain, expected = evidence
    whole = gain.sum(axis=0)
    best = int(np.argmax(whole))
    loss = gain[:, best, None] - gain
    due = np.maximum(expected, 0) + LEAST_GAIN / GROUPS**2
    error = np.sqrt(((loss - due * loss.sum(axis=0) / due.sum(axis=0)) ** 2).sum(axis=0))
    groups = due.sum(axis=0) ** 2 / (due**2).sum(axis=0)
    error *= np.sqrt(groups / np.maximum(groups - 1, 1e-9))
    told = groups >= LEAST_GROUPS
    low, high = _bounds(offsets, best, told & (loss.sum(axis=0) > ERRORS * error + LEAST_GAIN))
    apart = np.array([offsets[int(np.argmax(whole - one))] for one in gain])
    jackknife = float(np.sqrt((len(apart) - 1) / len(apart) * ((apart - apart.mean()) ** 2).sum()))
    return Offset(float(offsets[best]), max(jackknife, (high - low) / (2 * ERRORS), least_sigma), low, high,
                  *_bounds(offsets, best, expected.sum(axis=0) > LEAST_GAIN))


def _bounds(offsets: np.ndarray, best: int, worse: np.ndarray) -> tuple[float, float]:
    """Return the first and the last offset that is not worse than the best."""
    left = np.flatnonzero(~worse | (np.arange(len(offsets)) == best))
    return float(offsets[left[0]]), float(offsets[left[-1]])


def _bin(offset: np.ndarray, reach: float) -> np.ndarray:
    """Return the first compared offset that is not below these."""
    return np.clip(np.ceil((offset / reach + 1) * STEPS), 0, 2 * STEPS + 1).astype(int)


def _blurred(values: np.ndarray, width: float) -> np.ndarray:
    """Return the values blurred by a Gaussian along the last axis, its ends continued."""
    half = int(np.ceil(3 * width))
    if half == 0:
        return values
    kernel = np.exp(-0.5 * (np.arange(-half, half + 1) / width) ** 2)
    kernel /= kernel.sum()
    padded = np.pad(values, ((0, 0), (half, half)), mode="edge")
    return np.stack([np.convolve(row, kernel, mode="valid") for row in padded])
