"""Estimate the distances between the parts of a surface along the view, from the cast shadows that readings show.

An offset of a part is judged by the log-likelihood of all readings: log(1 + H (e^q - 1)), where q are the log odds that the reading lies in
shadow and H is the probability that the surface at that offset hides the light: 1 where the ray passes through the visible front, and less
where it is behind it all along its way. H is a step function of the offset with three steps, so one pass over the
readings gives the likelihood at all offsets.

Neighbouring readings err alike: the shape of a part errs, and highlights and bounced light are not known exactly. So neither the curvature
of the likelihood nor its height can be taken at face value. The lights are divided into groups by their direction, each of which throws
shadows on other places. The offset is left open between all values that the groups together do not contradict by twice the standard error
between them, and σ is at least that of leaving a group out in turn (the jackknife of Quenouille and Tukey).

A part moves along the lines of sight. The ray from a pixel to a distant light keeps its path in the image while a part moves, whether the
pixel lies on that part or on another. So along the path only the gap between the ray and the surface changes, everywhere by
the same amount: the offset in z of an orthographic camera, and in -log depth of a perspective one, where a part moves by growing about the
eye. The largest and the smallest gap therefore tell at which offsets the surface stands before the ray, and at which the whole
surface on the way lies in front of it.

A ray that passes through the visible front of a part is hidden. One that lies behind that front all along its way may pass behind the part.
Nothing tells how thick a part is; the guess is that its back is its front mirrored in its outline.
"""

from typing import NamedTuple

import numpy as np
import warp as wp

from kernels import device as devices
from kernels.errors import ArrayError
from kernels.surface.shadows import FIRST_STEP, MARGIN_PIXELS, MARGIN_SLOPE, Camera, Projection, pixel_span, project, surface_point

wp.set_module_options({"enable_backward": False})

NO_GAP = -1.0e30
"""Stands for the largest gap where the path never crosses the surface that moves against the pixel."""


class PartShadows(NamedTuple):
    """Gaps between the surface and the ray from each pixel to each light."""

    highest: wp.array  # [pixels, lights] float32: largest height of the surface above the ray, over all of it that moves against the pixel
    lowest: wp.array  # [pixels, lights] float32: the least
    back: wp.array  # [pixels, lights] float32: least height of the guessed back above the ray
    hidden: wp.array  # [pixels, lights] uint8: whether surface that moves with the pixel hides the light, whatever the offset


@wp.kernel
def _march(first: int,
           pixels: wp.array(dtype=wp.vec2i),
           toward: wp.array(dtype=wp.vec3),
           height: wp.array2d(dtype=float),
           part: wp.array2d(dtype=wp.int32),
           thickness: wp.array2d(dtype=float),
           moving: int,
           camera: Camera,
           # outputs
           highest: wp.array2d(dtype=float),
           lowest: wp.array2d(dtype=float),
           back: wp.array2d(dtype=float),
           hidden: wp.array2d(dtype=wp.uint8)):
    n = first + wp.tid()
    row, col = pixels[n][0], pixels[n][1]
    rows, cols = part.shape[0], part.shape[1]
    moves = part[row, col] == moving
    start = surface_point(row, col, height, camera)
    pixel = pixel_span(start[2], camera)
    for light in range(toward.shape[0]):
        way = toward[light]
        across = wp.sqrt(way[0] * way[0] + way[1] * way[1])
        stride = pixel / wp.max(across, 1.0e-4)
        travelled = FIRST_STEP * stride
        top, bottom, rear = float(NO_GAP), float(-NO_GAP), float(-NO_GAP)  # literals could not change inside the loop
        own = wp.uint8(0)
        for _ in range(rows + cols):
            point = start + travelled * way
            at = project(point, camera)
            c, r = int(wp.floor(at[0])), int(wp.floor(at[1]))
            if c < 0 or r < 0 or c >= cols or r >= rows or (camera.perspective and point[2] >= 0.0):
                break
            if part[r, c] >= 0:
                if (part[r, c] == moving) == moves:
                    if height[r, c] - point[2] > MARGIN_PIXELS * pixel + MARGIN_SLOPE * travelled * across:
                        own = wp.uint8(1)
                        break
                else:
                    gap = wp.where(camera.perspective, wp.log(point[2] / height[r, c]), height[r, c] - point[2])
                    top, bottom = wp.max(top, gap), wp.min(bottom, gap)
                    rear = wp.min(rear, gap - thickness[r, c])
            travelled += stride
        highest[n, light] = top
        lowest[n, light] = bottom
        back[n, light] = rear
        hidden[n, light] = own


def march_part(pixels: wp.array, toward: wp.array, height: wp.array, part: wp.array, thickness: wp.array, moving: int,
               projection: Projection) -> PartShadows:
    """March from pixels to distant lights over a surface of which one part moves; not synchronised on CUDA.

    Gaps are in the unit of height, or for a perspective camera in log depth.

    Args:
        pixels: [n] vec2i, row and column of pixels of some part.
        toward: [lights] vec3, unit directions to the lights.
        height: [rows, cols] float32, camera-frame z.
        part: [rows, cols] int32, the part of each pixel, below 0 outside.
        thickness: [rows, cols] float32, guessed distance from front to back, in the unit of the gaps.
        moving: number of the part that moves against all others.
    """
    if not height.shape == part.shape == thickness.shape:
        raise ArrayError(f"height is {height.shape}, part {part.shape}, thickness {thickness.shape}: give one of each for every pixel")
    shape, device = (pixels.shape[0], toward.shape[0]), height.device.alias
    found = PartShadows(*(wp.empty(shape, dtype=float, device=device) for _ in range(3)), wp.empty(shape, dtype=wp.uint8, device=device))
    inputs = [pixels, toward, height, part, thickness, moving, projection.on_device()]
    devices.launch(_march, shape[0], inputs, list(found), device=device, uneven=True)
    return found


INSIDE, BEHIND = 0.6, 0.4
"""Probability that a ray is hidden which lies behind the front of a part all along its way: before the guessed back, and behind it."""
GROUPS = 8
"""Groups of lights, by their direction about the line of sight."""
STEPS = 1024
"""Offsets that are compared on each side of 0."""
LEAST_GAIN = 3.0
"""Log-likelihood, beyond twice its standard error between groups, by which an offset must be worse to be ruled out."""
ERRORS = 2.0
"""Standard errors by which it must be worse."""


class Evidence(NamedTuple):
    """Log-likelihood of every compared offset of one part."""

    offsets: np.ndarray  # [m] in the unit of the gaps
    gain: np.ndarray  # [groups, m] log-likelihood of each group of lights, less that of offset 0


class Offset(NamedTuple):
    """An offset with its uncertainty."""

    offset: float
    sigma: float
    low: float
    high: float
    """Bounds of the offsets that are not ruled out; the ends of the compared range where it is open."""


def weigh_offsets(shadows: PartShadows, odds: np.ndarray, on_part: np.ndarray, group: np.ndarray, *, reach: float,
                  blur: float) -> Evidence:
    """Return the likelihood of offsets between -reach and reach. Waits for the device.

    Args:
        odds: [n, lights] log odds of shadow.
        on_part: [n] bool, whether the pixel lies on the part that moves.
        group: [lights] int, the group of each light, below GROUPS.
        reach: largest offset that is compared, in the unit of the gaps.
        blur: standard deviation of the gaps, in the same unit.
    """
    highest, hidden = shadows.highest.numpy(), shadows.hidden.numpy()
    told = (highest > NO_GAP) & (hidden == 0) & (odds != 0)
    gaps = [highest[told], shadows.lowest.numpy()[told], shadows.back.numpy()[told]]
    mine = np.broadcast_to(on_part[:, None], told.shape)[told]
    whose = np.broadcast_to(group[None], told.shape)[told]
    # a part that nears comes before others' pixels: free, hidden, then these lie behind its front, then behind its back; its own pixels
    # go the other way round
    levels = [np.log(1 + share * np.expm1(odds[told])) for share in (0.0, 1.0, INSIDE, BEHIND)]
    count = 2 * STEPS + 1
    change = np.zeros((GROUPS, count + 1))
    np.add.at(change, (whose, np.zeros_like(whose)), np.where(mine, levels[-1], levels[0]))
    for gap, before, after in zip(gaps, levels[:-1], levels[1:], strict=True):
        np.add.at(change, (whose, _bin(np.where(mine, gap, -gap), reach)), np.where(mine, before - after, after - before))
    gain = _blurred(np.cumsum(change, axis=1)[:, :count], blur / reach * STEPS)
    return Evidence(np.linspace(-reach, reach, count), gain - gain[:, STEPS, None])


def choose_offset(evidence: Evidence, *, least_sigma: float) -> Offset:
    """Return the offset that the evidence speaks for, and its bounds; its standard deviation is `least_sigma` or more."""
    offsets, gain = evidence
    whole = gain.sum(axis=0)
    best = int(np.argmax(whole))
    loss = gain[:, best, None] - gain
    # groups that see nothing of the part neither confirm nor contradict
    telling = max(2, int((np.ptp(gain, axis=1) > LEAST_GAIN / GROUPS).sum()))
    error = np.sqrt(((loss - loss.sum(axis=0) / telling) ** 2 * (np.ptp(gain, axis=1) > LEAST_GAIN / GROUPS)[:, None]).sum(axis=0)
                    * telling / (telling - 1))
    open_still = loss.sum(axis=0) < ERRORS * error + LEAST_GAIN
    low, high = offsets[np.flatnonzero(open_still)[[0, -1]]]
    apart = np.array([offsets[int(np.argmax(whole - one))] for one in gain])
    jackknife = float(np.sqrt((len(apart) - 1) / len(apart) * ((apart - apart.mean()) ** 2).sum()))
    return Offset(float(offsets[best]), max(jackknife, float(high - low) / (2 * ERRORS), least_sigma), float(low), float(high))


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
